"""Messages of errors: one sentence each, and every class of ours is met by a test."""

import pickle
import re
from pathlib import Path

from shields import Infeasible
from tests.test_docs import exceptions, resolved


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
