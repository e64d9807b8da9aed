"""Formulas and names of the pages: as the site and GitHub read them."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted((ROOT / "docs").glob("*.md"))
FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
# Backslashes before punctuation are Markdown's on GitHub, signs of order look like HTML, and what is broken over two
# lines is no formula everywhere.
NOT_INLINE = re.compile(r"\\[^A-Za-z]|[<>\n]")


def formulas(page):
    """Formulas in the lines of a page, and those in blocks of their own."""
    text = page.read_text()
    blocks = [content for language, content in FENCED.findall(text) if language == "math"]
    parts = re.sub(r"`[^`]*`", "", FENCED.sub("", text)).split("$")
    assert len(parts) % 2 == 1, f"a dollar without a second one in {page.name}"
    return parts[1::2], blocks


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_formulas_in_a_line_are_left_alone_by_markdown(page):
    for formula in formulas(page)[0]:
        assert formula == formula.strip() != "", formula
        assert not NOT_INLINE.search(formula), formula
        assert formula.count("{") == formula.count("}"), formula
