"""Only tests of what constructors refuse make anything of the product themselves; the others ask `tests/product.py`."""

import ast
import inspect
from pathlib import Path

from ncs_gym import LinearPlant

TESTS = Path(__file__).resolve().parent
OWN_REFUSALS = {
    *("ncs_gym/test_refusals.py", "hardening/test_invalid_settings.py", "shields/runtime/test_refusals.py"),
    *(
        "ncs_gym/test_values.py",
        "ncs_gym/test_recording.py",
        "experiments/commands/test_bounds.py",
        "test_published_plants.py",
    ),  # plants from values
}
CLASSES = {"LinearPlant", "NCSEnv", "NCSVectorEnv", "SafetyShield", "VectorSafetyShield", "SafetyFilter", "SafeLoop"}
FUNCTIONS = {"synthesize", "linear_model", "family"}
OF_PLANTS = {*inspect.signature(LinearPlant).parameters}


def past_the_door(source):
    """The lines of a program that make something of the product themselves."""
    return sorted({node.lineno for node in ast.walk(ast.parse(source)) if makes(node)})


def makes(node):
    if isinstance(node, ast.ImportFrom):
        of_product = (node.module or "").startswith(("ncs_gym", "shields"))
        return of_product and FUNCTIONS & {each.name for each in node.names}
    if not isinstance(node, ast.Call):
        return False
    called = node.args[0] if getattr(node.func, "id", "") == "partial" else node.func
    name, owner = getattr(called, "attr", getattr(called, "id", "")), []
    if name in FUNCTIONS | {"make", "make_vec"} and isinstance(called, ast.Attribute):
        owner = ast.unparse(called.value).split(".")
    given = {each.arg for each in node.keywords}
    return (
        name in CLASSES
        or (owner in (["ncs_gym"], ["shields"], ["shields", "paper"]) and name in FUNCTIONS)
        or (name == "replace" and given & OF_PLANTS)
        or (owner == ["gym"] and "plant" in given and "LinearNCS" in ast.unparse(node.args[0]))
    )


def test_nothing_but_refusals_goes_past_the_door():
    found = {path.relative_to(TESTS).as_posix(): past_the_door(path.read_text()) for path in TESTS.rglob("*.py")}
    assert all(found.pop(name) for name in OWN_REFUSALS | {"product.py"})
    assert {name: lines for name, lines in found.items() if lines} == {}
