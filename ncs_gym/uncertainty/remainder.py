"""What a linear model leaves out of the process that really moves: its bound, and how that is known."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import InitVar, dataclass, field
from typing import ClassVar, Self

import numpy as np

from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.uncertainty.family import Family
from ncs_gym.validation import as_flag, require_short_text, shown


@dataclass(frozen=True, eq=False)
class Remainder:
    """f(x, u) - A x - B u lies in an ellipsoid, for x in the safe box and u within its limits (both in common ones).

    The remainder that a plant keeps knows the model, the box and the limits of that plant, and no plant of others takes
    it over. Whether its bound is proved has to be said again with `dataclasses.replace`. Of a family, the plant that
    keeps it works the bound out of the members itself.

    Attributes:
        bound: E(R) around the remainder, in units of the state.
        proved: Whether the bound follows from the equations of the process; False if it was found by sampling, so that
            every certificate *assumes* it.
        basis: Where the bound comes from, in a phrase.
        family: The plants that the process is one of, of which each episode has another (`LinearPlant.family`); None if
            it is something else.
        is_proved: `proved`.

    Raises:
        ValueError: If the bound is not an ellipsoid, `proved` no truth value, `basis` no text, or `family` none.
    """

    bound: Ellipsoid
    proved: InitVar[bool]
    basis: str
    family: Family | None = None
    is_proved: bool = field(init=False)
    _model: ClassVar[Mapping[str, np.ndarray] | None] = None

    def __post_init__(self, proved: bool) -> None:
        if not isinstance(self.bound, Ellipsoid):
            raise ValueError(f"the bound of a remainder must be an Ellipsoid, got {shown(self.bound)}")
        object.__setattr__(self, "is_proved", as_flag(proved, "proved"))
        if not isinstance(self.basis, str):
            raise ValueError(f"the basis of a remainder must be text, got {shown(self.basis)}")
        require_short_text(self.basis, "the basis of a remainder")
        if not isinstance(self.family, Family | None):
            raise ValueError(f"the family of a remainder must be a Family, got {shown(self.family)}")

    def of_model(self, model: Mapping[str, np.ndarray]) -> Self:
        """Returns the same remainder, which from now on belongs to this model alone.

        Args:
            model: What the bound depends on, by the name of the plant's argument: A, B, box, u_max, dt and
                mixed_limits, of which there may be more, a row each.

        Raises:
            ValueError: If it belongs to another model.
        """
        if self._model is not None:
            own = dict(self._model)
            if all((model["mixed_limits"] == row).all(axis=1).any() for row in own["mixed_limits"]):
                own["mixed_limits"] = model["mixed_limits"]
            others = [name for name, value in model.items() if not np.array_equal(value, own[name])]
            if others:
                raise ValueError(
                    f"the remainder belongs to a plant with another {', '.join(others)}: find the model anew by "
                    "ncs_gym.linear_model, or give Remainder(bound, proved, basis) anew if it holds for this plant, too"
                )
            return self
        own = copy.copy(self)
        object.__setattr__(own, "_model", {name: np.array(value) for name, value in model.items()})
        return own

    @property
    def sentence(self) -> str:
        """What a certificate says about it."""
        kind = "bounded by proof" if self.is_proved else "assumed to lie in its bound"
        return f"What the linear model leaves out is {kind} while the state is in the box: {self.basis}."
