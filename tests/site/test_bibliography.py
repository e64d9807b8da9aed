"""What pages and docstrings cite is in docs/bibliography.md, under the same words."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("ncs_gym", "shields", "agents", "experiments", "benchmarks")
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
ENTRY = re.compile(r'^- <a id="(\w+)"></a>\*\*(.+?)\.\*\* (.+)$', re.MULTILINE)
LINK = re.compile(r"\[([^\]]+)\]\((?:docs/)?bibliography\.md#([^)]+)\)")
# Author and year as docstrings write them: Ray et al. 2019, Wabersich and Zeilinger 2021.
CITED = re.compile(r"\b([A-Z]\w+ (?:et al\.|and [A-Z]\w+) (?:19|20)\d\d)\b")
TEXT = (ROOT / "docs" / "bibliography.md").read_text()
NAMES = {key: name for key, name, _ in ENTRY.findall(TEXT)}


def docstrings(path):
    """All docstrings of a module, each with its line breaks as spaces."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    found = [ast.get_docstring(node) for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, documented)]
    return [" ".join(text.split()) for text in found if text]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_citations_of_a_page_name_an_entry(page):
    for words, key in LINK.findall(page.read_text()):
        assert words in (NAMES[key], NAMES[key].split()[-1]), (words, key)


def test_every_entry_is_cited_on_a_page_or_in_a_docstring():
    on_pages = {key for page in PAGES for _, key in LINK.findall(page.read_text())}
    texts = [text for path in MODULES for text in docstrings(path)]
    in_docstrings = {name for name in NAMES.values() if any(name in text for text in texts)}
    works = [name for _, name, _ in ENTRY.findall(TEXT.partition("## Software")[0])]
    assert len(works) > 30
    cited = {NAMES[key] for key in on_pages} | in_docstrings
    assert [name for name in works if name not in cited] == []


def test_citations_of_docstrings_are_entries():
    cited = {(name, path) for path in MODULES for text in docstrings(path) for name in CITED.findall(text)}
    assert ("Mayne et al. 2006", ROOT / "experiments" / "baselines" / "filters.py") in cited
    assert [each for each in cited if each[0] not in NAMES.values()] == []
