"""What a linear model leaves out of what really moves: a remainder, or the other members of a family of plants."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from operator import attrgetter
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from ncs_gym import exact
from ncs_gym.bounds import Ball, Bounds, Box, Gaussian, Sum, as_set
from ncs_gym.ellipsoid import Ellipsoid, UncertainSet, outer_sum
from ncs_gym.limits import sides
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.validation import (
    ReadOnlyArrays,
    as_flag,
    as_matrix,
    as_names,
    as_numbers,
    as_vector,
    read_only,
    require_short_text,
    shown,
)

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


# Room for the rounding of a function's entries, in units of the largest one of their row where that varies.
ROOM = 1e-12
MOST_PARAMETERS = 6
# What is the same of all members, but was rounded around other operating points, agrees to this, relatively.
_ROUNDED = {
    **dict.fromkeys(("box", "box_ends"), "Limits of states"),
    "input_ends": "Limits of inputs",
    **dict.fromkeys(("mixed_rows", "mixed_ends"), "Limits of rates, or of states and inputs together"),
}
SAME = 1e-9
# What is exactly the same of all members, beside their disturbances.
_SAME = {
    **{name: name for name in ("H", "dt", "between_samples", "delta")},
    "past": "delay, or a rate",
    **dict.fromkeys(("gamma", "process_noise.covariance"), "Bounds(disturbance=...)"),
    **dict.fromkeys(("sensor_noise.covariance", "of_sensor.bound"), "Bounds(sensor=...)"),
    **dict.fromkeys(("initial_noise.covariance", "of_first_error.bound"), "Bounds(first_error=...)"),
    **dict.fromkeys(("state_names", "state_units", "input_names", "input_units"), "labels"),
}
# Bounds of disturbances that hold this rounding agree to this, relative to the terms of a step.
SAME_BOUND = 1e-8


def family(
    members: Sequence[LinearPlant] | Callable[..., LinearPlant],
    ranges: Mapping[str, Any] | None = None,
    *,
    monotone: bool = False,
    at_rest: bool = False,
) -> LinearPlant:
    """Returns the plant of the middle of a family, with a proved bound on what it leaves out of any member.

    A certificate for it covers every member, also one that moves from one to another (docs/shield_proof.md, "Plants
    that vary"). An environment draws a member for every episode; what the bound allows is not drawn beside.

    Args:
        members: Two plants or more that differ in A and B alone, and in where they rest, whose convex hull is covered;
            or a function of parameters given by name that returns such plants. Deviations of the middle are counted
            from the middle of their operating points.
        ranges: Lowest and highest value of each parameter of the function, up to 6 of them.
        monotone: Your claim, needed for a function and checked on a grid, that every entry of A and B, and of
            A x + B u + c - x at the middle of the operating points, is monotone in each parameter.
        at_rest: Your claim that every member rests at its own operating point, A x + B u + c = x with c its `offset`;
            needed where members differ in what acts on operating points that are not zero.

    Raises:
        ValueError: If members differ in anything else, are proved between samples or have a remainder, a claim is
            contradicted or missing, a state that matters has no limit, or an argument is wrong.
    """
    at_rest, monotone = as_flag(at_rest, "at_rest"), as_flag(monotone, "monotone")
    if callable(members):
        found, plants, shared = _of_function(members, ranges, monotone)
    elif ranges is None and not monotone:
        found, plants, shared = _of_plants(members)
    else:
        raise ValueError("ranges and monotone are about a function of parameters: give a function in place of plants")
    differs = np.ptp(found.members[..., :-1], axis=0).any(axis=0)
    rest_matters = bool(np.any(_resting_points(plants)[:, differs]))
    if rest_matters and not at_rest:
        raise ValueError(
            "the members differ in what acts on an operating point that is not zero: say at_rest=True if each is at "
            "rest at its own one, as Model(offset=...) checks"
        )
    first, n = shared.first, len(plants[0].model.A)
    own = np.array([np.hstack([each.model.A, each.model.B]) for each in plants])
    middle = 0.5 * (own.min(axis=0) + own.max(axis=0))  # exact where all are the same
    model = replace(first.model, A=middle[:, :n], B=middle[:, n:], offset=None, continuous=None)
    bounds = first.bounds if shared.cover is first.of_disturbance.bound else _with_bound(first, shared.cover)
    remainder = Remainder(Ellipsoid(np.zeros((n, n))), True, "", replace(found, at_rest=rest_matters))
    return LinearPlant(model, first.limits, replace(bounds, disturbance=bounds.disturbance + remainder), first.labels)


def _with_bound(plant: LinearPlant, bound: Ellipsoid | None) -> Bounds:
    """Returns the bounds of a plant with another ellipsoid, (n, n), in place of its `of_disturbance.bound`."""
    kinds = Gaussian if plant.past else Ball | Gaussian
    kept = [each for each in plant.bounds.disturbance.parts if isinstance(each, kinds)]
    n = len(plant.model.A)
    others = [] if bound is None else [Ellipsoid(bound.shape_matrix[:n, :n])]
    return replace(plant.bounds, disturbance=Sum((*kept, *others)))


def _resting_points(plants: list[LinearPlant]) -> np.ndarray:
    """Returns the operating states and inputs, shape (N, n + m)."""
    return np.array([np.concatenate([each.operating_state, each.operating_input]) for each in plants])


def _center_of(plants: list[LinearPlant]) -> np.ndarray:
    points = _resting_points(plants)
    return 0.5 * (points.min(axis=0) + points.max(axis=0))  # exact where all are the same


def _around_center(plant: LinearPlant, center: np.ndarray) -> LinearPlant:
    """Returns a plant whose model is about a state and input, shape (n + m,), under disturbances that move neither."""
    point = center[: len(plant.model.A)], center[plant.n :]
    own = plant.operating_state[: len(point[0])], plant.operating_input
    about = (np.concatenate(pair) for pair in (own, (plant.model.state, plant.model.input)))
    if all(np.array_equal(np.concatenate(point), each) for each in about):
        return plant
    bounds = _with_bound(plant, plant.of_disturbance.bound)
    model, limits = replace(plant.model, at=point, offset=None), plant.limits.absolute(plant.model)
    return replace(plant, model=model, limits=limits, bounds=bounds)


def _covering(plants: Sequence[LinearPlant]) -> Ellipsoid | None:
    """Returns a bound of the disturbances of all members, the one of the first if all have the same by themselves.

    What members that rest under a constant disturbance lack of an equilibrium is part of their bounds, and less than
    SAME_BOUND of the terms of a step. P_i <= P_0 + diag(row sums of |P_i - P_0|), as `_is_covered` compares.
    """
    first = plants[0]
    shape = _disturbance_shape(first)
    are_equal = all(np.array_equal(shape, _disturbance_shape(each)) for each in plants)
    if are_equal and not any(each.step_offset.any() for each in plants):
        return first.of_disturbance.bound
    widths = _terms(first)
    size = np.sqrt((np.abs(shape) / (widths * widths[:, None])).sum(axis=1))
    return Ellipsoid(shape + np.diag((2.0 * size + SAME_BOUND) * SAME_BOUND * widths**2))


def _is_covered(first: LinearPlant, cover: Ellipsoid | None, plant: LinearPlant) -> bool:
    """Returns whether the bound of a member's disturbance is inside of the family's."""
    off = np.abs(_disturbance_shape(plant) - _disturbance_shape(first))
    widths = _terms(first)
    excess = (off / (widths * widths[:, None])).sum(axis=1) * widths**2
    room = np.zeros(first.n) if cover is None else np.diag(cover.shape_matrix - _disturbance_shape(first))
    return not (excess > room).any()


def _disturbance_shape(plant: LinearPlant) -> np.ndarray:
    bound = plant.of_disturbance.bound
    return np.zeros((plant.n, plant.n)) if bound is None else bound.shape_matrix


def _terms(plant: LinearPlant) -> np.ndarray:
    """Returns the largest |x| + |A| |x| + |B| |u| within the limits, shape (n,); 1 stands for a free state."""
    reach = np.where(np.isfinite(plant.reach), plant.reach, 1.0)
    return reach[: plant.n] + exact.product(np.abs(np.hstack([plant.A, plant.B])), reach)


def _of_plants(members: Any) -> tuple[Family, list[LinearPlant], _Shared]:
    if not isinstance(members, (list, tuple)) or len(members) < 2:
        raise ValueError(f"a family must be two plants or more, or a function of ranges, got {shown(members)}")
    plants = list(members)
    shared, numbers = _Shared.of(plants), np.arange(len(plants))[:, None]
    family = Family(names=("member",), parameters=numbers, members=_matrices(plants), center=_center_of(plants))
    return family, plants, shared


def _of_function(
    function: Callable[..., LinearPlant], ranges: Any, monotone: bool
) -> tuple[Family, list[LinearPlant], _Shared]:
    if not isinstance(ranges, Mapping) or not 1 <= len(ranges) <= MOST_PARAMETERS:
        form = f"a dictionary of 1 to {MOST_PARAMETERS} parameters with their (low, high)"
        raise ValueError(f"ranges must be {form}, got {shown(ranges)}")
    if not monotone:
        raise ValueError(
            "say monotone=True if every entry of A and B is monotone in each parameter, or give plants whose convex "
            "hull holds yours"
        )
    names = as_names(list(ranges), tuple(map(str, ranges)), "the names of parameters")
    ends = [sides(value, 1, f"the range of {name}").ravel() for name, value in ranges.items()]
    if not np.isfinite(ends).all():
        raise ValueError(f"the ends of ranges must be finite, got {shown(ranges)}")
    corners = [np.array(corner) for corner in itertools.product(*ends)]
    plants = [function(**dict(zip(names, corner.tolist(), strict=True))) for corner in corners]
    shared, matrices = _Shared.of(plants), _matrices(plants)
    varies = np.ptp(matrices, axis=0).any(axis=1)  # other rows, as those of past inputs, are the same everywhere
    reach = np.max([each.reach for each in plants], axis=0)
    room = ROOM * (varies * np.abs(matrices[..., :-1]).max(axis=(0, 2)))[:, None] * np.isfinite(reach)
    room = np.column_stack([room, ROOM * _terms_of_step(plants, matrices)])
    interval = np.array([matrices.min(axis=0) - room, matrices.max(axis=0) + room])
    family = Family(
        names=names,
        parameters=np.array(corners),
        members=matrices,
        function=function,
        interval=interval,
        center=_center_of(plants),
        check=shared,
    )
    _check_monotone(family, room)
    return family, plants, shared


def _matrices(plants: list[LinearPlant]) -> np.ndarray:
    """Returns [A, B, s] of each around the middle of their operating points, shape (N, n, n + m + 1)."""
    shape = plants[0].n, plants[0].n + plants[0].m + 1
    return np.array([matrices_of(each, shape, _center_of(plants)) for each in plants])


def _terms_of_step(plants: list[LinearPlant], matrices: np.ndarray) -> np.ndarray:
    """Returns the largest sum of terms that s of a member is made of, shape (n,); zero for past inputs."""
    n, sizes = plants[0].n, np.abs(_resting_points(plants)) + np.abs(_center_of(plants))
    terms = [exact.product(np.abs(each[:, :-1]), size) + size[:n] for each, size in zip(matrices, sizes, strict=True)]
    return np.max(terms, axis=0) * (np.arange(n) < n - plants[0].past)


def _require_member(first: LinearPlant, plant: Any) -> None:
    """Raises ValueError unless a plant can be a member of a family, and has the sizes of its first one."""
    if not isinstance(plant, LinearPlant) or plant.remainder is not None or plant.between_samples is not None:
        form = "plants without a remainder of their own and without between_samples"
        raise ValueError(f"the members of a family must be {form}, got {shown(plant)}")
    matrices_of(plant, (first.n, first.n + first.m + 1), np.zeros(plant.n + plant.m))


@dataclass(frozen=True, eq=False)
class _Shared:
    """What members share: the first one, counted from where the family rests, and a bound of all disturbances."""

    first: LinearPlant
    cover: Ellipsoid | None

    @classmethod
    def of(cls, plants: list[LinearPlant]) -> _Shared:
        """Returns that of plants; raises ValueError unless they differ in A and B alone, and in where they rest."""
        for each in plants:
            _require_member(plants[0], each)
        shared = cls(_around_center(plants[0], _center_of(plants)), _covering(plants))
        for number, each in enumerate(plants):
            shared(each, f"member {number}")
        return shared

    def __call__(self, plant: Any, called: str = "one inside the ranges") -> None:
        """Raises ValueError unless a plant has what members share."""
        _require_member(self.first, plant)
        moved = _around_center(plant, _resting_points([self.first])[0])
        names = [
            given
            for name, given in (_ROUNDED | _SAME).items()
            if not _is_same(attrgetter(name)(self.first), attrgetter(name)(moved), SAME if name in _ROUNDED else 0.0)
        ]
        if not names and not _is_covered(self.first, self.cover, plant):
            names = ["Bounds(disturbance=...)"]
        if names:
            raise ValueError(f"members of a family may differ in A and B alone, and {called} differs in {names[0]}")


def _is_same(one: Any, other: Any, tolerance: float) -> bool:
    one, other = (each.shape_matrix if isinstance(each, Ellipsoid) else each for each in (one, other))
    if tolerance:
        return one.shape == other.shape and np.allclose(one, other, rtol=tolerance, atol=0.0)
    return bool(np.array_equal(one, other))


def _check_monotone(family: Family, room: np.ndarray) -> None:
    """Raises ValueError unless entries are monotone up to `room`, shape (n, n + m + 1), on a grid."""
    k, (low, high) = len(family.names), family.ranges
    each = grid_size(k)
    points = np.array([*itertools.product(*np.linspace(low, high, each).T)])
    values = np.array([family.of_function(point) for point in points]).reshape(*[each] * k, *room.shape)
    for axis, name in enumerate(family.names):
        change = np.diff(values, axis=axis)
        both = np.any(change > room, axis=axis) & np.any(change < -room, axis=axis)
        wrong = np.array(both).reshape(-1, *room.shape).max(axis=0)
        if wrong.any():
            where = f"{name} from {low[axis]:g} to {high[axis]:g}"
            raise ValueError(f"{entry_name(wrong)} is not monotone in {where}, as monotone=True says")
