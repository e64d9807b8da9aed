"""Sixty small faults in what guarantees rest on, and the test of `make test` that notices each.

    python benchmarks/mutants.py [--count 60] [--jobs 2] [--only NUMBER ...] [--stages 3] [--list]

A mutant is the program with one operator, comparison, condition or number changed. Fifteen each are spread evenly over
shields/runtime, shields/verification, ncs_gym/estimation and ncs_gym/network, always the same ones for the same source.
Tests run in a copy of the repository, those of the same folder first, until one fails. What survives either needs a
test or changes nothing (a constant that is larger than it must be, a search that is checked afterwards).
"""

from __future__ import annotations

import argparse
import ast
import copy
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("shields/runtime", "shields/verification", "ncs_gym/estimation", "ncs_gym/network")
SWAPPED: dict[type, type] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.And: ast.Or,
    ast.Or: ast.And,
}
# What a test that never ends is given before the mutant counts as noticed [s].
PATIENCE = 900


@dataclass(frozen=True)
class Mutant:
    """One changed node of a file.

    Attributes:
        file: The file, below the root.
        node: Number of the node in the order of `ast.walk`.
        line: Line of the node.
        change: What is changed, in words.
    """

    file: str
    node: int
    line: int
    change: str

    @property
    def source(self) -> str:
        """The changed file."""
        tree = ast.parse((ROOT / self.file).read_text())
        changed(list(ast.walk(tree))[self.node])
        return ast.unparse(tree)


def changed(node: ast.AST) -> str:
    """Changes a node and returns how; an empty text where there is nothing to change."""
    if isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPPED:
        return _swapped(node.ops, 0)
    if isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in SWAPPED:
        before, node.op = type(node.op), SWAPPED[type(node.op)]()
        return f"{before.__name__} becomes {type(node.op).__name__}"
    if isinstance(node, ast.BoolOp):
        before, node.op = type(node.op), SWAPPED[type(node.op)]()
        return f"{before.__name__} becomes {type(node.op).__name__}"
    if isinstance(node, ast.If | ast.IfExp | ast.While):
        node.test = ast.UnaryOp(ast.Not(), node.test)
        return "the condition is negated"
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        before, node.value = node.value, node.value + 1 if type(node.value) is int else 1.5 * node.value + 0.5
        return f"{before} becomes {node.value}"
    if isinstance(node, ast.Constant) and type(node.value) is bool:
        node.value = not node.value
        return f"{not node.value} becomes {node.value}"
    return ""


def _swapped(operators: list[ast.cmpop], index: int) -> str:
    before = type(operators[index])
    operators[index] = SWAPPED[before]()
    return f"{before.__name__} becomes {type(operators[index]).__name__}"


def candidates(folder: str) -> Iterator[Mutant]:
    """Yields every mutant of a folder: what is computed, not annotations, messages of errors or imports."""
    for path in sorted((ROOT / folder).rglob("*.py")):
        tree = ast.parse(path.read_text())
        left_out = {id(inner) for node in ast.walk(tree) for part in _not_computed(node) for inner in ast.walk(part)}
        for number, node in enumerate(ast.walk(tree)):
            if id(node) not in left_out and (change := changed(copy.deepcopy(node))):
                yield Mutant(str(path.relative_to(ROOT)), number, node.lineno, change)  # type: ignore[attr-defined]


def _not_computed(node: ast.AST) -> list[ast.AST]:
    if isinstance(node, ast.Raise | ast.JoinedStr):
        return [node]
    if isinstance(node, ast.FunctionDef) and node.name in ("__repr__", "__str__"):
        return [node]
    if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
        return [node]
    return [part for name in ("annotation", "returns") if (part := getattr(node, name, None)) is not None]


def chosen(count: int) -> list[Mutant]:
    """Returns mutants spread evenly over the folders."""
    mutants = []
    for folder in FOLDERS:
        every = list(candidates(folder))
        each = count // len(FOLDERS)
        mutants += [every[(2 * k + 1) * len(every) // (2 * each)] for k in range(each)]
    return mutants


def fate(mutant: Mutant, stages: int) -> str:
    """Returns the test that notices a mutant; an empty text if none does."""
    with tempfile.TemporaryDirectory() as folder:
        copied = Path(folder) / "copy"
        for name in subprocess.check_output(["git", "ls-files", "-z"], cwd=ROOT, text=True).split("\0")[:-1]:
            (copied / name).parent.mkdir(parents=True, exist_ok=True)
            if (ROOT / name).is_file():
                shutil.copyfile(ROOT / name, copied / name)
        (copied / mutant.file).write_text(mutant.source)
        package, inner = Path(mutant.file).parts[:2]
        for tests in (f"tests/{package}/{inner}", f"tests/{package}", "tests")[:stages]:
            if (copied / tests).exists() and (noticed := _first_failure(copied, tests)):
                return noticed
    return ""


def _first_failure(copied: Path, tests: str) -> str:
    command = [sys.executable, "-m", "pytest", "-x", "-q", "--no-header", "--tb=no", tests]
    settings = {"PYTHONDONTWRITEBYTECODE": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(copied)}
    try:
        run = subprocess.run(
            command, cwd=copied, env=os.environ | settings, capture_output=True, text=True, timeout=PATIENCE
        )
    except subprocess.TimeoutExpired:
        return f"{tests} (did not end)"
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", run.stdout, re.MULTILINE)
    if failed:
        return failed[1]
    return "" if run.returncode == 0 else f"{tests} (ended with {run.returncode})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", type=int, nargs="*", help="numbers of mutants")
    parser.add_argument("--stages", type=int, default=3, help="1 for tests of the same folder, 2 of the package, 3 all")
    parser.add_argument("--list", action="store_true", help="name the mutants, run nothing")
    options = parser.parse_args()
    mutants = dict(enumerate(chosen(options.count)))
    mutants = {number: each for number, each in mutants.items() if options.only is None or number in options.only}
    killed = 0
    with ThreadPoolExecutor(options.jobs) as pool:
        fates = pool.map(lambda each: "" if options.list else fate(each, options.stages), mutants.values())
        for (number, mutant), test in zip(mutants.items(), fates, strict=True):
            killed += bool(test)
            print(f"{number:3d} {mutant.file}:{mutant.line}, {mutant.change}", end="" if options.list else ": ")
            print("" if options.list else test or "SURVIVES", flush=True)
    if not options.list:
        print(f"{killed} of {len(mutants)} noticed")


if __name__ == "__main__":
    main()
