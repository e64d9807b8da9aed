"""Messages of errors: one sentence each, and every class of ours is met by a test."""

import ast
import pickle
import re
from pathlib import Path

from shields import Infeasible
from tests.test_docs import PACKAGES, ROOT, exceptions, resolved


def raised():
    """Where something is raised, and its message with what is filled in as X."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                call = node.exc if isinstance(node, ast.Raise) else None
                if isinstance(call, ast.Call) and call.args and isinstance(call.args[0], ast.Constant | ast.JoinedStr):
                    yield f"{path.relative_to(ROOT)}:{node.lineno}", text_of(call.args[0])


def text_of(node):
    parts = node.values if isinstance(node, ast.JoinedStr) else [node]
    return "".join(str(part.value) if isinstance(part, ast.Constant) else "X" for part in parts)


def test_every_message_is_one_sentence():
    messages = dict(raised())
    assert len(messages) > 100
    for place, text in messages.items():
        assert not re.search(r"[.!?] [A-Z]|\n", text), (place, text)
        assert not text.endswith((".", "!", " ")), (place, text)


def test_every_class_of_ours_is_expected_by_a_test():
    """Beside `pytest.raises` or `pytest.warns`, or in a row of a table of refusals."""
    expected = set()
    for path in Path(__file__).parent.rglob("test_*.py"):
        text = path.read_text()
        for beside in re.findall(r"pytest\.(?:raises|warns)\((\([^)]*\)|[\w.]+)", text):
            expected |= set(re.findall(r"\w+", beside))
        if path.name == "test_refusals.py":
            expected |= set(re.findall(r"\w+Error\b", text.split("\n\n\n", 1)[1]))
    assert {name for _, name in exceptions()} - expected == set()


def test_every_class_of_ours_says_what_it_is_and_survives_pickling():
    for module, name in exceptions():
        kind = resolved(f"{module}.{name}")
        assert re.match(r"[A-Z].*\.", kind.__doc__), name
        error = kind("why") if kind is not Infeasible else kind("why", "U", 0.5)
        copy = pickle.loads(pickle.dumps(error))
        assert type(copy) is kind, name
        assert str(copy) == str(error), name
