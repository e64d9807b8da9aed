"""Tasks and disturbances that all environments of a vector share: one object, called for one after the other."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import numpy as np


def begun_many(shared: Any, rng: np.random.Generator, plant: Any, count: int) -> np.ndarray:
    """Returns what `begin` of a task or a disturbance draws for `count` episodes, along the last axis."""
    with storing_nothing(shared):
        if shared.vectorized:
            return shared.begin(rng, plant, count)
        states = np.empty(count, dtype=object)
        for episode in range(count):
            states[episode] = shared.begin(rng, plant)
        return states


@contextmanager
def storing_nothing(shared: Any) -> Iterator[None]:
    """Raises ValueError if code of others stores something in an object that many environments share."""
    before = _stored(shared)
    yield
    for name, (value, image) in _stored(shared).items():
        if name not in before or before[name][0] is not value or before[name][1] != image:
            raise ValueError(
                f"{type(shared).__name__} stores {name!r} in itself, which all environments of a vector share: keep it "
                "in what begin returns"
            )


def _stored(shared: Any) -> dict[str, tuple[Any, Any]]:
    """Returns the attributes of an object but those that are computed once, each with what shows a change inside."""

    def image(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return value.tobytes() if value.flags.writeable else None
        entries = value.values() if isinstance(value, dict) else value
        return list(map(id, entries)) if isinstance(value, list | dict | set | deque) else None

    kind = type(shared)
    return {
        name: (value, image(value))
        for name, value in vars(shared).items()
        if not isinstance(getattr(kind, name, None), cached_property)
    }
