"""The commands of `benchmarks/` are those that pages, Makefile, CI and docstrings name."""

import re
from importlib import import_module
from pathlib import Path

import pytest

from benchmarks.commands import parser_of

ROOT = Path(__file__).resolve().parents[1]
NAMES = [path.stem for path in sorted((ROOT / "benchmarks").glob("*.py")) if "COMMANDS = " in path.read_text()]
NAMED = sorted({
    (page.name, module, given.strip())
    for page in [*(ROOT / "docs").glob("*.md"), ROOT / "Makefile", ROOT / ".ci" / "run"]
    for module, given in re.findall(r"python -m benchmarks\.([a-z_]+)((?: [\w./-]+)*)", page.read_text())
})  # fmt: skip


def commands_of(name):
    return import_module(f"benchmarks.{name}").COMMANDS


def test_commands_are_named():
    assert len(NAMED) > 40
    assert {module for _, module, _ in NAMED} == set(NAMES)


@pytest.mark.parametrize(("page", "module", "given"), NAMED)
def test_command_that_is_named_somewhere_exists_with_its_options(page, module, given):
    parser_of(None, commands_of(module)).parse_args(given.split())


@pytest.mark.parametrize("name", NAMES)
def test_docstring_of_a_module_names_its_commands_which_start_without_options(name):
    text = " ".join(import_module(f"benchmarks.{name}").__doc__.split())
    commands = [each.__name__.replace("_", "-") for each in commands_of(name)]
    assert f"`python -m benchmarks.{name} COMMAND`. Commands: {', '.join(commands)}." in text
    for each in commands:
        assert parser_of(None, commands_of(name)).parse_args([each]).command in commands_of(name)
