"""Immutable settings: dataclasses whose arrays cannot be written to, attributes that cannot be set anew."""

from __future__ import annotations

import copy
import sys
import warnings
from operator import attrgetter
from pathlib import PurePath
from typing import Any, Self

import numpy as np

# Entries beyond this would overflow when squared twice; what is divided by is no smaller than its inverse.
LARGEST_NUMBER, SMALLEST_NUMBER = 1e75, 1e-75
# Steps and environments are counted in 32 bits.
LARGEST_COUNT = 2**31 - 1
# Messages quote no more of a value than this many letters, and names and phrases of plants have no more.
MAX_QUOTED_LENGTH, LONGEST_TEXT = 200, 1000
# What a covariance may lack of a symmetric, positive semidefinite one, in units of its deviations: roundings of
# float32; what an eigenvalue lacks by rounding of float64 alone is no reason to change it.
COVARIANCE_ROUNDING, EIGENVALUE_ROUNDING = 1e-6, 1e-12
# Default of a field that `__post_init__` puts a value in place of: None, but never seen as that from outside.
FILLED_IN_LATER: Any = None


# The packages, what makes their dataclasses, and what wrappers and `np.errstate` put between.
_OURS = "ncs_gym.", "shields.", "gymnasium.", "dataclasses", "numpy._core."


def warn_caller(text: str, category: type[Warning]) -> None:
    """Warns the first caller outside these packages and gymnasium."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith(_OURS):
        level, frame = level + 1, frame.f_back
    warnings.warn(text, category, stacklevel=level)


class ReadOnlyArrays:
    """Mixin that keeps the array fields of a frozen dataclass read-only.

    Copies, as `gym.make` makes of keyword arguments, and pickles of a read-only array are writable again; so a copy is
    the object itself, and unpickling freezes anew.
    """

    def _make_arrays_read_only(self) -> None:
        self._set(**vars(self))

    def _set(self, **values: Any) -> None:
        """Puts values in place of fields, with arrays read-only."""
        for name, value in values.items():
            held = isinstance(value, np.ndarray) or type(value) is tuple
            object.__setattr__(self, name, frozen_inside(value) if held else value)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._make_arrays_read_only()

    def __copy__(self) -> Self:
        return self

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self


class CopiedWhole:
    """Mixin for what changes from step to step: shallow copies share nothing with it either."""

    def __copy__(self) -> Self:
        return copy.deepcopy(self)


def setting(name: str, kept_as: str | None = None) -> Any:
    """Returns a read-only property of an attribute, also of a part ("part.attribute"); by default `_name`."""
    return property(attrgetter(kept_as or f"_{name}"))


class AroundEnvironments:
    """Mixin of wrappers of vector environments: their specification says that they are there, as single ones' does.

    Gymnasium's leave themselves out, so that `gym.make_vec` would make environments without a shield or a network of
    it, which is refused with this.
    """

    env: Any

    @property
    def spec(self) -> Any:
        """A copy of the specification, with the wrappers around; None where there is none."""
        from gymnasium.envs.registration import WrapperSpec

        if (inside := self.env.spec) is None:
            return None
        kind, kwargs = type(self), getattr(self, "_saved_kwargs", None)
        own = WrapperSpec(kind.__name__, f"{kind.__module__}:{kind.__name__}", kwargs)
        spec = copy.deepcopy(inside)
        spec.additional_wrappers += (own,)
        return spec


def read_only(array: np.ndarray) -> np.ndarray:
    """Returns a read-only copy of `array`."""
    return frozen(array.copy())


def frozen_inside(value: Any) -> Any:
    """Returns read-only copies of arrays, also of those in lists and tuples, which become tuples."""
    if isinstance(value, np.ndarray):
        return read_only(value)
    return tuple(map(frozen_inside, value)) if type(value) in (list, tuple) else value


def as_given(value: Any) -> Any:
    """Returns a setting of numbers as it was given, frozen: lists as tuples, others as arrays."""
    if isinstance(value, list | tuple):
        return tuple(map(as_given, value))
    numbers = None if isinstance(value, bool | int | float | None) else as_setting(value)
    return value if numbers is None else frozen(numbers)


def frozen(array: np.ndarray) -> np.ndarray:
    """Returns the array itself, made read-only."""
    array.setflags(write=False)
    return array


def guarded(array: np.ndarray) -> np.ndarray:
    """Returns a read-only view of an array for code of others."""
    return frozen(array.view())


def require_batched_infos(info: Any, outside: str) -> None:
    """Raises ValueError unless the infos of a vector environment are a dictionary, as the wrapper outside needs."""
    if not isinstance(info, dict):
        text = f"{outside} reads infos as a dictionary, and a wrapper inside makes a list of them"
        raise ValueError(f"{text}: put it outside of {outside}")


def printable(text: str) -> str:
    """Returns a text whose characters that are not printed are escaped."""
    return "".join(each if each.isprintable() else repr(each)[1:-1] for each in text)


def counted(number: int, noun: str) -> str:
    """Returns a number of things in words: 1 step, 2 steps."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def as_numbers(value: Any) -> np.ndarray | None:
    """Returns `value` as a float64 array; None for what is not real numbers."""
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value
    try:
        array = np.asarray(value)
        if isinstance(value, np.ma.MaskedArray) or array.dtype.kind not in "fiub":
            return None
        with np.errstate(all="ignore"):
            return array.astype(np.float64)
    except Exception:
        return None


def shown(value: Any) -> str:
    """Returns a value, or a path as it is, as messages quote it: on one line, and not without end."""
    try:
        return _quoted(str(value) if isinstance(value, PurePath) else repr(value))
    except Exception:
        return f"a {type(value).__name__}"


