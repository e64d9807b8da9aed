"""The commands of `benchmarks/` are those that pages, Makefile, CI and docstrings name."""

import re
from functools import wraps
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from benchmarks import networks
from benchmarks.commands import run

ROOT = Path(__file__).resolve().parents[1]
NAMES = [path.stem for path in sorted((ROOT / "benchmarks").glob("*.py")) if "COMMANDS = " in path.read_text()]
NAMED = sorted({
    (page.name, module, given.strip())
    for page in [*(ROOT / "docs").glob("*.md"), ROOT / "Makefile", ROOT / ".ci" / "run"]
    for module, given in re.findall(r"python -m benchmarks\.([a-z_]+)((?: [\w./-]+)*)", page.read_text())
})  # fmt: skip


def commands_of(name):
    return import_module(f"benchmarks.{name}").COMMANDS


def asked_for(module, given):
    """The name of the command that a line asks for, whose options are parsed; nothing is measured."""

    def named(command):
        return wraps(command)(lambda *names, **options: command.__name__)

    return run(None, [named(each) for each in commands_of(module)], given.split())


def test_commands_are_named():
    assert len(NAMED) > 40
    assert {module for _, module, _ in NAMED} == set(NAMES)


@pytest.mark.parametrize(("page", "module", "given"), NAMED)
def test_command_that_is_named_somewhere_exists_with_its_options(page, module, given):
    assert asked_for(module, given).replace("_", "-") == given.split()[0]


@pytest.mark.parametrize("name", NAMES)
def test_docstring_of_a_module_names_its_commands_which_start_without_options(name):
    text = " ".join(import_module(f"benchmarks.{name}").__doc__.split())
    commands = [each.__name__.replace("_", "-") for each in commands_of(name)]
    assert f"`python -m benchmarks.{name} COMMAND`. Commands: {', '.join(commands)}." in text
    for each in commands:
        assert asked_for(name, each).replace("_", "-") == each


def test_an_hour_without_an_end_says_what_it_rules_out():
    assert networks.Measured(0, 1.0, 1.0).interval == pytest.approx((0.0, -np.log(0.025)))
    low, high = networks.Measured(40, 2.0, 1.0).interval  # 40 ends: Garwood's interval is [28.58, 54.47]
    assert (low, high) == pytest.approx((28.58 / 2.0, 54.47 / 2.0), abs=5e-3)


def test_the_fixed_part_of_the_long_tests_exists():
    part = re.search(r"^SLOW_PART \?= ((?:.*\\\n)*.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert part
    for each in part[1].replace("\\\n", " ").split():
        file, _, test = each.partition("::")
        assert f"def {test}" in (ROOT / file).read_text() if test else (ROOT / file).exists(), each
