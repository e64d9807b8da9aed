"""Tests make plants, loops, shields and certificates through `tests/product.py` alone."""

import ast
import inspect
from pathlib import Path

import pytest

from ncs_gym import LinearPlant

TESTS = Path(__file__).resolve().parent
# They are about what the constructors themselves refuse.
OWN_REFUSALS = {"ncs_gym/test_refusals.py", "hardening/test_invalid_settings.py", "shields/runtime/test_refusals.py"}
CLASSES = {"LinearPlant", "NCSEnv", "NCSVectorEnv", "SafetyShield", "VectorSafetyShield", "SafetyFilter", "SafeLoop"}
METHODS = {"from_statespace", "family", "resampled", "with_rate_limits"}
FUNCTIONS = {"synthesize", "linear_model"}
LIBRARY = {"truck_trailer", "cart_pole", "batch_reactor", "stirred_tank", "lane_keeping", "convoy"}
OF_PLANTS = {*inspect.signature(LinearPlant).parameters} - {"dt"}
# Of a certificate, a family or a case of the published method, too.
SHARED = {"A", "B", "between_samples"}


def past_the_door(source):
    """Yields the lines of a program that make something of the product themselves."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(("ncs_gym", "shields")):
            if FUNCTIONS & {each.name for each in node.names}:
                yield node.lineno
        elif isinstance(node, ast.Call):
            made = node.args[0] if ast.unparse(node.func) == "partial" else node.func
            *owner, name = ast.unparse(made).split(".")
            given = {each.arg for each in node.keywords}
            if (
                name in CLASSES
                or (owner and name in METHODS)
                or (owner in (["ncs_gym"], ["shields"], ["shields", "paper"]) and name in FUNCTIONS)
                or (name in LIBRARY and given & (OF_PLANTS | {None}))
                or (name == "replace" and given & (OF_PLANTS - SHARED))
                or (owner == ["gym"] and "plant" in given and "LinearNCS" in ast.unparse(node.args[0]))
            ):
                yield node.lineno


def test_nothing_is_made_past_the_door():
    found = []
    for path in sorted(TESTS.rglob("*.py")):
        name = path.relative_to(TESTS).as_posix()
        if name not in OWN_REFUSALS | {"product.py"}:
            found += [f"{name}:{line}" for line in past_the_door(path.read_text())]
    assert found == []


@pytest.mark.parametrize("name", sorted(OWN_REFUSALS | {"product.py"}))
def test_what_may_go_past_the_door_does(name):
    assert list(past_the_door((TESTS / name).read_text()))


@pytest.mark.parametrize(
    "line",
    [
        "LinearPlant(**given)", "ncs_gym.NCSEnv(plant)", "partial(SafetyShield, env)", "plant.resampled(0.1)",
        "from shields.paper import synthesize as own", "shields.synthesize(plant)", "truck_trailer(gamma=0.0)",
        "replace(plant, u_max=1.0)", "gym.make('ncs_gym/LinearNCS-v0', plant=plant)",
    ],
)  # fmt: skip
def test_calls_past_the_door_are_found(line):
    assert list(past_the_door(line)) == [1]
