"""How much code there is, and how much of it a step runs through.

    python benchmarks/complexity.py

Lines of the product and of the tests; branches that ask whether a feature is there at all (`x is None` of a contract, a
polytope, a grid, a remainder, a plan, a downlink, ages); and calls of functions of the product in one step of an
environment, as it comes and behind a shield whose action passes, and how often the module changes from one to the next.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import Any

import gymnasium as gym

import ncs_gym
from shields import SafetyShield, synthesize

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("ncs_gym", "shields", "agents", "experiments")
FEATURES = ("contract", "polytope", "grid", "remainder", "lookahead", "downlink", "ages", "between", "protocol")
CASE = "ncs_gym/TruckTrailerCruise-v0"


def sources(*folders: str) -> list[Path]:
    """Returns the Python files below some folders."""
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


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


def step_of(env: gym.Env[Any, Any]) -> Callable[[], Any]:
    """Returns a step after some others, with an action that no shield overrides."""
    env.reset(seed=0)
    action = 0.0 * env.action_space.sample()
    for _ in range(50):
        env.step(action)
    return lambda: env.step(action)


def main() -> None:
    """Prints all of it."""
    product, tests = sources(*PACKAGES), sources("tests")
    nodes = [node for path in product for node in ast.walk(ast.parse(path.read_text()))]
    print(f"{lines(product):,} lines of the product in {len(product)} modules, {lines(tests):,} of tests")
    print(f"{sum(map(asks_for_feature, nodes))} branches ask whether a feature is there")
    for name, env in {"a step": gym.make(CASE), "a shielded step": SafetyShield(gym.make(CASE))}.items():
        calls, changes = walked(step_of(env))
        print(f"{name}: {calls} calls, {changes} changes of module")
    plant = ncs_gym.truck_trailer(mass=4000.0)
    calls, changes = walked(lambda: synthesize(plant))
    print(f"synthesize: {calls:,} calls, {changes:,} changes of module")


if __name__ == "__main__":
    main()
