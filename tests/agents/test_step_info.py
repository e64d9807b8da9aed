"""The infos of a step: dictionaries in everything, whose values are taken out of arrays when they are read."""

import copy
import json
import pickle

import numpy as np
import pytest

from agents.step_info import step_infos

ARRAYS = {"cost": np.array([0.0, 1.0]), "input": np.array([[1.0, 2.0], [3.0, 4.0]])}
# What an info does as a dictionary of the same entries does, each on an info of its own.
SAME = {
    "keys": lambda info: list(info.keys()),
    "list": list,
    "reversed": lambda info: list(reversed(info)),
    "len": len,
    "bool": bool,
    "dict": lambda info: {key: np.array(value).tolist() for key, value in dict(info).items()},
    "unpacked": lambda info: sorted({**info, "more": 1}),
    "keywords": lambda info: sorted((lambda **given: given)(**{f"k{k}": v for k, v in enumerate(info.items())})),
    "merged": lambda info: sorted(info | {"more": 1}),
    "merged from the right": lambda info: sorted({"more": 1} | info),
    "update of another": lambda info: sorted((other := {"more": 1}, other.update(info))[0]),
    "get": lambda info: (info.get("cost"), info.get("none"), info.get("none", 7)),
    "in": lambda info: ("cost" in info, "none" in info, "TimeLimit.truncated" in info),
    "item": lambda info: info["cost"],
    "array": lambda info: info["input"].tolist(),
    "pop": lambda info: (info.pop("cost"), info.pop("cost", 3), "cost" in info),
    "setdefault": lambda info: (info.setdefault("cost", 5), info.setdefault("none", 5), info["none"]),
    "written": lambda info: (info.__setitem__("cost", 8.0), info["cost"], info.get("cost"), len(info)),
    "deleted": lambda info: (info.__delitem__("cost"), "cost" in info, info.get("cost", 4)),
    "updated": lambda info: (info.update(cost=2.0), info["cost"]),
    "in place": lambda info: (info.__ior__({"cost": 2.0})["cost"], len(info)),
    "cleared": lambda info: (info.clear(), len(info), info.get("cost"), "cost" in info),
    "copy": lambda info: sorted(info.copy()),
    "copied": lambda info: sorted(copy.copy(info)),
    "deep": lambda info: copy.deepcopy(info)["input"].tolist(),
    "pickled": lambda info: pickle.loads(pickle.dumps(info))["input"].tolist(),
    "repr": repr,
    "json": lambda info: json.dumps(info, default=lambda value: value.tolist(), sort_keys=True),
    "is a dict": lambda info: isinstance(info, dict),
    "items": lambda info: [key for key, _ in info.items()],
    "values": lambda info: len(list(info.values())),
    "popitem": lambda info: info.popitem()[0],
}


@pytest.mark.parametrize("what", SAME)
@pytest.mark.parametrize("read_before", [False, True])
def test_an_info_is_a_dictionary_in_everything(what, read_before):
    plain = {"TimeLimit.truncated": False, "cost": ARRAYS["cost"][1], "input": ARRAYS["input"][1]}
    info = step_infos(ARRAYS, 2)[1]
    if read_before:
        assert info["cost"] == 1.0
    assert SAME[what](info) == SAME[what](plain)


def test_an_info_equals_a_dictionary_of_the_same_entries():
    arrays = {"cost": np.array([0.0, 1.0])}
    assert step_infos(arrays, 2)[1] == {"TimeLimit.truncated": False, "cost": 1.0}
    assert step_infos(arrays, 2)[1] != {"TimeLimit.truncated": False, "cost": 0.0}
    with pytest.raises(KeyError, match="none"):
        step_infos(arrays, 2)[0]["none"]
    with pytest.raises(TypeError, match="unhashable"):
        hash(step_infos(arrays, 2)[0])


def test_code_that_reads_the_memory_of_an_info_fails_and_takes_it_for_no_empty_one():
    info = step_infos(ARRAYS, 2)[1]
    assert any(not isinstance(key, str) for key in dict.keys(info))  # what orjson and pyarrow see, and refuse
    assert len(info) == 3
    assert sorted(dict.keys(info)) == ["TimeLimit.truncated", "cost", "input"]
