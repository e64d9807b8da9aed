"""The infos of a step of a vector environment, one dictionary for each environment, at the price of empty ones."""

from __future__ import annotations

from collections.abc import Callable
from itertools import repeat
from typing import Any

import numpy as np

# What an info has before its values are taken out of the arrays. The first key is there whether an episode ends or not,
# as under stable-baselines3's own vector environments. The second is no text: code that reads a dictionary's memory
# instead of asking it (orjson, pyarrow) fails there, where it would take the info for an empty one.
_UNTAKEN = object()
_GOES_ON = {"TimeLimit.truncated": False, _UNTAKEN: "values are taken when they are read: pass dict(info)"}


def step_infos(arrays: dict[str, np.ndarray], count: int) -> list[dict[str, Any]]:
    """Returns an info for each environment, in which no episode ends.

    Args:
        arrays: The infos of all, with the environment as first axis; nobody may write into them any more.
        count: How many environments there are.
    """
    return list(map(StepInfo, repeat(arrays), range(count)))


def _of_all_keys(name: str) -> Callable[..., Any]:
    """Returns a method of `dict` that is about all keys, or writes: it takes all values out of the arrays before."""
    method = getattr(dict, name)

    def call(info: StepInfo, *args: Any, **kwargs: Any) -> Any:
        info.take_all()
        return method(info, *args, **kwargs)

    call.__name__ = name
    return call


class StepInfo(dict):
    """The info of an environment at a step: a dictionary that takes its values out of arrays when they are read.

    Making dictionaries with all values would take longer than a step of the environments does.

    Args:
        arrays: The infos of all environments, with the environment as first axis.
        e: Number of the environment.
    """

    __slots__ = ("_arrays", "_e")

    def __init__(self, arrays: dict[str, np.ndarray], e: int) -> None:
        dict.__init__(self, _GOES_ON)
        self._arrays, self._e = arrays, e

    def __missing__(self, key: Any) -> Any:
        return self._arrays[key][self._e]

    def __contains__(self, key: object) -> bool:
        return key in self._arrays or dict.__contains__(self, key)

    def get(self, key: Any, default: Any = None) -> Any:
        """Returns the value of a key, or a default where there is no such key."""
        return self._arrays[key][self._e] if key in self._arrays else dict.get(self, key, default)

    def take_all(self) -> None:
        """Takes all values out of the arrays; from then on it is a dictionary like any other."""
        arrays, self._arrays = self._arrays, {}
        dict.pop(self, _UNTAKEN, None)
        for key, value in arrays.items():
            dict.__setitem__(self, key, value[self._e])

    def copy(self) -> dict[str, Any]:
        """Returns a dictionary of its own."""
        return dict(self)

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (dict(self),)

    __copy__ = copy
    __iter__ = _of_all_keys("__iter__")
    __reversed__ = _of_all_keys("__reversed__")
    __len__ = _of_all_keys("__len__")
    __eq__ = _of_all_keys("__eq__")
    __ne__ = _of_all_keys("__ne__")
    __repr__ = _of_all_keys("__repr__")
    __or__ = _of_all_keys("__or__")
    __ror__ = _of_all_keys("__ror__")
    __ior__ = _of_all_keys("__ior__")
    __setitem__ = _of_all_keys("__setitem__")
    __delitem__ = _of_all_keys("__delitem__")
    keys = _of_all_keys("keys")
    values = _of_all_keys("values")
    items = _of_all_keys("items")
    pop = _of_all_keys("pop")
    popitem = _of_all_keys("popitem")
    setdefault = _of_all_keys("setdefault")
    update = _of_all_keys("update")
    clear = _of_all_keys("clear")
    __hash__ = None
