"""What the constructor of a plant says about arguments that it does not have, or lacks."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import MISSING, fields
from difflib import get_close_matches
from typing import Any, TypeVar

Kind = TypeVar("Kind", bound=type)


def explains_arguments(kind: Kind) -> Kind:
    """Makes the constructor of a dataclass explain which arguments are unknown or missing, and what to give for C=.

    C= means two things to two people: limits, and an output matrix.
    """
    constructor: Any = kind
    construct: Callable[..., None] = constructor.__init__
    needed = {entry.name: entry.default is MISSING and entry.default_factory is MISSING for entry in fields(kind)}

    @functools.wraps(construct)
    def __init__(self: Any, **settings: Any) -> None:
        if "C" in settings:
            raise ValueError(
                "C= is not an argument: pass box=... for the limits |c_j x| <= 1 (rows, or half-widths of the states), "
                "H=... for the output matrix of a state-space model"
            )
        for name in settings:
            if name not in needed:
                close = get_close_matches(name, needed, n=1)
                hint = f": did you mean {close[0]}=" if close else ""
                raise TypeError(f"{name}= is not an argument of {kind.__name__}{hint}")
        missing = [f"{name}=" for name, is_needed in needed.items() if is_needed and name not in settings]
        if missing:
            raise TypeError(f"{kind.__name__} needs {' and '.join(missing)}")
        construct(self, **settings)

    constructor.__init__ = __init__
    return kind
