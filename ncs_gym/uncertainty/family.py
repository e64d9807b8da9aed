"""The members of a family of plants that differ in A and B and in where they rest, of which each episode has one."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any

import numpy as np

from ncs_gym import exact
from ncs_gym.bounds import Box
from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.uncertainty.shape_matrices import outer_sum
from ncs_gym.validation import ReadOnlyArrays, as_flag, as_matrix, as_names, as_numbers, as_vector, read_only, shown

if TYPE_CHECKING:
    from ncs_gym.plants.linear_plant import LinearPlant


# Plants of a function at about so many points of the ranges check that its entries are monotone.
GRID = 256
# Growth of the bound for the rounding of sums.
ROUNDING = 1e-9


@dataclass(frozen=True, eq=False, kw_only=True)
class Family(ReadOnlyArrays):
    """Plants x+ = A_i x + B_i u + s_i + d in deviations from one point, where the step is s_i (`ncs_gym.family`).

    Attributes:
        names: Of the parameters; "member", which counts from 0, for plants without any.
        parameters: Of the members listed, shape (N, k): plants, or the corners of a function.
        members: [A_i, B_i, s_i] of these, shape (N, n, n + m + 1).
        function: Returns the plant of parameters between those listed; None if there are no others. No file holds it.
        interval: Low and high entries of [A, B, s] of all that the function returns, shape (2, n, n + m + 1).
        center: State and input that deviations are counted from, shape (n + m,); None is zero.
        at_rest: Whether it is given that every member rests at its own operating point.
        check: Raises ValueError unless a plant that the function returned differs from the others in [A, B, s] alone.

    Raises:
        ValueError: If a shape is wrong, or a family of parameters has no interval.
    """

    names: Sequence[str]
    parameters: np.ndarray
    members: np.ndarray
    function: Callable[..., LinearPlant] | None = None
    interval: np.ndarray | None = None
    center: np.ndarray | None = None
    at_rest: bool = False
    check: Callable[[LinearPlant], None] | None = None

    def __post_init__(self) -> None:
        members, interval = as_numbers(self.members), self.interval
        if members is None or members.ndim != 3 or not len(members) or not np.isfinite(members).all():
            raise ValueError(f"members of a family must be finite, shape (N, n, n + m + 1), got {shown(members)}")
        parameters = as_matrix(self.parameters, (len(members), None), "the parameters of a family")
        default = tuple(f"p{number + 1}" for number in range(parameters.shape[1]))
        names = as_names(self.names, default, "the names of parameters")
        of_plants = interval is None and self.function is None
        if of_plants != (names == ("member",)) or (self.function is not None and (interval is None or not self.check)):
            raise ValueError(
                "a family of parameters needs interval, one of a function check, and one of plants neither"
            )
        if interval is not None:
            interval = as_numbers(interval)
            if interval is None or interval.shape != (2, *members.shape[1:]):
                raise ValueError(f"the interval of a family must have shape {(2, *members.shape[1:])}")
            if not ((interval[0] <= members) & (members <= interval[1])).all():
                raise ValueError("the members of a family must lie in its interval")
        center = None if self.center is None else as_vector(self.center, members.shape[2] - 1, "the center")
        self._set(names=names, parameters=parameters, members=members, interval=interval, center=center)
        self._set(at_rest=as_flag(self.at_rest, "at_rest"))

    @property
    def document(self) -> dict[str, Any]:
        """What a file holds: all but the function. A family read from it is that of the members listed."""
        names = "names", "parameters", "members", "interval", "center", "at_rest"
        return {name: getattr(self, name) for name in names}

    def bound_for(self, plant: LinearPlant) -> Ellipsoid:
        """Returns what the plant of the middle leaves out of every member, in the dimension of its own states.

        Raises:
            ValueError: If members do not fit the plant, or differ in what an unlimited state does.
        """
        n, size = plant.n, (plant.n, plant.n + plant.m + 1)
        point = np.concatenate([plant.operating_state, plant.operating_input])
        if self.members.shape[1:] != size:
            raise ValueError(f"members of the family must be [A, B, s] of shape {size}, got {self.members.shape[1:]}")
        if not np.array_equal(point, np.zeros(len(point)) if self.center is None else self.center):
            raise ValueError("the members of the family are in deviations from another operating point: make it anew")
        listed = self.members if self.interval is None else self.interval
        off = np.abs(listed - np.column_stack([plant.A, plant.B, np.zeros(n)]))
        if self.interval is not None:
            off = off.max(axis=0, keepdims=True)
        own = n - plant.past
        if off[:, own:].any():
            raise ValueError("the members of the family must have the past inputs of the plant of the middle")
        differs, reach = off.any(axis=(0, 1)), np.append(plant.reach, 1.0)
        if free := np.flatnonzero(differs & np.isinf(reach)).tolist():
            raise ValueError(f"the members differ in what {plant.state_names[free[0]]} does: give it generous limits")
        reach = np.where(differs, reach, 0.0)
        sizes = (1.0 + ROUNDING) * np.max([exact.product(each, reach) for each in off], axis=0)[:own]
        sides = [Box(-row, row).ellipsoid().shape_matrix for row in np.diag(sizes) if row.any()]
        if not sides:
            return Ellipsoid(np.zeros((own, own)))
        weight = plant.relative_weight[:own, :own]
        return Ellipsoid(reduce(lambda one, other: outer_sum(one, other, weight), sides))

    @property
    def basis(self) -> str:
        """Which plants the bound is for, and what is given of them, in a phrase."""
        if self.interval is None:
            text = f"for the convex hull of {len(self.members)} plants"
        else:
            ends = zip(self.names, *self.ranges.tolist(), strict=True)
            entries = "A, B and the step at the middle of the operating points" if self._steps else "A and B"
            ranges, k = ", ".join(f"{name} from {low:g} to {high:g}" for name, low, high in ends), len(self.names)
            points = f"{grid_size(k) ** k:,} points"
            text = f"for {ranges}, entries of {entries} being monotone in each (given, and checked at {points})"
        return text + ", each being at rest at its operating point (given)" * (self.at_rest or self._steps)

    @property
    def _steps(self) -> bool:
        """Whether a member rests elsewhere."""
        return bool(self.members[..., -1].any())

    @cached_property
    def ranges(self) -> np.ndarray:
        """The low and the high ends of the parameters, shape (2, k)."""
        return read_only(np.array([self.parameters.min(axis=0), self.parameters.max(axis=0)]))

    def read(self, given: Any, size: int | None, *, anywhere: bool = False) -> np.ndarray:
        """Returns the parameters that an option of `reset` fixes, shape (k,) or (size, k); NaN where it fixes none.

        Args:
            given: A dictionary of some parameters, each a number or shape (size,), or None; or all of them in the order
                of `names`, shape (k,) or (size, k), as infos have them.
            size: Number of environments; None without that axis.
            anywhere: Whether parameters beyond their ranges are allowed.

        Raises:
            ValueError: If it is no such dictionary, or there is no such member.
        """
        values = np.full((1 if size is None else size, len(self.names)), np.nan)
        in_order = None if isinstance(given, Mapping) else as_numbers(given)
        if in_order is not None and in_order.shape in ((len(self.names),), (size, len(self.names))):
            given = dict(zip(self.names, in_order.T, strict=True))
        if given is not None and not (isinstance(given, Mapping) and set(given) <= set(self.names)):
            form = f"a dictionary of {list(self.names)}, or all of them"
            raise ValueError(f"options['parameters'] must be {form}, got {shown(given)}")
        for name, value in (given or {}).items():
            numbers, column = as_numbers(value), self.names.index(name)
            if numbers is None or numbers.shape not in ((), (size,)) or not np.isfinite(numbers).all():
                several = "" if size is None else f" or finite with shape ({size},)"
                raise ValueError(f"{name} of options['parameters'] must be a number{several}, got {shown(value)}")
            low, high = self.ranges[:, column].tolist()
            if self.function is not None and not anywhere and ((numbers < low) | (numbers > high)).any():
                raise ValueError(
                    f"{name} must be between {low:g} and {high:g}, got {shown(value)} "
                    "(allow_assumption_violation=True lets others move)"
                )
            values[:, column] = numbers
        if self.function is None:
            for row in values:
                self._fitting(row)
        return values[0] if size is None else values

    def drawn(self, rng: np.random.Generator, fixed: np.ndarray) -> np.ndarray:
        """Returns the parameters of a member, shape (k,), those drawn that are NaN: uniformly, or from those listed."""
        if self.function is None:
            rows = self._fitting(fixed)
            return self.parameters[rows[rng.integers(len(rows))]]
        return np.where(np.isnan(fixed), rng.uniform(*self.ranges), fixed)

    def member(self, parameters: np.ndarray) -> np.ndarray:
        """Returns [A, B, s] of the member with these parameters, shape (n, n + m + 1).

        Raises:
            ValueError: If the function returns something else, or within the ranges what contradicts the interval.
        """
        if self.function is None:
            return self.members[self._fitting(parameters)[0]]
        matrices, (low, high) = self.of_function(parameters), self.ranges
        if self.interval is not None and ((low <= parameters) & (parameters <= high)).all():
            outside = (matrices < self.interval[0]) | (matrices > self.interval[1])
            if outside.any():
                given = dict(zip(self.names, parameters.tolist(), strict=True))
                where = f"{entry_name(outside)} at {shown(given)}"
                raise ValueError(f"{where} is not between those at the ends of the ranges, as monotone=True says")
        return matrices

    def of_function(self, parameters: np.ndarray) -> np.ndarray:
        """Returns [A, B, s] of the plant that the function returns, within the ranges or not, if `check` lets it."""
        assert self.function is not None
        shape = self.members.shape[1:]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # those at the corners of the ranges were shown
            plant = self.function(**dict(zip(self.names, parameters.tolist(), strict=True)))
        if self.check is not None:
            self.check(plant)
        return matrices_of(plant, shape, np.zeros(shape[1] - 1) if self.center is None else self.center)

    def _fitting(self, fixed: np.ndarray) -> np.ndarray:
        """Returns the indices of the members listed that have these parameters, NaN fitting all."""
        rows = np.flatnonzero((np.isnan(fixed) | (self.parameters == fixed)).all(axis=1))
        if not len(rows):
            wanted = {name: each for name, each in zip(self.names, fixed.tolist(), strict=True) if each == each}
            listed = [dict(zip(self.names, row, strict=True)) for row in self.parameters.tolist()]
            raise ValueError(f"no member of the family has {shown(wanted)}; it has {shown(listed)}")
        return rows


def grid_size(parameters: int) -> int:
    """Returns at how many values of each parameter `monotone` is checked."""
    return max(int(GRID ** (1.0 / parameters) + 1e-9), 3)


def matrices_of(plant: LinearPlant, shape: tuple[int, ...], center: np.ndarray) -> np.ndarray:
    """Returns [A, B, s] of a plant in deviations from a state and input, (n + m,), or raises ValueError.

    It is at rest at its own operating point (x_i, u_i): s = (A - I)(x - x_i) + B (u - u_i), rounded once.
    """
    A, B, (n, m) = plant.A, plant.B, plant.B.shape
    if (n, n + m + 1) != shape:
        wanted = (shape[0], shape[1] - 1)
        raise ValueError(f"the plants of a family must have [A, B] of the same shape {wanted}, got {(n, n + m)}")
    moved = center - np.concatenate([plant.operating_state, plant.operating_input])
    step = exact.product(np.hstack([A, B, -np.eye(n)]), np.concatenate([moved, moved[:n]]))
    return np.column_stack([A, B, step])


def entry_name(chosen: np.ndarray) -> str:
    """Returns the name of the first entry of [A, B, s] that is chosen, shape (n, n + m + 1)."""
    (row, column), n = np.argwhere(chosen)[0].tolist(), len(chosen)
    if column == chosen.shape[1] - 1:
        return f"state {row + 1} of the step from the middle of the operating points"
    return f"A[{row}, {column}]" if column < n else f"B[{row}, {column - n}]"
