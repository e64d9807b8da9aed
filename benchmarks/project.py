"""Checks of the project itself: `python -m benchmarks.project COMMAND`.

Commands: complexity, mutants.
"""

from __future__ import annotations

import ast
import copy
import inspect
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import gymnasium as gym

import ncs_gym
from benchmarks.commands import run
from shields import SafetyShield, synthesize

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("ncs_gym", "shields", "agents", "experiments")
FEATURES = ("contract", "polytope", "remainder", "lookahead", "downlink", "ages", "between", "protocol")


def complexity() -> None:
    """How much code there is, and how much of it a step runs through.

    Lines of the product, of benchmarks, examples and tests, and of templates and data (those of the report, tuned
    hyperparameters, JSON of the packages but for certificates and trained agents); branches that ask whether a feature
    is there at all (`x is None` of a contract, a polytope, a remainder, a plan, a downlink, ages); through how many
    functions of the product making an environment, its shield, the first reset and the first 200 steps run, in a
    process that has made nothing yet; and calls of them in one step, as it comes and behind a shield whose action
    passes, and how often the module changes from one to the next.
    """
    product = sources(*PACKAGES)
    nodes = [node for path in product for node in ast.walk(ast.parse(path.read_text()))]
    print(f"{lines(product):,} lines of the product in {len(product)} modules")
    others = [f"{lines(sources(folder)):,} of {folder}" for folder in ("benchmarks", "examples", "tests")]
    print(f"{', '.join(others)}, {lines(templates_and_data()):,} of templates and data")
    print(f"{sum(map(asks_for_feature, nodes))} branches ask whether a feature is there")
    case = "ncs_gym/TruckTrailerCruise-v0"
    made: list[Any] = []
    parts: dict[str, Callable[[], Any]] = {
        "gym.make": lambda: made.append(gym.make(case)),
        "the shield": lambda: made.append(SafetyShield(made[-1])),
        "the first reset": lambda: made[-1].reset(seed=0),
        "200 shielded steps": lambda: [made[-1].step(made[-1].action_space.sample()) for _ in range(200)],
    }
    for name, part in parts.items():
        functions = functions_of(part)
        total = sum(map(line_count, functions))
        modules = len({code.co_filename for code in functions})
        print(f"{name}: {len(functions)} functions of {total:,} lines in {modules} modules")
    for name, env in {"a step": gym.make(case), "a shielded step": SafetyShield(gym.make(case))}.items():
        step = step_of(env)
        calls, changes = sorted(walked(step) for _ in range(25))[12]  # the median
        print(f"{name}: {calls} calls, {changes} changes of module")
    plant = ncs_gym.truck_trailer(mass=4000.0)
    calls, changes = walked(lambda: synthesize(plant))
    print(f"synthesize: {calls:,} calls, {changes:,} changes of module")


def sources(*folders: str) -> list[Path]:
    """Returns the Python files below some folders."""
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


def templates_and_data() -> list[Path]:
    """Returns templates, and the JSON files of the packages but certificates and trained agents."""
    data = [path for folder in PACKAGES for path in (ROOT / folder).rglob("*.json")]
    return [
        *(ROOT / "experiments" / "templates").iterdir(),
        *(ROOT / "shields" / "export" / "templates").iterdir(),
        *(path for path in data if not {"packaged_certificates", "trained"} & set(path.parts)),
    ]


def lines(files: list[Path]) -> int:
    """Returns the number of lines of some files."""
    return sum(len(path.read_text().splitlines()) for path in files)


def asks_for_feature(node: ast.AST) -> bool:
    """Returns whether it compares something that is named after a feature with None."""
    if not (isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.Is | ast.IsNot)):
        return False
    right = node.comparators[0]
    name = ast.unparse(node.left).rpartition(".")[2]
    return isinstance(right, ast.Constant) and right.value is None and any(each in name for each in FEATURES)


