"""Which networks leave a plant certifiable: one search for all networks that ask for the same ages of samples."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from math import ceil, inf, log2
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linprog

from ncs_gym import ChannelContract, Ellipsoid, LinearPlant
from ncs_gym.network.contract import MAX_AGE
from shields.certificate import Certificate
from shields.synthesis.certification import carried_over, nearby_certificate
from shields.synthesis.diagnosis import margin_of
from shields.synthesis.network_requirements import LargestAge, Network, Requirement, Requirements, share_of

# Ages that one search goes through, each from the certificate of the last; other processes have the others.
_AGES_PER_SEARCH = 6
# Where all ages that are asked certify, older ones are sought up to so many times the oldest of these.
_BEYOND = 4
# Bits of a number that is not quantized.
_FLOAT_BITS = 64
# A tolerated factor is first sought this close below the margin that a gain is known to have, then ever farther below.
_FACTOR_STEPS = (0.999, 0.99, 0.97, 0.94, 0.9, 0.8, 0.65, 0.5)


class Answer(NamedTuple):
    """What a search found for one age: a certificate or none, and the factor on all radii that it tolerates."""

    certificate: Certificate | None
    searched: bool = True
    tolerance: float | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Search:
    """Certificates for some ages of one plant, each sought near that of the age before; the unit of parallel work.

    Attributes:
        title: What it searches, in words; no other search of the same networks has the same.
        plant: The plant, as it is sampled and disturbed.
        quantization_step: Of the contract.
        ages: Largest ages [steps], ascending; infinite for no contract.
        tolerance: Whether the factor that all radii may grow by is sought, too.
    """

    title: str
    plant: LinearPlant
    quantization_step: float
    ages: tuple[float, ...]
    tolerance: bool = False

    @property
    def certain(self) -> tuple[float, ...]:
        """The ages that have an answer in any case."""
        return self.ages

    @property
    def count(self) -> int:
        """How many parts of it are reported."""
        return len(self.ages)

    def __call__(self, report: Callable[[int], object] = lambda count: None) -> dict[float, Answer]:
        """Returns the answer for every age; ages beyond one for which none is found are not searched.

        A certificate of such an age would be one of the smaller age, too, for which none was found.

        Args:
            report: Called with the number of its parts that are done since its last call.
        """
        answers: dict[float, Answer] = {}
        last: Certificate | None = None
        for age in self.ages:
            if answers and last is None:
                answers[age] = Answer(None, searched=False)
            else:
                last = nearby_certificate(self.plant, contract_of_age(age, self.quantization_step), last)
                factor = None if last is None or not self.tolerance else self._tolerance(age, last)
                answers[age] = Answer(last, tolerance=factor)
            report(1)
        return answers

    def _tolerance(self, age: float, certificate: Certificate) -> float:
        """Returns nearly the largest factor on all radii for which a certificate verifies; at least 1."""
        margin = margin_of(self.plant, contract_of_age(age, self.quantization_step))
        for share in _FACTOR_STEPS:
            factor = float(f"{share * margin:.3g}")
            if factor <= 1.0:
                break
            plant = with_radii(self.plant, disturbance=factor, noise=factor)
            if nearby_certificate(plant, contract_of_age(age, self.quantization_step), certificate, 0) is not None:
                return factor
        return 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class BoundarySearch(Search):
    """The search for the largest age that certifies, beyond one that does.

    Attributes:
        start: The certificate of the first of `ages`; none is known for the second, if there is one.
    """

    start: Certificate

    @property
    def certain(self) -> tuple[float, ...]:
        """None: which ages are asked depends on what is found."""
        return ()

    @property
    def count(self) -> int:
        """Bisections, and where no age is known to have none what is asked before."""
        low, high = self._ends
        return ceil(log2(max(self._oldest - low, 1))) + (3 if high == inf else 0)

    @property
    def _ends(self) -> tuple[int, float]:
        return int(self.ages[0]), self.ages[-1] if len(self.ages) > 1 else inf

    @property
    def _oldest(self) -> int:
        """The oldest age that may be asked: the one that is known to have none, or what doubling ends at."""
        low, high = self._ends
        return min(_BEYOND * (low + 1), MAX_AGE) if high == inf else int(high)

    def __call__(self, report: Callable[[int], object] = lambda count: None) -> dict[float, Answer]:
        """Returns the answers for the ages that bisection asks, after doubling where no age is known to have none.

        Before doubling, `_BEYOND`-fold at most, it asks for a certificate that needs no samples, as stable plants may
        have.
        """
        answers: dict[float, Answer] = {}
        (low, high), best, left = self._ends, self.start, self.count
        if high == inf and (certificate := nearby_certificate(self.plant, None, best)) is not None:
            report(left)
            return {inf: Answer(certificate)}
        report(0)  # the caller may end the search here, and after every age
        while high - low > 1 and low < self._oldest:
            age = min(2 * low + 1, self._oldest) if high == inf else (low + int(high)) // 2
            certificate = nearby_certificate(self.plant, contract_of_age(age, self.quantization_step), best)
            answers[age] = Answer(certificate)
            if certificate is None:
                high = age
            else:
                low, best = age, certificate
            report(1)
            left -= 1
        report(left)
        return answers


def contract_of_age(age: float, quantization_step: float) -> ChannelContract | None:
    """Returns the contract of an age; None if it is infinite."""
    return None if age == inf else ChannelContract(int(age), quantization_step)


# Executes searches, in any order and anywhere, and returns their answers in the order of the searches.
Executor = Callable[[Sequence[Search]], Iterable[Mapping[float, Answer]]]


def requirements(
    plant: LinearPlant | Callable[[float], LinearPlant],
    *,
    sampling_periods: Sequence[float] | None = None,
    send_periods: Sequence[int] = (1,),
    losses: Sequence[int | None] = (0,),
    delays: Sequence[int] = (0,),
    jitters: Sequence[int] = (0,),
    input_delays: Sequence[int] = (0,),
    quantization_steps: Sequence[float] = (0.0,),
    disturbances: Sequence[float] = (1.0,),
    noises: Sequence[float] = (1.0,),
    tolerance: bool = False,
    execute: Executor | None = None,
) -> Requirements:
    """Returns which networks leave a plant certifiable, for all combinations of what is given.

    Every network that is reported as possible has a certificate that verified in exact arithmetic. Of the others it is
    known that none was found. By construction more is never less: a network that is easier than another one in every
    respect keeps at least its share.

    Args:
        plant: The plant; or a function that returns the plant for a sampling period in seconds.
        sampling_periods: Durations of a control step [s], other than the plant's for a plant with a model in continuous
            time (`LinearPlant.resampled` says what becomes of its disturbances); by default the plant's own.
        send_periods: Steps between samples.
        losses: Most packets lost in a row; None for any number, which only stable plants can bear.
        delays: Fixed delays of samples [steps].
        jitters: Largest further delays [steps].
        input_delays: Steps from a decision until its input takes effect: the contract of a downlink.
        quantization_steps: Steps of the quantizer, in the units of y; 0 for none.
        disturbances: Factors on the radii of the plant's disturbances.
        noises: Factors on the radii of sensor noise and first errors.
        tolerance: Whether to seek, for every network, the factor by which all radii may grow.
        execute: Executes the searches, for instance in parallel; here, one after the other, by default.

    Raises:
        ValueError: If a value is out of range, a list is empty, or the plant cannot be sampled at another period.
    """
    if sampling_periods is None:
        if not isinstance(plant, LinearPlant):
            raise ValueError("a function that returns the plant needs sampling_periods=[...], in seconds")
        sampling_periods = (plant.dt,)
    axes = {
        "sampling_period": sampling_periods,
        "send_period": send_periods,
        "losses": losses,
        "delay": delays,
        "jitter": jitters,
        "input_delay": input_delays,
        "quantization_step": quantization_steps,
        "disturbance": disturbances,
        "noise": noises,
    }
    for name, values in axes.items():
        if len(values) == 0 or len(set(values)) != len(values):
            raise ValueError(f"{name} needs different values, at least one")
    networks = [Network(**dict(zip(axes, values, strict=True))) for values in product(*axes.values())]
    groups: dict[_Group, _Ages] = {}
    for network in networks:
        key = _group_of(network)
        if key not in groups:
            groups[key] = _Ages(_plant_of(plant, network), network)
        groups[key].asked.add(network.age)
    _answer([(group, search) for group in groups.values() for search in group.searches(tolerance)], execute)
    beyond = [(group, search) for group in groups.values() if (search := group.boundary_search()) is not None]
    _answer(beyond, execute)
    _never_less(groups)
    ranges = {key: _output_ranges(group.plant) for key, group in groups.items()}
    points = []
    for network in networks:
        key = _group_of(network)
        certificate, searched, factor = groups[key].answers[network.age]
        bits = network.packets_per_second * _bits_of_sample(ranges[key], network.quantization_step)
        points.append(
            Requirement(
                network=network,
                certificate=certificate,
                searched=searched,
                tolerance=factor,
                bits_per_second=bits,
            )
        )
    return Requirements(points=tuple(points), largest_ages=tuple(group.largest() for group in groups.values()))


class _Group(NamedTuple):
    """What ages are compared under."""

    sampling_period: float
    quantization_step: float
    disturbance: float
    noise: float

    def is_harder_than(self, other: _Group) -> bool:
        """Whether no respect is easier, at the same sampling period."""
        return self[0] == other[0] and all(a >= b for a, b in zip(self[1:], other[1:], strict=True))


def _group_of(network: Network) -> _Group:
    return _Group(network.sampling_period, network.quantization_step, network.disturbance, network.noise)


@dataclass(eq=False)
class _Ages:
    """The ages that are asked of one group, and what was found."""

    plant: LinearPlant
    network: Network
    asked: set[float] = field(default_factory=set)
    answers: dict[float, Answer] = field(default_factory=dict)

    def searches(self, tolerance: bool) -> list[Search]:
        """Returns searches for all ages, a few each."""
        ages, count = sorted(self.asked), _AGES_PER_SEARCH
        return [
            Search(
                title=f"{self.network.setting}, ages {part[0]:g} to {part[-1]:g}",
                plant=self.plant,
                quantization_step=self.network.quantization_step,
                ages=part,
                tolerance=tolerance,
            )
            for part in (tuple(ages[i : i + count]) for i in range(0, len(ages), count))
        ]

    def boundary_search(self) -> BoundarySearch | None:
        """Returns the search for the largest age that certifies; None if it is known, or nothing certifies."""
        low, high = self._boundary()
        if low is None or low == inf or (high is not None and high - low <= 1):
            return None
        certificate = self.answers[low].certificate
        assert certificate is not None
        return BoundarySearch(
            title=f"{self.network.setting}, ages beyond {low:g}",
            plant=self.plant,
            quantization_step=self.network.quantization_step,
            ages=(low,) if high is None or high == inf else (low, high),
            start=certificate,
        )

    def largest(self) -> LargestAge:
        """Returns the boundary."""
        return LargestAge(self.network, *self._boundary())

    def _boundary(self) -> tuple[float | None, float | None]:
        certified = [age for age, answer in self.answers.items() if answer.certificate is not None]
        low = max(certified, default=None)
        beyond = [age for age in self.answers if low is None or age > low]
        return low, min(beyond, default=None)


def _answer(searches: Sequence[tuple[_Ages, Search]], execute: Executor | None) -> None:
    """Executes searches and gives the answers to their groups."""
    alone = [search for _, search in searches]
    found = [search() for search in alone] if execute is None else execute(alone)
    for (group, _), answers in zip(searches, found, strict=True):
        group.answers.update(answers)


def _never_less(groups: dict[_Group, _Ages]) -> None:
    """Lets every problem have the certificate of a harder one where that keeps more of the box."""
    problems = [(key, age) for key, group in groups.items() for age in group.answers]
    for key, age in sorted(problems, key=lambda each: -each[1]):
        group, own = groups[key], groups[key].answers[age]
        harder = [
            groups[other].answers[older]
            for other, older in problems
            if (other, older) != (key, age) and older >= age and other.is_harder_than(key)
        ]
        for answer in sorted(harder, key=lambda each: share_of(each.certificate), reverse=True):
            if answer.certificate is None or share_of(answer.certificate) <= share_of(own.certificate):
                break
            certificate = carried_over(answer.certificate, group.plant, contract_of_age(age, key.quantization_step))
            if certificate is not None:
                own = own._replace(certificate=certificate)
                break
        factors = [each.tolerance for each in (own, *harder) if each.tolerance is not None]
        group.answers[age] = own._replace(tolerance=max(factors, default=None))


def _plant_of(plant: LinearPlant | Callable[[float], LinearPlant], network: Network) -> LinearPlant:
    """Returns the plant as a network samples it, with its bounds as large as asked."""
    if isinstance(plant, LinearPlant):
        sampled = plant.resampled(network.sampling_period)
    else:
        sampled = plant(network.sampling_period)
        if not isinstance(sampled, LinearPlant):
            raise ValueError(f"the function must return a LinearPlant, got {type(sampled).__name__}")
    return with_radii(sampled, disturbance=network.disturbance, noise=network.noise)


def with_radii(plant: LinearPlant, *, disturbance: float, noise: float) -> LinearPlant:
    """Returns the plant with the radii of its disturbances, and of sensor noise and first errors, multiplied.

    Raises:
        ValueError: If disturbances are to change and the plant has a remainder, which belongs to its box and limits.
    """
    changes: dict[str, Any] = {}
    if disturbance != 1.0:
        if plant.remainder is not None:
            raise ValueError("the remainder of a fitted model is no disturbance whose size may be chosen")
        changes["gamma"] = disturbance**2 * plant.gamma
        changes["process_noise_cov"] = disturbance**2 * plant.process_noise_cov
        changes["disturbance_bound"] = _scaled(plant.disturbance_bound, disturbance)
    if noise != 1.0:
        for name in ("measurement_noise_cov", "initial_cov"):
            changes[name] = noise**2 * getattr(plant, name)
        for name in ("sensor_bound", "initial_bound"):
            changes[name] = _scaled(getattr(plant, name), noise)
    return replace(plant, **changes) if changes else plant


def _scaled(bound: Ellipsoid | None, factor: float) -> Ellipsoid | None:
    return None if bound is None else Ellipsoid(factor**2 * bound.shape_matrix)


def _output_ranges(plant: LinearPlant) -> np.ndarray:
    """Returns the largest |y_i| for states in the safe box, with the sensor noise, shape (p,)."""
    above, below = np.isfinite(plant.box_high), np.isfinite(plant.box_low)
    rows = np.concatenate([plant.box[above], -plant.box[below]])
    ends = np.concatenate([plant.box_high[above], -plant.box_low[below]])
    reach = [
        max(
            -solved.fun if (solved := linprog(-sign * row, A_ub=rows, b_ub=ends, bounds=(None, None))).success else inf
            for sign in ((1.0,) if plant.is_symmetric else (1.0, -1.0))
        )
        for row in plant.H
    ]
    return np.array(reach) + np.sqrt(np.diag(plant.sensor_error.shape_matrix))


def _bits_of_sample(ranges: np.ndarray, quantization_step: float) -> float:
    """Returns the bits of one measurement: enough for every level of the quantizer within the ranges."""
    if quantization_step == 0.0:
        return float(_FLOAT_BITS * len(ranges))
    levels = 2.0 * np.floor(ranges / quantization_step + 0.5) + 1.0
    return float(sum(ceil(log2(count)) if np.isfinite(count) else _FLOAT_BITS for count in levels))
