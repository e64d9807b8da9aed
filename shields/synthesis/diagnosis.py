"""Why a design problem is infeasible, and which bounds would be feasible."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ncs_gym import ChannelContract, Ellipsoid, LinearPlant, Remainder
from ncs_gym.estimation.error_bound import unseen_state
from ncs_gym.estimation.error_bounds_by_age import error_sets_by_age
from ncs_gym.plants.description import input_limit, mixed_limit, row_limit
from ncs_gym.plants.past_inputs import inputs_under_way
from shields.errors import Infeasible
from shields.synthesis.design_problem import DesignProblem, design_problem
from shields.synthesis.initial_designs import SUFFICIENT_MARGIN
from shields.synthesis.invariant_polytope import Feedback
from shields.synthesis.max_margin_gain import max_margin_gain
from shields.synthesis.polytope_gain import (
    ellipsoid_margin,
    most_tolerant_gain,
    needs_of,
    polytope_margin,
    regulators,
)
from shields.synthesis.resting_point import (
    farthest_equilibrium,
    farthest_from_limits,
    limits_around,
    needs_resting_point,
)

# What may be declared of the uncertainties. The largest value of each that has a certificate is sought down to this
# fraction of the given one, and to this ratio.
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
_FARTHEST, _FACTOR_PRECISION = 1e6, 1.02
# Limits are widened by these factors, until one works; two changes together by at most the last number.
_WIDENINGS, _WIDEST_PAIR = (2.0, 10.0, 100.0, 1e3, 1e4, _FARTHEST), 100.0
# A change that a quick search finds enough is made larger by these factors in turn, until it has a certificate.
_MORE = (1.0, 1.05, 1.2, 1.5, 2.0, 4.0)
# The same for limits with two ends, whose certificates have polytopes: next to the bound of what is possible these take
# long and have many rows.
_MORE_AROUND = (1.1, 1.3, 2.0, 4.0)
# Digits of the changes that are named.
_SHOWN_DIGITS = 3
# Where the ellipsoid's gain bears less of the radii than this with a polytope no better gain is sought: searches have
# gained an eighth.
_HOPELESS = 0.8
# Of contracts, where there is none, none for older samples is named [steps].
_OLDEST_NAMED = 32
# In the details of the exception: the fraction of all radii that has a certificate.
_SHARE = "share_of_radii"


class Clock:
    """Ends a search after some time of its own thread: what else a machine does changes no message."""

    def __init__(self, end: float) -> None:
        self._end = end

    @property
    def is_over(self) -> bool:
        """Whether the time is over."""
        return self.left == 0.0

    @property
    def left(self) -> float:
        """How much time is left [s]; 0.0 where none is."""
        return max(self._end - time.thread_time(), 0.0)

    def part(self, count: int) -> Clock:
        """Returns a clock with this part of the time that is left, or twice the part of many."""
        return Clock(time.thread_time() + self.left * min(2.0 / count, 1.0))

    def check(self, line: str = "") -> None:
        """Raises `TimeoutError` if the time is over; may be called as `progress`, with a line of text."""
        if self.is_over:
            raise TimeoutError


# Whether a plant has a certificate under a contract; raises `TimeoutError` once the clock has run out.
Certifies = Callable[[LinearPlant, ChannelContract | None, Clock], bool]


def infeasibility(plant: LinearPlant, problem: DesignProblem, *, polytope: bool) -> Infeasible:
    """Returns the exception that names the binding condition and the fraction of the radii that is feasible.

    Args:
        plant: The plant.
        problem: Its scaled design problem.
        polytope: Whether a polytope alone would do, too.
    """
    fraction = min(_margin(problem, polytope=polytope), 1.0)
    if fraction == 0.0:
        return _unstabilized(plant)
    binding = "U" if _margin(problem, polytope=polytope, input_limits=False) >= 1.0 else "I"
    missing = "ellipsoid or polytope" if polytope else "ellipsoid"
    what = (
        "(U) no gain was found that keeps the input limits"
        if binding == "U"
        else f"(I) no invariant {missing} in the box was found"
    )
    return _with_share(what, binding, fraction)


def infeasibility_around(plant: LinearPlant, contract: ChannelContract | None, reason: str) -> Infeasible:
    """Returns what `infeasibility` does where limits have two ends, or leave a state free.

    Args:
        plant: The plant.
        contract: Channel contract, if there is one.
        reason: Why a gain that bears the radii was given up.
    """
    tolerance = _tolerance_around(plant, contract)
    if tolerance.margin == 0.0:
        return _unstabilized(plant)
    if tolerance.margin >= 1.0:
        what = "(P) a gain bears disturbances and errors within the limits, but its polytope was not found"
        return Infeasible(f"{what}: {reason}", "P", 0.0)
    k, m = len(plant.box), plant.m
    is_input = [k <= j < k + m for j in tolerance.binding]
    what = "(I) no invariant polytope within the limits was found"
    if is_input and all(is_input):
        what = "(U) no gain was found that keeps the input limits"
    elif tolerance.binding:
        what += f" (those that bind: {', '.join(_limit(plant, j) for j in tolerance.binding)})"
    return _with_share(what, what[1], tolerance.margin)


def _unstabilized(plant: LinearPlant) -> Infeasible:
    unstabilized = "(I) no gain was found that stabilizes the plant, whatever the bounds are"
    unmoved = unseen_state(plant.A.T, plant.B.T, 1.0 / plant.half_widths, plant.state_names)
    if unmoved is not None:
        unstabilized = f"(I) no gain stabilizes the plant: no input moves {unmoved}, which does not decay by itself"
    return Infeasible(unstabilized, "I", 1.0, {_SHARE: 0.0})


def _with_share(what: str, binding: str, fraction: float) -> Infeasible:
    return Infeasible(f"{what}: {_once(fraction)}", binding, 1.0 - fraction, {_SHARE: fraction})


def _once(fraction: float) -> str:
    """Returns for which fraction of all radii there is a certificate, as the rest of a sentence."""
    return (
        "a quick search finds one once disturbance and error radii shrink to "
        f"{100.0 * fraction:.{_SHOWN_DIGITS}g}% of those given"
    )


def _limit(plant: LinearPlant, j: int) -> str:
    """Returns limit j of those of states, of inputs and of both together."""
    k, m = len(plant.box), plant.m
    if j < k:
        return row_limit(plant, j)
    return input_limit(plant, j - k) if j < k + m else mixed_limit(plant, j - k - m)


def with_feasible_bounds(
    infeasible: Infeasible,
    plant: LinearPlant,
    contract: ChannelContract | None,
    progress: Callable[[str], object] = lambda line: None,
    *,
    polytope: bool = True,
    certifies: Certifies | None = None,
    clock: Clock | None = None,
) -> Infeasible:
    """Returns the exception with single changes that have a certificate: of max_age, of each bound, of each limit.

    Each is changed alone, the others being as they are given.

    Args:
        infeasible: The exception without these figures.
        plant: The plant for which no certificate was found.
        contract: The channel contract. Nothing is sought for an unstable plant without one, or that no gain stabilizes
            or no age makes known, or whose safe box is unbounded: the exception is then returned as it is.
        progress: Called with a line of text per figure that is sought.
        polytope: Whether a polytope alone would do, too.
        certifies: Whether a plant has a certificate under a contract. A change that a quick search finds enough is made
            larger until it has, or is not named. The quick search decides by default.
        clock: Ends the search; what was found by then is named.
    """
    if not _may_be_helped(infeasible, plant, contract):
        return infeasible
    clock = Clock(np.inf) if clock is None else clock
    search = _Search(plant, contract, polytope, certifies, clock)
    infeasible = _with_share_that_certifies(infeasible, search, progress)
    hints, smaller, wider, details = [], [], [], dict(infeasible.details)
    if contract is not None and contract.max_age > 0:
        progress("no certificate: searching for a max_age that has one")
        age = search.largest_age()
        if age is not None:
            hints.append(f"max_age = {age} or less")
            details["max_age"] = age
        elif not clock.is_over:
            smaller.append("max_age")
    elif contract is None and infeasible.binding != "E1":
        progress("no certificate: searching for a contract that has one")
        if (age := search.oldest_with_contract()) is not None:
            hints.append(f"a contract of the channel (contract=ChannelContract({age}), or of less age)")
            details["max_age"] = age
    changes = [] if infeasible.binding == "E1" else [*_shrinkings(plant), *_widenings(plant)]
    promising: list[tuple[_Change, float]] = []
    for k, change in enumerate(changes):
        progress(f"no certificate: searching for {change.what} that has one")
        try:
            factor = search.promising((change,), clock.part(len(changes) - k))
        except TimeoutError:
            continue
        if factor is None:
            (wider if change.rises else smaller).append(change.what if change.rises else change.name)
        else:
            promising.append((change, factor))
    for k, (change, factor) in enumerate(promising):
        progress(f"no certificate: following {change.what}")
        found = search.enough((change,), factor, clock.part(len(promising) - k))
        if found is not None:
            hints.append(change.hint(found))
            details[change.detail] = change.value(found)
    told = [f"single changes that a search finds enough: {'; '.join(hints)}"] if hints else []
    told += _vain(smaller, wider)
    if len(details) == len(infeasible.details) and infeasible.binding != "E1" and not clock.is_over:
        progress("no certificate: searching for two changes that have one")
        if (pair := search.smallest_pair(changes)) is not None:
            (first, second), factor = pair
            told.append(f"the smallest pair of changes: {first.what} and {second.what}, {factor:.3g} times each")
            details |= {"pair_factor": factor}
    if clock.is_over:
        told.append("the search for changes ended for want of time")
    asked = "" if contract is None else f" (asked: max_age = {contract.max_age})"
    text = "; ".join([f"{infeasible}{_limits_exceeded(plant)}", *told]) + asked
    return Infeasible(text, infeasible.binding, infeasible.shortfall, details)


def _may_be_helped(infeasible: Infeasible, plant: LinearPlant, contract: ChannelContract | None) -> bool:
    """Returns whether a single change of bounds, limits or age may help."""
    if infeasible.binding == "E1":
        return contract is not None and error_sets_by_age(plant, replace(contract, max_age=0)) is not None
    return infeasible.binding != "S" and infeasible.details.get(_SHARE) != 0.0


def _with_share_that_certifies(
    infeasible: Infeasible, search: _Search, progress: Callable[[str], object]
) -> Infeasible:
    """Returns the exception with a fraction of all radii that has a certificate; without one if none near it has."""
    share = infeasible.details.get(_SHARE)
    if share is None:
        return infeasible
    progress("no certificate: searching for radii that have one")
    everything = _Change(_SHARE, "all radii", _with_all_radii, rises=False)
    factor = search.enough((everything,), 1.0 / share, search.clock.part(5))
    others = {name: value for name, value in infeasible.details.items() if name != _SHARE}
    if factor is None:
        text = str(infeasible).replace(f": {_once(share)}", "")
        return Infeasible(text, infeasible.binding, infeasible.shortfall, others)
    found = everything.value(factor)
    text = str(infeasible).replace(_once(share), _once(found))
    return Infeasible(text, infeasible.binding, 1.0 - found, others | {_SHARE: found})


def _vain(smaller: Sequence[str], wider: Sequence[str]) -> list[str]:
    """Returns what a quick search found of no help: smaller bounds, and wider limits."""
    parts = [f"with a smaller {' or '.join(smaller)}"] if smaller else []
    if wider:
        parts.append(f"with {' or '.join(wider)} up to {_FARTHEST:.0e} times as large")
    return [f"a quick search finds none {', nor '.join(parts)}"] if parts else []


def _limits_exceeded(plant: LinearPlant) -> str:
    """Returns which limits of the safe box a disturbance or a first error alone exceeds, as the rest of a sentence."""
    two_ends = np.flatnonzero(np.isfinite(plant.box_ends).all(axis=0)).tolist()
    alone = {
        "the disturbance of one step": plant.nominal_disturbance,
        "the error of the first estimate": plant.nominal_initial_error,
    }
    return "".join(
        f"; {what} alone reaches {size:.3g} times the limit {row_limit(plant, j)}"
        for what, shape in alone.items()
        for j, size in enumerate(np.ravel(shape.support(plant.box)).tolist())
        if size >= 1.0 and j in two_ends
    )


def _is_declared(plant: LinearPlant, name: str) -> bool:
    """Returns whether the plant declares an uncertainty by this name that is not zero."""
    value = getattr(plant, name)
    value = value.bound if isinstance(value, Remainder) else value
    return value is not None and bool(np.any(value.shape_matrix if isinstance(value, Ellipsoid) else value))


@dataclass(frozen=True)
class _Change:
    """Something about a plant that could be made easier.

    Attributes:
        name: What the details of the exception name it by.
        what: What it is in a sentence: "a smaller ...", or of limits what has to be larger.
        of: Returns the plant in which it has another value, in units of the given one.
        rises: Whether larger values are easier.
        given: The value that is told, in place of a ratio.
        note: Follows the change in words.
    """

    name: str
    what: str
    of: Callable[[LinearPlant, float], LinearPlant]
    rises: bool = True
    given: float | None = None
    note: str = ""

    def value(self, factor: float) -> float:
        """Returns the value that is easier by a factor >= 1 at least, in few digits."""
        value = (1.0 if self.given is None else self.given) * (factor if self.rises else 1.0 / factor)
        unit = 10.0 ** (math.floor(math.log10(value)) - _SHOWN_DIGITS + 1)
        steps = float(math.ceil(round(value / unit, 6)) if self.rises else math.floor(round(value / unit, 6)))
        return float(f"{steps * unit:.{_SHOWN_DIGITS - 1}e}")

    def applied(self, plant: LinearPlant, factor: float) -> LinearPlant:
        """Returns the plant with that value."""
        return self.of(plant, self.value(factor) / (1.0 if self.given is None else self.given))

    @property
    def detail(self) -> str:
        """The key in the details of the exception."""
        return f"largest_{self.name}" if self.given is not None else f"{self.name}_factor"

    def hint(self, factor: float) -> str:
        """Returns the change in words."""
        value = self.value(factor)
        if self.rises:
            return f"{value:.3g} times {self.what} or more{self.note}"
        if self.given is not None:
            return f"{self.name} = {value:.3g} or less (given: {self.given:g})"
        return f"{value:.3g} times the given {self.name} or less{self.note}"


def _shrinkings(plant: LinearPlant) -> list[_Change]:
    """Returns the bounds that could be smaller."""

    def scaled(name: str) -> Callable[[LinearPlant, float], LinearPlant]:
        return lambda plant, factor: _with_scaled(plant, name, factor)

    changes = [
        _Change(name, f"a smaller {name}", scaled(name), rises=False, given=plant.gamma if name == "gamma" else None)
        for name in _BOUNDS
        if _is_declared(plant, name)
    ]
    of_remainder = "the box or the input limits" if plant.members is None else "the ranges of the parameters"
    return [replace(each, note=f" (shrink {of_remainder})") if each.name == "remainder" else each for each in changes]


def _widenings(plant: LinearPlant) -> list[_Change]:
    """Returns the limits that could be wider: each input, the box as a whole, each of its sides, each mixed one.

    None of a plant with a remainder, which belongs to its box and input limits. Limits that are not symmetric are
    widened from the operating point.
    """
    if plant.remainder is not None:
        return []

    from_point = "" if plant.is_symmetric else ", counted from the operating point"

    def rows(chosen: slice) -> Callable[[LinearPlant, float], LinearPlant]:
        def wider(plant: LinearPlant, factor: float) -> LinearPlant:
            box = plant.box.copy()
            box[chosen] /= factor
            return replace(plant, box=box)

        return wider

    def of_input(i: int) -> Callable[[LinearPlant, float], LinearPlant]:
        def wider(plant: LinearPlant, factor: float) -> LinearPlant:
            return replace(plant, input_ends=plant.input_ends * np.where(np.arange(plant.m) == i, factor, 1.0))

        return wider

    def mixed(j: int) -> Callable[[LinearPlant, float], LinearPlant]:
        def wider(plant: LinearPlant, factor: float) -> LinearPlant:
            together = plant.mixed_rows.copy()
            together[j] /= factor
            return replace(plant, mixed_rows=together)

        return wider

    changes = [
        _Change(f"u_max_{i + 1}", f"the limit of {plant.input_names[i]}", of_input(i), note=from_point)
        for i in range(plant.m)
    ]
    own = plant.n - inputs_under_way(plant)
    sides = [j for j, row in enumerate(plant.box) if row[:own].any()]
    if len(sides) != 1:
        changes.append(_Change("box", "the safe box", rows(slice(None)), note=from_point))
    changes += [
        _Change(f"box_row_{j + 1}", f"the limit {row_limit(plant, j)}", rows(slice(j, j + 1)), note=from_point)
        for j in sides
    ]
    changes += [
        _Change(f"mixed_limit_{j + 1}", f"the limit {mixed_limit(plant, j)}", mixed(j), note=from_point)
        for j in range(len(plant.mixed_rows))
    ]
    return changes


@dataclass(frozen=True)
class _Search:
    """The search for changes with which a plant has a certificate; the fields are those of `with_feasible_bounds`."""

    plant: LinearPlant
    contract: ChannelContract | None
    polytope: bool
    certifies: Certifies | None
    clock: Clock

    def promising(self, changes: Sequence[_Change], clock: Clock, widest: float = _FARTHEST) -> float | None:
        """Returns nearly the smallest factor, at most `widest`, with which a quick search finds all changes enough.

        Raises:
            TimeoutError: If the time is over.
        """

        def is_enough(factor: float) -> bool:
            clock.check()
            return is_feasible(_changed(self.plant, changes, factor), self.contract, polytope=self.polytope)

        if not any(change.rises for change in changes) and not is_enough(widest):
            return None
        tried = [1.0, *(factor for factor in _WIDENINGS if factor < widest), widest]
        works = next((k for k, factor in enumerate(tried) if k and is_enough(factor)), None)
        if works is None:
            return None
        low, high = tried[works - 1], tried[works]
        while high > _FACTOR_PRECISION * low and not clock.is_over:
            middle = (low * high) ** 0.5
            low, high = (low, middle) if is_enough(middle) else (middle, high)
        return high

    def enough(self, changes: Sequence[_Change], factor: float, clock: Clock) -> float | None:
        """Returns a factor from a promising one on with which there is a certificate; None for none in the time."""
        if self.certifies is None:
            return factor
        try:
            for more in _MORE_AROUND if needs_resting_point(self.plant) else _MORE:
                clock.check()
                if self.certifies(_changed(self.plant, changes, more * factor), self.contract, clock):
                    return more * factor
        except TimeoutError:
            pass
        return None

    def oldest_with_contract(self) -> int | None:
        """Returns a max_age of a contract that has a certificate, where there is none; None for none in the time.

        No larger one than `_OLDEST_NAMED` is sought.
        """
        return replace(self, contract=ChannelContract(_OLDEST_NAMED + 1)).largest_age()

    def largest_age(self) -> int | None:
        """Returns the largest max_age below the contract's that has a certificate; None for none in the time."""
        assert self.contract is not None
        contract, clock, low, high = self.contract, self.clock.part(5), -1, self.contract.max_age

        def of_age(age: int) -> ChannelContract:
            return replace(contract, max_age=age)

        try:
            while high - low > 1:
                clock.check()
                middle = (low + high) // 2
                is_enough = is_feasible(self.plant, of_age(middle), polytope=self.polytope)
                low, high = (middle, high) if is_enough else (low, middle)
            if self.certifies is None or low < 0:
                return low if low >= 0 else None
            for age in sorted({low, low - 1, (3 * low) // 4, low // 2, 0}, reverse=True):
                clock.check()
                if age >= 0 and self.certifies(self.plant, of_age(age), clock):
                    return age
        except TimeoutError:
            pass
        return None

    def smallest_pair(self, changes: Sequence[_Change]) -> tuple[tuple[_Change, _Change], float] | None:
        """Returns the two changes that are enough together with the smallest factor, the same for both; or None."""
        broad = [each for each in changes if not each.name.startswith(("box_row", "mixed_limit"))]
        pairs: list[tuple[tuple[_Change, _Change], float]] = []
        clock, widest = self.clock.part(3), _WIDEST_PAIR
        try:
            for pair in combinations(broad, 2):
                if (factor := self.promising(pair, clock, widest)) is not None:
                    pairs.append((pair, factor))
                    widest = factor / _FACTOR_PRECISION
        except TimeoutError:
            pass
        for pair, factor in reversed(pairs):
            if (found := self.enough(pair, factor, self.clock)) is not None:
                return pair, found
        return None


def _changed(plant: LinearPlant, changes: Sequence[_Change], factor: float) -> LinearPlant:
    for change in changes:
        plant = change.applied(plant, factor)
    return plant


def _with_all_radii(plant: LinearPlant, factor: float) -> LinearPlant:
    """Returns the plant with the radii of all its bounds multiplied."""
    for name in _BOUNDS:
        if _is_declared(plant, name):
            is_squared = name == "gamma" or name.endswith("_cov")
            plant = _with_scaled(plant, name, factor**2 if is_squared else factor)
    return plant


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
        return margin_of(plant, contract, polytope=polytope, enough=SUFFICIENT_MARGIN) >= SUFFICIENT_MARGIN
    except Infeasible:
        return False


def margin_of(
    plant: LinearPlant, contract: ChannelContract | None, *, polytope: bool = True, enough: float = np.inf
) -> float:
    """Returns the factor on all radii that the best gain bears that is found; 0 for none.

    Args:
        plant: The plant.
        contract: Channel contract, if there is one.
        polytope: Whether it is enough that it keeps a polytope.
        enough: A factor beyond which no larger one is sought.

    Raises:
        Infeasible: If there is no error set, or no equilibrium within limits with two ends.
    """
    if needs_resting_point(plant):
        return _tolerance_around(plant, contract, enough).margin
    problem, _ = design_problem(plant, contract)
    return _margin(problem, polytope=polytope, enough=enough)


class _Tolerance(NamedTuple):
    """The factor on all radii that the best gain bears, and the limits, as in `distances`, that it reaches first."""

    margin: float
    binding: tuple[int, ...] = ()


def _tolerance_around(plant: LinearPlant, contract: ChannelContract | None, enough: float = np.inf) -> _Tolerance:
    """Returns what the best gain bears that is found for limits with two ends, around the resting point that suits it.

    Args:
        plant: The plant.
        contract: Channel contract, if there is one.
        enough: A factor beyond which no larger one is sought.

    Raises:
        Infeasible: If there is no error set, or no equilibrium within the limits.
    """
    rest = farthest_from_limits(plant)
    problem, errors = design_problem(plant, contract, limits_around(plant, rest))

    def tolerance(K: np.ndarray, at_least: float = 0.0) -> _Tolerance:
        needs = needs_of(Feedback(K, errors.promised, plant.disturbance.shape_matrix, rest), plant)
        if needs is None:
            return _Tolerance(at_least)
        farthest = farthest_equilibrium(plant, needs)
        return _Tolerance(max(farthest.distance, at_least), tuple(farthest.binding.tolist()))

    start = max_margin_gain(problem, problem.covering_error_shape)
    gains = [(K, 0.0) for K in regulators(plant)]
    if start is not None:  # the problem is without limits of states and inputs together
        margin = 0.0 if len(plant.mixed_rows) else start.margin
        gains.insert(0, (problem.to_physical(start.L, start.K)[1], margin))
    best = _Tolerance(0.0)
    for K, at_least in gains:
        best = max(best, tolerance(K, at_least), key=lambda each: each.margin)
        if best.margin >= enough:
            return best
    if start is None or best.margin < _HOPELESS:
        return best
    K = problem.to_physical(start.L, most_tolerant_gain(problem, start, SUFFICIENT_MARGIN).K)[1]
    return max(best, tolerance(K), key=lambda each: each.margin)


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