def reason_of(error: BaseException) -> str:
    """Returns what an error says, as messages quote it; its type if it says nothing."""
    return _quoted(str(error)[: 2 * MAX_QUOTED_LENGTH]).rstrip(".") or type(error).__name__


def _quoted(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= MAX_QUOTED_LENGTH else f"{text[:MAX_QUOTED_LENGTH]}..."


def as_setting(value: Any) -> np.ndarray | None:
    """Returns a new float64 array; None for text, truth values, complex or masked numbers."""
    numbers = as_numbers(value)
    return None if numbers is None or np.asarray(value).dtype.kind == "b" else np.array(numbers)


def as_matrix(value: Any, shape: tuple[int | None, ...], name: str) -> np.ndarray:
    """Returns `value` as a finite float64 matrix or vector of a shape, in which None stands for any positive number.

    Raises:
        ValueError: If it is not numeric, has another shape, or holds a NaN or an infinity.
    """
    array, kind = as_setting(value), "vector" if len(shape) == 1 else "matrix"
    if array is None:
        raise ValueError(f"{name} must be a {kind} of numbers, got {shown(value)}")
    expected = str(tuple("any" if size is None else size for size in shape)).replace("'", "")
    if array.ndim != len(shape) or not all(
        have > 0 and want in (None, have) for have, want in zip(array.shape, shape, strict=True)
    ):
        raise ValueError(f"{name} must have shape {expected}, got {array.shape}")
    if not (np.abs(array) < LARGEST_NUMBER).all():
        raise ValueError(f"{name} must be finite and below {LARGEST_NUMBER:g} in size, got {shown(array.tolist())}")
    return array


def as_vector(value: Any, size: int | None, name: str) -> np.ndarray:
    """Returns `as_matrix` of a vector of the expected size (None: any)."""
    return as_matrix(value, (size,), name)


def as_covariance(value: Any, size: int | None, name: str) -> np.ndarray:
    """Returns `value` as a symmetric positive semidefinite (size, size) matrix (None: of any size).

    One that lacks that by rounding, in units of its own deviations, is given a little more variance.

    Raises:
        ValueError: If it is none.
    """
    matrix = as_matrix(value, (size, size), name)
    if size is None:
        matrix = as_matrix(matrix, (len(matrix), len(matrix)), name)
    variances = np.diag(matrix)
    deviations = np.sqrt(np.maximum(variances, 0.0))
    units = np.outer(deviations, deviations)
    if (np.abs(matrix - matrix.T) > COVARIANCE_ROUNDING * units).any():
        raise ValueError(f"{name} must be symmetric, got {shown(matrix.tolist())}")
    matrix = 0.5 * (matrix + matrix.T)
    kept = variances > 0.0
    correlations = matrix[kept][:, kept] / units[kept][:, kept]
    smallest = float(np.linalg.eigvalsh(correlations)[0]) if kept.any() else 0.0
    if smallest < -COVARIANCE_ROUNDING or matrix[~kept].any():
        least = float(np.linalg.eigvalsh(matrix)[0])
        raise ValueError(f"{name} must be positive semidefinite, its smallest eigenvalue is {least:.3g}")
    return matrix + COVARIANCE_ROUNDING * np.diag(variances) if smallest < -EIGENVALUE_ROUNDING else matrix


def as_number(value: Any, name: str, *, low: float = -np.inf, high: float = np.inf, low_open: bool = False) -> float:
    """Returns `value` as a finite float inside an interval, or raises ValueError."""
    wanted = f"{'>' if low_open else '>='} {low:g}" if np.isfinite(low) else "finite"
    wanted += f" and <= {high:g}" if np.isfinite(high) else ""
    try:
        single = as_setting(float(value) if type(value) is int else value)  # numpy knows no longer ones
    except OverflowError:
        single = None
    number = np.nan if single is None or single.ndim else float(single)
    above = number > low if low_open else number >= low
    if not (np.isfinite(number) and above and number <= high):
        raise ValueError(f"{name} must be a number {wanted}, got {shown(value)}")
    bounded = np.isfinite(low) and np.isfinite(high)
    if not (bounded or number == 0.0 or SMALLEST_NUMBER <= abs(number) < LARGEST_NUMBER):
        raise ValueError(f"{name} must be between {SMALLEST_NUMBER:g} and {LARGEST_NUMBER:g} in size, got {number!r}")
    return number


def as_names(value: Any, default: tuple[str, ...], name: str) -> tuple[str, ...]:
    """Returns short texts as a tuple of the length of `default`, which stands for none at all, or raises ValueError."""
    if not isinstance(value, (list, tuple)) or not all(isinstance(each, str) for each in value):
        raise ValueError(f"{name} must be a list of texts, got {shown(value)}")
    for each in value:
        require_short_text(each, name)
    if value and len(value) != len(default):
        raise ValueError(f"{name} must have {len(default)} entries, got {shown(value)}")
    return tuple(value) or default


def require_short_text(text: str, name: str) -> None:
    """Raises ValueError unless a text is printable and has at most `LONGEST_TEXT` letters."""
    if len(text) > LONGEST_TEXT or not text.isprintable():
        raise ValueError(f"{name} must be printable text of at most {LONGEST_TEXT} letters, got {shown(text)}")


def as_flag(value: Any, name: str) -> bool:
    """Returns `value` if it is a bool, or raises ValueError."""
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} must be True or False, got {shown(value)}")
    return bool(value)


def as_count(value: Any, name: str, *, low: int, high: int = LARGEST_COUNT) -> int:
    """Returns a whole number from `low` to `high`, which a bool is not, or raises ValueError."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)) or value < low:
        raise ValueError(f"{name} must be a whole number >= {low}, got {shown(value)}")
    if value > high:
        raise ValueError(f"{name} must be a whole number <= {high}, got {shown(value)}")
    return int(value)
