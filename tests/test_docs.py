"""What the pages say exists: links, names, folders, errors; and what their programs print."""

import ast
import builtins
import importlib
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
import yaml

from tests.command import environment
from tests.programs import output_of

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("ncs_gym", "shields", "agents", "experiments")
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
CODE = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)
REFERENCE = re.compile(r"^::: (\S+)$", re.MULTILINE)
# A program, and what it prints if that follows.
PROGRAM = re.compile(r"^```python\n(.*?)^```\n(?:\n```\n(.*?)^```)?", re.DOTALL | re.MULTILINE)
QUICK_PAGES = (
    "README.md",
    "docs/index.md",
    "docs/ncs_gym.md",
    "docs/shield.md",
    "docs/vector.md",
    "docs/networked.md",
    "docs/lookahead.md",
)
# Their programs run in a process of their own, but for those of the benchmark, which take hours.
SLOW_PAGES = {str(page.relative_to(ROOT)) for page in PAGES if PROGRAM.search(page.read_text())} - {"docs/benchmark.md"}
MODULE = re.compile(rf"\b(?:{'|'.join(PACKAGES)}|tests|benchmarks)/[\w/]+\.py\b")


def nav_files(entry):
    """Pages below an entry of the navigation."""
    if isinstance(entry, str):
        return [entry]
    return [file for each in (entry.values() if isinstance(entry, dict) else entry) for file in nav_files(each)]


@cache
def exceptions():
    """Module and name of every exception class that the packages define."""
    found = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.ClassDef):
                    bases = {base.id for base in node.bases if isinstance(base, ast.Name)}
                    known = {name for _, name in found}
                    if any(base in known or is_exception(getattr(builtins, base, None)) for base in bases):
                        found.append((".".join(path.relative_to(ROOT).with_suffix("").parts), node.name))
    return found


def is_exception(value):
    return isinstance(value, type) and issubclass(value, BaseException)


def resolved(name):
    """The object of a dotted name."""
    parts = name.split(".")
    module, depth = importlib.import_module(parts[0]), 1
    while depth < len(parts) - 1:
        path = ROOT / Path(*parts[: depth + 1])
        if not path.is_dir() and not path.with_suffix(".py").exists():
            break
        depth += 1
        module = importlib.import_module(".".join(parts[:depth]))
    for part in parts[depth:]:
        module = getattr(module, part)
    return module


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_relative_links_lead_to_files(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", CODE.sub("", page.read_text())):
        if not re.match(r"https?://|mailto:|#", target):
            assert (page.parent / target.partition("#")[0]).exists(), target


def test_navigation_has_every_page_once():
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]
    pages = {str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")}
    assert sorted(nav_files(nav)) == sorted(pages)


@pytest.mark.parametrize("package", PACKAGES[:3])
def test_reference_has_every_public_name_of(package):
    listed = set(REFERENCE.findall((ROOT / "docs" / "api" / f"{package}.md").read_text()))
    names = importlib.import_module(package).__all__
    assert names
    short = {name.rpartition(".")[2] for name in listed}
    assert set(names) <= short
    for name in listed:
        assert resolved(name).__doc__


def test_reference_of_the_command_line_has_the_settings_of_every_command():
    from experiments.__main__ import COMMANDS, settings_of

    listed = set(REFERENCE.findall((ROOT / "docs" / "api" / "experiments.md").read_text()))
    assert {settings_of(command).__name__ for command in COMMANDS} <= {name.rpartition(".")[2] for name in listed}


def test_table_of_errors_has_every_exception_class_and_no_other():
    table = (ROOT / "docs" / "ncs_gym.md").read_text().partition("## Errors")[2]
    rows = re.findall(r"^\| \[`(\w+)`\]\([^#]*#([\w.]+)\) \| [^|]* \| ([^|]*) \|", table, re.MULTILINE)
    assert all(name == target.rpartition(".")[2] for name, target, _ in rows)
    listed = {target: bases for _, target, bases in rows}
    defined = exceptions()
    assert ("shields.errors", "Infeasible") in defined
    assert sorted(name.rpartition(".")[2] for name in listed) == sorted(name for _, name in defined)
    for name, bases in listed.items():
        error = resolved(name)
        assert error.__name__ == name.rpartition(".")[2]
        assert [base.__name__ for base in error.__bases__] == re.findall(r"`(\w+)`", bases)
        assert all(base.__name__ in vars(builtins) or base in map(resolved, listed) for base in error.__bases__)


def test_modules_and_functions_that_the_pages_name_exist():
    text = "".join(page.read_text() for page in PAGES if page.name != "CHANGELOG.md")  # which names what there was
    named = {*MODULE.findall(text), *re.findall(r"examples/[\w/]+\.(?:py|yml|txt)", text)}
    assert {"examples/single_file_ppo.py", "shields/runtime/safety_filter.py"} <= named
    assert [path for path in named if not (ROOT / path).exists()] == []
    functions = re.findall(r"`(\w+)` in `([\w/]+\.py)`", (ROOT / "docs" / "architecture.md").read_text())
    assert ("transmit", "ncs_gym/network/packet_loss_and_delay.py") in functions
    for name, path in functions:
        assert re.search(rf"^\s*(?:def|class) {name}\b", (ROOT / path).read_text(), re.MULTILINE), (name, path)


def test_architecture_describes_every_folder_and_no_other():
    page = (ROOT / "docs" / "architecture.md").read_text()
    described = re.findall(rf"^\| `((?:{'|'.join(PACKAGES)})(?:/\w+)*)` \|", page, re.MULTILINE)
    folders = {path.parent.relative_to(ROOT) for package in PACKAGES for path in (ROOT / package).rglob("*.py")}
    assert sorted(described) == sorted(str(folder) for folder in folders)


@pytest.mark.cases(2)
@pytest.mark.parametrize("page", QUICK_PAGES)
def test_programs_of_a_page_that_train_nothing_print_what_follows_them(page):
    programs = [
        each
        for each in PROGRAM.findall((ROOT / page).read_text())
        if not re.search(r"stable_baselines3|^from agents import", each[0], re.MULTILINE)
    ]
    assert_printed(programs, output_of(in_one(programs)))


@pytest.mark.slow
@pytest.mark.parametrize("page", sorted(SLOW_PAGES))
def test_programs_of_a_page_print_what_follows_them_in_a_process_of_their_own(page, tmp_path):
    programs = PROGRAM.findall((ROOT / page).read_text())
    run = subprocess.run(
        [sys.executable, "-c", in_one(programs)],
        capture_output=True,
        text=True,
        env=environment(),
        cwd=tmp_path,
        timeout=600,
    )
    assert run.returncode == 0, run.stderr
    assert_printed(programs, run.stdout)


def in_one(programs):
    """The programs of a page one after the other: later ones use what earlier ones define."""
    assert programs
    return "print('---')\n".join(program for program, _ in programs)


def assert_printed(programs, printed):
    expected = [text for _, text in programs]
    shown = zip(printed.split("---\n"), expected, strict=True)
    assert [text for text, wanted in shown if wanted] == list(filter(None, expected))


def test_every_statement_names_a_function_that_its_module_has():
    page = (ROOT / "docs" / "shield_proof.md").read_text()
    found = re.findall(r"`(\w+)` \(`([\w/]+)\.py`\)", page)
    assert len(found) >= 15
    for name, module in found:
        assert hasattr(importlib.import_module(module.replace("/", ".")), name), name
