"""Why a design problem is infeasible, and which bounds would be feasible."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ncs_gym import ChannelContract, Ellipsoid, LinearPlant, Remainder
from ncs_gym.plants.linear_plant import row_limit
from shields.errors import Infeasible
from shields.synthesis.design_problem import DesignProblem, design_problem
from shields.synthesis.initial_designs import SUFFICIENT_MARGIN
from shields.synthesis.max_margin_gain import max_margin_gain
from shields.synthesis.polytope_gain import ellipsoid_margin, most_tolerant_gain, polytope_margin

# What may be declared of the uncertainties. The largest feasible value of each is sought down to this fraction of the
# given one, and to this ratio.
_BOUNDS = (
    "gamma",
    "disturbance_bound",
    "sensor_bound",
    "initial_bound",
    "process_noise_cov",
    "measurement_noise_cov",
    "initial_cov",
    "remainder",
)
_SMALLEST_FACTOR, _FACTOR_PRECISION = 1e-6, 1.02
# Limits are widened by these factors, until one works; two changes together by at most the last number.
_WIDENINGS, _WIDEST_PAIR = (2.0, 10.0, 100.0, 1e3, 1e4, 1e6), 100.0


# Where the ellipsoid's gain bears less of the radii than this with a polytope no better gain is sought: searches have
# gained an eighth.
_HOPELESS = 0.8
# Whether a quick search finds a safe set for a plant.
_Certifies = Callable[[LinearPlant], bool]


def infeasibility(problem: DesignProblem, *, polytope: bool) -> Infeasible:
    """Returns the exception that names the binding condition and the fraction of the radii that is feasible.

    Args:
        problem: The scaled design problem.
        polytope: Whether a polytope alone would do, too.
    """
    fraction = min(_margin(problem, polytope=polytope), 1.0)
    if fraction == 0.0:
        unstabilized = "(I) no gain was found that stabilizes the plant, whatever the bounds are"
        return Infeasible(unstabilized, "I", 1.0, {"share_of_radii": 0.0})
    binding = "U" if _margin(problem, polytope=polytope, input_limits=False) >= 1.0 else "I"
    missing = "ellipsoid or polytope" if polytope else "ellipsoid"
    what = (
        "(U) the input limits are too tight" if binding == "U" else f"(I) no invariant {missing} in the box was found"
    )
    return Infeasible(
        f"{what}: a quick search finds one once disturbance and error radii shrink to {100.0 * fraction:.3g}% of those "
        "given",
        binding,
        1.0 - fraction,
        {"share_of_radii": fraction},
    )


def with_feasible_bounds(
    infeasible: Infeasible,
    plant: LinearPlant,
    contract: ChannelContract | None,
    progress: Callable[[str], object] = lambda line: None,
    *,
    polytope: bool = True,
) -> Infeasible:
    """Returns the exception with the largest feasible max_age, and with that of each bound that the plant declares.

    Each is changed alone, the others being as they are given.

    Args:
        infeasible: The exception without these figures.
        plant: The plant for which no certificate was found.
        contract: The channel contract. An unstable plant without one, or that no gain stabilizes, and an unbounded safe
            box have no feasible bounds: the exception is then returned as it is.
        progress: Called with a line of text per figure that is sought.
        polytope: Whether a polytope alone would do, too.
    """

    def certifies(changed: LinearPlant) -> bool:
        return is_feasible(changed, contract, polytope=polytope)

    without_contract = contract is None and infeasible.binding == "E1"
    if without_contract or infeasible.binding == "S" or infeasible.details.get("share_of_radii") == 0.0:
        return infeasible
    hints, useless, useless_limits, details = [], [], [], dict(infeasible.details)
    if contract is not None and contract.max_age > 0:
        progress("no certificate: searching for a max_age that has one")
        age = _largest_age(plant, contract, polytope)
        if age is None:
            useless.append("max_age")
        else:
            hints.append(f"max_age = {age} or less")
            details["max_age"] = age
    for name in _BOUNDS:
        if _is_declared(plant, name):
            progress(f"no certificate: searching for a {name} that has one")
            factor = _largest_factor(plant, name, certifies)
            if factor is None:
                useless.append(name)
            else:
                hints.append(_hint(plant, name, factor))
                details |= _figure(plant, name, factor)
    for change in _widenings(plant):
        progress(f"no certificate: searching for {change.what} that has one")
        factor = _smallest_factor(plant, (change,), certifies)
        if factor is None:
            useless_limits.append(change.what)
        else:
            hints.append(f"{factor:.3g} times {change.what} or more")
            details[f"{change.name}_factor"] = factor
    found = [f"single changes that a quick search finds enough: {'; '.join(hints)}"] if hints else []
    vain = [f"with a smaller {' or '.join(useless)}"] if useless else []
    if useless_limits:
        vain.append(f"with {' or '.join(useless_limits)} up to {_WIDENINGS[-1]:.0e} times as large")
    if vain:
        found.append(f"a quick search finds none {', nor '.join(vain)}")
    if len(details) == len(infeasible.details):
        progress("no certificate: searching for two changes that have one")
        if (pair := _smallest_pair(plant, certifies)) is not None:
            (first, second), factor = pair
            found.append(f"the smallest pair of changes: {first.what} and {second.what}, {factor:.3g} times each")
            details |= {"pair_factor": factor}
    asked = "" if contract is None else f" (asked: max_age = {contract.max_age})"
    text = "; ".join([f"{infeasible}{_limits_exceeded(plant)}", *found]) + asked
    return Infeasible(text, infeasible.binding, infeasible.shortfall, details)


def _limits_exceeded(plant: LinearPlant) -> str:
    """Returns which limits of the safe box the disturbance of a single step exceeds, as the rest of a sentence."""
    reached = np.sqrt(np.einsum("ji,ik,jk->j", plant.box_rows, plant.nominal_disturbance.shape_matrix, plant.box_rows))
    return "".join(
        f"; the disturbance of one step alone reaches {size:.3g} times the limit {row_limit(plant, j)}"
        for j, size in enumerate(reached.tolist())
        if size >= 1.0
    )


def _is_declared(plant: LinearPlant, name: str) -> bool:
    """Returns whether the plant declares an uncertainty by this name that is not zero."""
    value = getattr(plant, name)
    value = value.bound if isinstance(value, Remainder) else value
    return value is not None and bool(np.any(value.shape_matrix if isinstance(value, Ellipsoid) else value))


def _hint(plant: LinearPlant, name: str, factor: float) -> str:
    """Returns the largest feasible value of a bound in words, given its fraction of the declared one."""
    if name == "remainder":
        return f"{factor:.3g} times the given remainder or less (shrink the box or the input limits)"
    largest = f"gamma = {factor * plant.gamma:.3g}" if name == "gamma" else f"{factor:.3g} times the given {name}"
    given = f" (given: {plant.gamma:g})" if name == "gamma" else ""
    return f"{largest} or less{given}"


def _figure(plant: LinearPlant, name: str, factor: float) -> dict[str, float]:
    """Returns the largest feasible value of a bound as it stands in the details of the exception."""
    return {"largest_gamma": factor * plant.gamma} if name == "gamma" else {f"{name}_factor": factor}


@dataclass(frozen=True)
class _Change:
    """Something about a plant that could be made easier.

    Attributes:
        name: Its name in the details of the exception.
        what: Its name in a sentence, after "2 times", or "a smaller ...".
        of: Returns the plant in which it is easier by a factor >= 1.
    """

    name: str
    what: str
    of: Callable[[LinearPlant, float], LinearPlant]


def _widenings(plant: LinearPlant) -> list[_Change]:
    """Returns the limits that could be wider: the box as a whole, each of its sides, each input.

    None of a plant with a remainder, which belongs to its box and input limits.
    """
    if plant.remainder is not None:
        return []

    def rows(chosen: slice) -> Callable[[LinearPlant, float], LinearPlant]:
        def wider(plant: LinearPlant, factor: float) -> LinearPlant:
            box = plant.box_rows.copy()
            box[chosen] /= factor
            return replace(plant, box=box)

        return wider

    def input_limit(i: int) -> Callable[[LinearPlant, float], LinearPlant]:
        return lambda plant, factor: replace(plant, u_max=plant.u_max * np.where(np.arange(plant.m) == i, factor, 1.0))

    changes = [
        _Change(f"u_max_{i + 1}", f"the limit of {plant.input_names[i]}", input_limit(i)) for i in range(plant.m)
    ]
    changes.append(_Change("box", "the safe box", rows(slice(None))))
    if len(plant.box_rows) > 1:
        changes += [
            _Change(f"box_row_{j + 1}", f"the limit {row_limit(plant, j)}", rows(slice(j, j + 1)))
            for j in range(len(plant.box_rows))
        ]
    return changes


def _smallest_pair(plant: LinearPlant, certifies: _Certifies) -> tuple[tuple[_Change, _Change], float] | None:
    """Returns the two changes that certify together with the smallest factor, the same for both; None for none."""

    def smaller(name: str) -> Callable[[LinearPlant, float], LinearPlant]:
        return lambda plant, factor: _with_scaled(plant, name, 1.0 / factor)

    shrinkings = [_Change(name, f"a smaller {name}", smaller(name)) for name in _BOUNDS if _is_declared(plant, name)]
    changes = [*shrinkings, *(each for each in _widenings(plant) if not each.name.startswith("box_row"))]
    best: tuple[tuple[_Change, _Change], float] | None = None
    for pair in combinations(changes, 2):
        factor = _smallest_factor(plant, pair, certifies, _WIDEST_PAIR if best is None else best[1] / _FACTOR_PRECISION)
        if factor is not None:
            best = pair, factor
    return best


def _smallest_factor(
    plant: LinearPlant, changes: Sequence[_Change], certifies: _Certifies, widest: float = _WIDENINGS[-1]
) -> float | None:
    """Returns nearly the smallest factor, at most `widest`, with which all changes together certify; None for none."""

    def is_enough(factor: float) -> bool:
        changed = plant
        for change in changes:
            changed = change.of(changed, factor)
        return certifies(changed)

    tried = [1.0, *(factor for factor in _WIDENINGS if factor < widest), widest]
    works = next((k for k, factor in enumerate(tried) if k and is_enough(factor)), None)
    if works is None:
        return None
    low, high = tried[works - 1], tried[works]
    while high > _FACTOR_PRECISION * low:
        middle = (low * high) ** 0.5
        low, high = (low, middle) if is_enough(middle) else (middle, high)
    return high


def _with_scaled(plant: LinearPlant, name: str, factor: float) -> LinearPlant:
    """Returns the plant with one of its bounds multiplied: lengths of an ellipsoid, entries of anything else."""
    value = getattr(plant, name)
    if isinstance(value, Remainder):
        scaled = replace(value, bound=Ellipsoid(factor**2 * value.bound.shape_matrix))
    else:
        scaled = Ellipsoid(factor**2 * value.shape_matrix) if isinstance(value, Ellipsoid) else factor * value
    return replace(plant, **{name: scaled})


def is_feasible(plant: LinearPlant, contract: ChannelContract | None, *, polytope: bool) -> bool:
    """Returns whether a gain is found that bears the plant's radii.

    Args:
        plant: The plant.
        contract: Channel contract, if there is one.
        polytope: Whether it is enough that it keeps a polytope.
    """
    try:
        problem, _ = design_problem(plant, contract)
    except Infeasible:
        return False
    return _margin(problem, polytope=polytope, enough=SUFFICIENT_MARGIN) >= SUFFICIENT_MARGIN


def _largest_age(plant: LinearPlant, contract: ChannelContract, polytope: bool) -> int | None:
    """Returns the largest feasible max_age below the contract's; None if there is none."""
    low, high = -1, contract.max_age
    while high - low > 1:
        middle = (low + high) // 2
        certifies = is_feasible(plant, replace(contract, max_age=middle), polytope=polytope)
        low, high = (middle, high) if certifies else (low, middle)
    return low if low >= 0 else None


