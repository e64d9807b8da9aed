"""What a linear model leaves out of the process that really moves: its bound, and how that is known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ncs_gym.uncertainty.declared_bound import as_bound
from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.validation import as_flag, shown


@dataclass(frozen=True, eq=False)
class Remainder:
    """f(x, u) - A x - B u lies in an ellipsoid, for x in the safe box and u within its limits.

    Attributes:
        bound: E(R) around the remainder, in units of the state.
        proved: Whether the bound follows from the equations of the process; False if it was found by sampling, so that
            every certificate *assumes* it.
        basis: Where the bound comes from, in a phrase.

    Raises:
        ValueError: If the bound is not an ellipsoid, `proved` no truth value, or `basis` no text.
    """

    bound: Ellipsoid
    proved: bool
    basis: str

    def __post_init__(self) -> None:
        if not isinstance(self.bound, Ellipsoid):
            raise ValueError(f"the bound of a remainder must be an Ellipsoid, got {shown(self.bound)}")
        object.__setattr__(self, "proved", as_flag(self.proved, "proved"))
        if not isinstance(self.basis, str):
            raise ValueError(f"the basis of a remainder must be text, got {shown(self.basis)}")

    @property
    def sentence(self) -> str:
        """What a certificate says about it."""
        kind = "bounded by proof" if self.proved else "assumed to lie in its bound"
        return f"What the linear model leaves out is {kind} while the state is in the box: {self.basis}."


def as_remainder(value: Any, n: int) -> Remainder | None:
    """Returns a remainder given as such or by the JSON value that the file of a plant holds; None for none.

    Raises:
        ValueError: If it is neither, or not of dimension n.
    """
    if value is None:
        return None
    if isinstance(value, dict) and set(value) == {"bound", "proved", "basis"}:
        bound = value["bound"]
        shape = bound["shape"] if isinstance(bound, dict) and set(bound) == {"shape"} else None
        value = Remainder(Ellipsoid(shape), value["proved"], value["basis"])  # pyright: ignore[reportArgumentType]
    if not isinstance(value, Remainder):
        raise ValueError(f"remainder must be a Remainder, got {shown(value)}")
    as_bound(value.bound, n, "remainder")
    return value
