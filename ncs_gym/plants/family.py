"""The plant of the middle of a family of plants, with a proved bound on what it leaves out of each of them.

For x and u within the limits, what the middle (A, B) leaves out of a member, (A_i - A) x + (B_i - B) u + s_i, is at
most sum_j |[A_i - A, B_i - B]|_j w_j + |s_i|, entry by entry, with w the largest |x_j| and |u_j|, and s_i the step of a
member that rests elsewhere. That is linear in the member (docs/shield_proof.md, "Plants that vary").
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ncs_gym import exact
from ncs_gym.bounds import Ball, Bounds, Gaussian, Sum
from ncs_gym.limits import sides
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.uncertainty.family import Family, entry_name, grid_size, matrices_of
from ncs_gym.uncertainty.remainder import Remainder
from ncs_gym.validation import as_flag, as_names, shown

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
    **dict.fromkeys(("gamma", "process_noise_cov"), "Bounds(disturbance=...)"),
    **dict.fromkeys(("measurement_noise_cov", "sensor_bound"), "Bounds(sensor=...)"),
    **dict.fromkeys(("initial_cov", "initial_bound"), "Bounds(first_error=...)"),
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
    bounds = first.bounds if shared.cover is first.disturbance_bound else _with_bound(first, shared.cover)
    remainder = Remainder(Ellipsoid(np.zeros((n, n))), True, "", replace(found, at_rest=rest_matters))
    return LinearPlant(model, first.limits, replace(bounds, disturbance=bounds.disturbance + remainder), first.labels)


def _with_bound(plant: LinearPlant, bound: Ellipsoid | None) -> Bounds:
    """Returns the bounds of a plant with another ellipsoid, (n, n), in place of its `disturbance_bound`."""
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
    bounds = _with_bound(plant, plant.disturbance_bound)
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
        return first.disturbance_bound
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
    bound = plant.disturbance_bound
    return np.zeros((plant.n, plant.n)) if bound is None else bound.shape_matrix


def _terms(plant: LinearPlant) -> np.ndarray:
    """Returns the largest |x| + |A| |x| + |B| |u| within the limits, shape (n,); 1 stands for a free state."""
    reach = np.where(np.isfinite(plant.reach), plant.reach, 1.0)
    return reach[: plant.n] + exact.product(np.abs(np.hstack([plant.A, plant.B])), reach)


def _of_plants(members: Any) -> tuple[Family, list[LinearPlant], _Shared]:
    """Returns the family of plants, these, and what they share."""
    if not isinstance(members, (list, tuple)) or len(members) < 2:
        raise ValueError(f"a family must be two plants or more, or a function of ranges, got {shown(members)}")
    plants = list(members)
    shared, numbers = _Shared.of(plants), np.arange(len(plants))[:, None]
    family = Family(names=("member",), parameters=numbers, members=_matrices(plants), center=_center_of(plants))
    return family, plants, shared


def _of_function(
    function: Callable[..., LinearPlant], ranges: Any, monotone: bool
) -> tuple[Family, list[LinearPlant], _Shared]:
    """Returns the family of a function, the plants of its corners, and what they share."""
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
            if not _is_same(getattr(self.first, name), getattr(moved, name), SAME if name in _ROUNDED else 0.0)
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