def _largest_factor(plant: LinearPlant, name: str, certifies: _Certifies) -> float | None:
    """Returns nearly the largest feasible fraction of a bound; None if there is none above a millionth."""
    low, high = _SMALLEST_FACTOR, 1.0
    if not certifies(_with_scaled(plant, name, low)):
        return None
    while high > _FACTOR_PRECISION * low:
        middle = (low * high) ** 0.5
        low, high = (middle, high) if certifies(_with_scaled(plant, name, middle)) else (low, middle)
    return low


def _margin(problem: DesignProblem, *, polytope: bool, input_limits: bool = True, enough: float = np.inf) -> float:
    """Returns the factor on all radii that the best gain bears; 0 if no gain stabilizes.

    Args:
        problem: The scaled design problem.
        polytope: Whether it is enough that it keeps a polytope; no better gain is sought for that without input limits.
        input_limits: False leaves the input limits out.
        enough: A factor beyond which no larger one is sought.
    """
    gain = max_margin_gain(problem, problem.covering_error_shape, input_limits=input_limits)
    if gain is None:
        return 0.0
    of_ellipsoid = ellipsoid_margin(problem, gain, input_limits=input_limits)
    if not polytope or of_ellipsoid >= enough:
        return of_ellipsoid
    at_hand = max(of_ellipsoid, polytope_margin(problem, gain.K, input_limits=input_limits))
    if not input_limits or at_hand < _HOPELESS:
        return at_hand
    return max(at_hand, most_tolerant_gain(problem, gain, enough).margin)