def walked(run: Callable[[], Any]) -> tuple[int, int]:
    """Returns how many functions of the product a call runs through, and how often their module changes."""
    modules: list[str] = []

    def note(frame: FrameType, event: str, _: Any) -> None:
        name = frame.f_globals.get("__name__", "")
        if event == "call" and name.partition(".")[0] in PACKAGES:
            modules.append(name)

    sys.setprofile(note)
    try:
        run()
    finally:
        sys.setprofile(None)
    return len(modules), sum(one != other for one, other in pairwise(modules))


def functions_of(run: Callable[[], Any]) -> set[CodeType]:
    """Returns the functions of the product that a call runs through, without comprehensions and lambdas."""
    found: set[CodeType] = set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        package = frame.f_globals.get("__name__", "").partition(".")[0]
        if event == "call" and package in PACKAGES and frame.f_code.co_name[0] != "<":
            found.add(frame.f_code)

    sys.setprofile(note)
    try:
        run()
    finally:
        sys.setprofile(None)
    return found


def line_count(function: CodeType) -> int:
    """Returns how many lines a function has in its file, 0 if it has none."""
    return len(inspect.getsource(function).splitlines()) if Path(function.co_filename).exists() else 0


def step_of(env: gym.Env[Any, Any]) -> Callable[[], Any]:
    """Returns a step after some episodes, which met what usually arrives, with an action that no shield overrides."""
    env.reset(seed=0)
    action = 0.0 * env.action_space.sample()
    for _ in range(1000):
        if env.step(action)[3]:
            env.reset()
    return lambda: env.step(action)


FOLDERS = ("shields/runtime", "shields/verification", "ncs_gym/estimation", "ncs_gym/network", "ncs_gym/ellipsoid.py")
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

    def __str__(self) -> str:
        return f"{self.file}:{self.line}, {self.change}"

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
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and type(node.value) is not bool:
        before, node.value = node.value, node.value + 1 if isinstance(node.value, int) else 1.5 * node.value + 0.5
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
    for path in sorted((ROOT / folder).rglob("*.py")) or [ROOT / folder]:
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


def fate(stages: int, mutant: Mutant) -> str:
    """Returns the test that notices a mutant; an empty text if none does."""
    with tempfile.TemporaryDirectory() as folder:
        copied = Path(folder) / "copy"
        for name in subprocess.check_output(["git", "ls-files", "-z"], cwd=ROOT, text=True).split("\0")[:-1]:
            (copied / name).parent.mkdir(parents=True, exist_ok=True)
            if (ROOT / name).is_file():
                shutil.copyfile(ROOT / name, copied / name)
        (copied / mutant.file).write_text(mutant.source)
        package, *inner = Path(mutant.file).parts[:-1]
        nearest = inner[-1] if inner else f"test_{Path(mutant.file).name}"
        for tests in (f"tests/{package}/{nearest}", f"tests/{package}", "tests")[:stages]:
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


def mutants(count: int = 60, jobs: int = 2, only: Sequence[int] = (), stages: int = 3, list: bool = False) -> None:
    """So many small faults in what guarantees rest on, and the test of `make test` that notices each.

    A mutant is the program with one operator, comparison, condition or number changed. They are spread evenly over
    `FOLDERS`, always the same ones for the same source. Tests run in a copy of the repository, those of the same folder
    first, until one fails. What survives either needs a test or changes nothing (a constant that is larger than it must
    be, a search that is checked afterwards).
    --only are numbers of mutants; --stages is 1 for tests of the same folder, 2 of the package, 3 for all; --list names
    the mutants and runs nothing.
    """
    found = {number: each for number, each in enumerate(chosen(count)) if not only or number in only}
    if list:
        for number, each in found.items():
            print(f"{number:3d} {each}")
        return
    noticed = 0
    with ThreadPoolExecutor(jobs) as pool:
        for (number, mutant), test in zip(found.items(), pool.map(partial(fate, stages), found.values()), strict=True):
            noticed += bool(test)
            print(f"{number:3d} {mutant}: {test or 'SURVIVES'}", flush=True)
    print(f"{noticed} of {len(found)} noticed")


COMMANDS = (complexity, mutants)

if __name__ == "__main__":
    run(__doc__, COMMANDS)
