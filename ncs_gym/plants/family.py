"""The plant of the middle of a family of plants, with a proved bound on what it leaves out of each of them.

For x in the safe box and u within the limits, what the middle (A, B) leaves out of a member, (A_i - A) x + (B_i - B) u
+ s_i, is at most sum_j |[A_i - A, B_i - B]|_j w_j + |s_i|, entry by entry, with w the largest |x_j| and |u_j|, and s_i
the step of a member that rests elsewhere from the middle of the operating points. It is linear in the member, so a
bound for some members is one for their convex hull (docs/shield_proof.md, "Plants that vary").
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import reduce
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from ncs_gym import exact
from ncs_gym.limits import in_units_of_range
from ncs_gym.plants.past_inputs import inputs_under_way, is_row_of_past_input
from ncs_gym.uncertainty.declared_bound import as_bound
from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.uncertainty.family import Family, entry_name, grid_size, matrices_of
from ncs_gym.uncertainty.shape_matrices import outer_sum
from ncs_gym.validation import as_flag, as_names, as_number, shown

if TYPE_CHECKING:
    from ncs_gym.plants.linear_plant import LinearPlant

P = TypeVar("P", bound="LinearPlant")

# Growth of the bound for the rounding of sums, and room for that of a function's entries, in units of the largest one
# of their row where that varies.
ROUNDING, ROOM = 1e-9, 1e-12
MOST_PARAMETERS = 6
# In what members may differ; the plant of the middle has no model in continuous time.
_OWN = ("A", "B", "continuous_model", "step_offset")
# What is the same of all members, but was rounded around other operating points, agrees to this, relatively.
_ROUNDED = ("box", "box_ends", "input_ends", "mixed_rows", "mixed_ends")
SAME = 1e-9
# Bounds of disturbances that hold this rounding agree to this, relative to the terms of a step.
SAME_BOUND = 1e-8


def plant_of_middle(
    kind: type[P],
    members: Sequence[P] | Callable[..., P],
    ranges: Mapping[str, Any] | None,
    *,
    monotone: bool,
    at_rest: bool,
) -> P:
    """Returns what `LinearPlant.family` does, of plants of this class."""
    at_rest, monotone = as_flag(at_rest, "at_rest"), as_flag(monotone, "monotone")
    if callable(members):
        family, plants = _of_function(kind, members, ranges, monotone)
    elif ranges is None and not monotone:
        family, plants = _of_plants(kind, members)
    else:
        raise ValueError("ranges and monotone are about a function of parameters: give a function in place of plants")
    rest_matters = _rest_matters(family, plants)
    if rest_matters and not at_rest:
        raise ValueError(
            "the members differ in what acts on an operating point that is not zero (the middle of a disturbance with "
            "two ends moves it, too): say at_rest=True if each is at rest at its own one, as LinearPlant(offset=...) "
            "checks of a model in absolute coordinates"
        )
    first = _around_center(plants[0], _center_of(plants))
    middle = 0.5 * (family.members.min(axis=0) + family.members.max(axis=0))  # exact where all are the same
    return replace(
        first,
        A=middle[:, : first.n],
        B=middle[:, first.n : -1],
        continuous_model=None,
        disturbance_bound=_covering(plants),
        remainder=replace(family, at_rest=rest_matters),
    )


def bound_of_family(plant: LinearPlant, family: Family) -> Ellipsoid:
    """Returns what the plant leaves out of every member of a family, shape (n, n).

    Past inputs keep the limits of inputs only where they are that for every member, and undisturbed.

    Raises:
        ValueError: If members are of another size, or differ in what an unlimited state does.
    """
    n, size = plant.n, (plant.n, plant.n + plant.m + 1)
    if family.members.shape[1:] != size:
        raise ValueError(f"the members of the family must be [A, B, s] of shape {size}, got {family.members.shape[1:]}")
    listed = family.members if family.interval is None else family.interval
    off = np.abs(listed - np.column_stack([plant.A, plant.B, np.zeros(n)]))
    if family.interval is not None:
        off = off.max(axis=0, keepdims=True)
    disturbed = off.any(axis=(0, 2)) | (plant.gamma > 0.0) | (plant.process_noise_cov.diagonal() > 0.0)
    if plant.disturbance_bound is not None:
        disturbed |= plant.disturbance_bound.shape_matrix.diagonal() > 0.0
    reach = np.append(plant.reach_with(inputs_under_way(plant, disturbed)), 1.0)
    return _around(plant, _largest(reach, off, plant.state_names))


def _rest_matters(family: Family, plants: list[P]) -> bool:
    """Returns whether members differ in what acts on their operating points."""
    differs = np.ptp(family.members[..., :-1], axis=0).any(axis=0)
    return bool(np.any(_resting_points(plants)[:, differs]))


def _resting_points(plants: list[P]) -> np.ndarray:
    """Returns state and input that the deviations of each are counted from, shape (N, n + m)."""
    return np.array([np.concatenate([each.operating_state, each.operating_input]) for each in plants])


def _center_of(plants: list[P]) -> np.ndarray:
    """Returns state and input in the middle of the operating points, shape (n + m,)."""
    points = _resting_points(plants)
    return 0.5 * (points.min(axis=0) + points.max(axis=0))  # exact where all are the same


def _around_center(plant: P, center: np.ndarray) -> P:
    """Returns a plant whose limits are those in deviations from another state and input, shape (n + m,)."""
    moved, n = center - _resting_points([plant])[0], plant.n
    if not moved.any():
        return plant
    input_ends = plant.input_ends - moved[n:]
    stored = is_row_of_past_input(plant)
    ends = np.where(stored, plant.box_ends, plant.box_ends - exact.product(plant.box, moved[:n]))
    if (past := np.flatnonzero(stored)).size:
        ends[:, past] = np.tile(input_ends / plant.input_half, len(past) // plant.m)
    box = in_units_of_range(plant.box, *ends)
    mixed = in_units_of_range(plant.mixed_rows, *(plant.mixed_ends - exact.product(plant.mixed_rows, moved)))
    return replace(
        plant,
        operating_state=center[:n],
        operating_input=center[n:],
        box=box.rows,
        box_ends=np.stack([box.low, box.high]),
        input_ends=input_ends,
        mixed_rows=mixed.rows,
        mixed_ends=np.stack([mixed.low, mixed.high]),
    )


def _covering(plants: Sequence[LinearPlant]) -> Ellipsoid | None:
    """Returns a bound of the disturbances of all members, the one of the first if all have the same by themselves.

    What members that rest under a constant disturbance lack of an equilibrium by rounding is part of their bounds, and
    is less than SAME_BOUND of the terms of a step. P_i <= P_0 + diag(row sums of |P_i - P_0|), as `_require_covered`
    compares.
    """
    first = plants[0]
    shape = _disturbance_shape(first)
    are_equal = all(np.array_equal(shape, _disturbance_shape(each)) for each in plants)
    if are_equal and not any(each.step_offset.any() for each in plants):
        return first.disturbance_bound
    widths = _terms(first)
    size = np.sqrt((np.abs(shape) / (widths * widths[:, None])).sum(axis=1))
    return Ellipsoid(shape + np.diag((2.0 * size + SAME_BOUND) * SAME_BOUND * widths**2))


def _require_covered(first: LinearPlant, cover: Ellipsoid | None, plant: LinearPlant, name: str) -> None:
    """Raises ValueError unless the bound of a member's disturbance is inside of the bound of the family's."""
    off = np.abs(_disturbance_shape(plant) - _disturbance_shape(first))
    widths = _terms(first)
    excess = (off / (widths * widths[:, None])).sum(axis=1) * widths**2
    room = np.zeros(first.n) if cover is None else np.diag(cover.shape_matrix - _disturbance_shape(first))
    if (excess > room).any():
        raise ValueError(
            f"the members of a family may differ in A and B alone, and {name} has another disturbance_bound"
        )


def _disturbance_shape(plant: LinearPlant) -> np.ndarray:
    bound = plant.disturbance_bound
    return np.zeros((plant.n, plant.n)) if bound is None else bound.shape_matrix


def _terms(plant: LinearPlant) -> np.ndarray:
    """Returns the largest |x| + |A| |x| + |B| |u| within the limits, shape (n,); 1 stands for a free state."""
    reach = np.where(np.isfinite(plant.reach), plant.reach, 1.0)
    return reach[: plant.n] + exact.product(np.abs(np.hstack([plant.A, plant.B])), reach)


def _of_plants(kind: type[P], members: Any) -> tuple[Family, list[P]]:
    """Returns the family of plants, and the plants."""
    if not isinstance(members, (list, tuple)) or len(members) < 2:
        raise ValueError(
            f"a family must be a list of two plants or more, or a function of ranges, got {shown(members)}"
        )
    plants = list(members)
    _require_alike(kind, plants)
    center, matrices = _center_of(plants), _matrices(plants)
    family = Family(names=("member",), parameters=np.arange(len(plants))[:, None], members=matrices, center=center)
    return family, plants


def _of_function(kind: type[P], function: Callable[..., P], ranges: Any, monotone: bool) -> tuple[Family, list[P]]:
    """Returns the family of a function, and the plants of its corners."""
    if not isinstance(ranges, Mapping) or not 1 <= len(ranges) <= MOST_PARAMETERS:
        raise ValueError(
            f"ranges must be a dictionary of 1 to {MOST_PARAMETERS} parameters with their (low, high), got "
            f"{shown(ranges)}"
        )
    if not monotone:
        raise ValueError(
            "between the ends of the ranges the plants of a function may be anything: say monotone=True if every entry "
            "of A and B is monotone in each parameter, or give the list of plants whose convex hull holds yours"
        )
    names = as_names(list(ranges), tuple(map(str, ranges)), "the names of parameters")
    ends = [_ends(name, value) for name, value in ranges.items()]
    corners = [np.array(corner) for corner in itertools.product(*ends)]
    plants = [function(**dict(zip(names, corner.tolist(), strict=True))) for corner in corners]
    _require_alike(kind, plants)
    matrices = _matrices(plants)
    varies = np.ptp(matrices, axis=0).any(axis=1)  # other rows, as those of past inputs, are the same everywhere
    reach = np.max([each.reach for each in plants], axis=0)
    room = ROOM * (varies * np.abs(matrices[..., :-1]).max(axis=(0, 2)))[:, None] * np.isfinite(reach)
    room = np.column_stack([room, ROOM * _terms_of_step(plants, matrices)])
    interval = np.array([matrices.min(axis=0) - room, matrices.max(axis=0) + room])
    first, cover = _around_center(plants[0], _center_of(plants)), _covering(plants)
    family = Family(
        names=names,
        parameters=np.array(corners),
        members=matrices,
        function=function,
        interval=interval,
        center=_center_of(plants),
        check=_Shared(first, cover, "another one"),
    )
    _check_monotone(family, room)
    return family, plants


def _matrices(plants: list[P]) -> np.ndarray:
    """Returns [A, B, s] of plants around the middle of their operating points, shape (N, n, n + m + 1)."""
    shape = plants[0].n, plants[0].n + plants[0].m + 1
    return np.array([matrices_of(each, shape, _center_of(plants)) for each in plants])


def _terms_of_step(plants: list[P], matrices: np.ndarray) -> np.ndarray:
    """Returns the largest sum of terms that s of a member is made of, shape (n,); zero for past inputs."""
    n, sizes = plants[0].n, np.abs(_resting_points(plants)) + np.abs(_center_of(plants))
    terms = [exact.product(np.abs(each[:, :-1]), size) + size[:n] for each, size in zip(matrices, sizes, strict=True)]
    return np.max(terms, axis=0) * (np.arange(n) < n - min(map(inputs_under_way, plants)))


def _ends(name: str, value: Any) -> tuple[float, float]:
    if not isinstance(value, (tuple, list)) or len(value) != 2:
        raise ValueError(f"the range of {name} must be a pair (low, high), got {shown(value)}")
    low, high = (as_number(end, f"an end of the range of {name}") for end in value)
    if not low < high:
        raise ValueError(f"the range of {name} must be (low, high) with low < high, got {shown(value)}")
    return low, high


def _require_alike(kind: type[P], plants: list[P]) -> None:
    """Raises ValueError unless all are plants that differ in A and B alone, and in where they rest."""
    for each in plants:
        _require_member(kind, plants[0], each)
    first, cover = _around_center(plants[0], _center_of(plants)), _covering(plants)
    for number, each in enumerate(plants):
        _Shared(first, cover, f"member {number}")(each)


def _require_member(kind: type[P], first: P, plant: Any) -> None:
    """Raises ValueError unless a plant can be a member of a family, and has the sizes of its first one."""
    if not isinstance(plant, kind):
        raise ValueError(f"the members of a family must be of type {kind.__name__}, got {shown(plant)}")
    if plant.remainder is not None:
        raise ValueError("a member of a family has a remainder of its own, for which no bound of the family is proved")
    if plant.between_samples is not None:
        raise ValueError("between_samples is not proved for a family: give its members without it")
    matrices_of(plant, (first.n, first.n + first.m + 1), np.zeros(plant.n + plant.m))


@dataclass(frozen=True, eq=False)
class _Shared:
    """What all members share: that of the first one, counted from where the family rests.

    Attributes:
        first: The first member.
        cover: The family's bound of disturbances.
        name: What messages call another member.
    """

    first: LinearPlant
    cover: Ellipsoid | None
    name: str

    def __call__(self, plant: Any) -> None:
        """Raises ValueError unless a plant, counted from where the first one is, has all that members share."""
        _require_member(type(self.first), self.first, plant)
        moved = _around_center(plant, _resting_points([self.first])[0])
        for entry in fields(moved):
            one, other = getattr(self.first, entry.name), getattr(moved, entry.name)
            tolerance = SAME if entry.name in _ROUNDED else 0.0
            if entry.name not in (*_OWN, "disturbance_bound") and not _is_same(one, other, tolerance):
                raise ValueError(
                    f"the members of a family may differ in A and B alone, and {self.name} has another {entry.name}"
                )
        _require_covered(self.first, self.cover, plant, self.name)


def _is_same(one: Any, other: Any, tolerance: float) -> bool:
    one, other = (each.shape_matrix if isinstance(each, Ellipsoid) else each for each in (one, other))
    if tolerance:
        return one.shape == other.shape and np.allclose(one, other, rtol=tolerance, atol=0.0)
    return bool(np.array_equal(one, other))


def _check_monotone(family: Family, room: np.ndarray) -> None:
    """Checks on a grid that entries are monotone up to `room`, shape (n, n + m + 1).

    Raises:
        ValueError: If an entry is not, with its name and that of the parameter.
    """
    k, (low, high) = len(family.names), family.ranges
    each = grid_size(k)
    points = np.array([*itertools.product(*np.linspace(low, high, each).T)])
    values = np.array([family.of_function(point) for point in points]).reshape(*[each] * k, *room.shape)
    for axis, name in enumerate(family.names):
        change = np.diff(values, axis=axis)
        both = np.any(change > room, axis=axis) & np.any(change < -room, axis=axis)
        wrong = np.array(both).reshape(-1, *room.shape).max(axis=0)
        if wrong.any():
            raise ValueError(
                f"{entry_name(wrong)} is not monotone in {name} from {low[axis]:g} to {high[axis]:g}, as monotone=True "
                "says: give a smaller range, or the list of plants whose convex hull holds yours"
            )


def _largest(reach: np.ndarray, off: np.ndarray, state_names: Sequence[str]) -> np.ndarray:
    """Returns the half-widths of what the middle leaves out, shape (n,).

    Args:
        reach: w, the largest |x_j|, |u_j| and 1, shape (n + m + 1,); infinite for an unlimited state.
        off: How far entries of [A, B, s] are from the middle, shape (N, n, n + m + 1).
        state_names: Names of the states.

    Raises:
        ValueError: If members differ in what an unlimited state does.
    """
    differs = off.any(axis=(0, 1))
    if free := np.flatnonzero(differs & np.isinf(reach)).tolist():
        raise ValueError(
            f"the members differ in what {state_names[free[0]]} does, which no row of the box with two ends "
            "limits: give it limits, if generous ones"
        )
    reach = np.where(differs, reach, 0.0)
    return (1.0 + ROUNDING) * np.max([exact.product(each, reach) for each in off], axis=0)


def _around(plant: LinearPlant, sizes: np.ndarray) -> Ellipsoid:
    """Returns the ellipsoid of the smallest tr(W P) around a box of half-widths, shape (n,)."""
    n = plant.n
    sides = [as_bound((np.eye(n)[:, [i]], [size]), n, "the remainder") for i, size in enumerate(sizes.tolist()) if size]
    if not sides:
        return Ellipsoid(np.zeros((n, n)))
    shapes = (each.shape_matrix for each in sides)
    return Ellipsoid(reduce(lambda one, other: outer_sum(one, other, plant.relative_weight), shapes))
