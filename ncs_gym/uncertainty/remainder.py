"""What a linear model leaves out of the process that really moves: its bound, and how that is known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from ncs_gym.bounds import as_set
from ncs_gym.uncertainty.ellipsoid import Ellipsoid, UncertainSet
from ncs_gym.uncertainty.family import Family
from ncs_gym.validation import as_flag, require_short_text, shown


@dataclass(frozen=True, eq=False)
class Remainder(UncertainSet):
    """f(x, u) - A x - B u lies in an ellipsoid, for x and u within the limits: a part of `Bounds.disturbance`.

    It belongs to the model and the limits of one plant. That of a family is worked out from the members.

    Attributes:
        bound: E(R), in units of the state.
        proved: Whether the bound follows from the equations of the process; if it was sampled, certificates assume it.
        basis: Where the bound comes from, in a phrase.
        family: The plants of which each episode has another (`ncs_gym.family`); None if the process is something else.
        belongs_to: `LinearPlant.region` of the plant that it belongs to; None before any has it.

    Raises:
        ValueError: If one of these is of another kind.
    """

    bound: Any
    proved: bool
    basis: str
    family: Any = None
    belongs_to: str | None = None
    is_left_out: ClassVar[bool] = True

    def __post_init__(self) -> None:
        bound = as_set(self.bound) if isinstance(self.bound, Mapping) else self.bound  # of a document
        family = Family(**self.family) if isinstance(self.family, Mapping) else self.family
        if not (isinstance(bound, Ellipsoid) and isinstance(self.basis, str) and isinstance(family, Family | None)):
            found = f"{shown(bound)}, {shown(self.basis)} and {shown(family)}"
            raise ValueError(f"a remainder has an Ellipsoid, a text as its basis and a Family or None, got {found}")
        require_short_text(self.basis, "the basis of a remainder")
        self._set(bound=bound, family=family, proved=as_flag(self.proved, "proved"), size=bound.dim)

    def ellipsoid(self, weight: np.ndarray | None = None) -> Ellipsoid:  # noqa: D102
        return self.bound

    def of_plant(self, plant: Any) -> Remainder:
        """Returns the same remainder as that of this plant, of a family anew; raises ValueError if it is another's."""
        if self.family is not None:
            return Remainder(self.family.bound_for(plant), True, self.family.basis, self.family)
        if self.belongs_to not in (None, plant.region):
            raise ValueError(
                "the remainder belongs to a plant with another model, limits or operating point: find the model anew "
                "by ncs_gym.linear_model, or give Remainder(bound, proved, basis) anew if it holds for this plant, too"
            )
        return self if self.belongs_to else replace(self, belongs_to=plant.region)

    @property
    def numbers(self) -> list[tuple[str, Any]]:
        """What identifies a plant with it."""
        members = [] if self.family is None else [("members", self.family.members)]
        return [("remainder", self.bound.shape_matrix), ("proved", self.proved), *members]

    @property
    def sentence(self) -> str:
        """What a certificate says about it."""
        kind = "bounded by proof" if self.proved else "assumed to lie in its bound"
        return f"What the linear model leaves out is {kind} while the state is in the box: {self.basis}."
