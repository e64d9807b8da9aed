"""For which plants the synthesis finds a certificate, and how long it takes: `python -m benchmarks.synthesis COMMAND`.

Commands: times, trust, units, families.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar
from unittest import mock

import gymnasium as gym
import numpy as np

from benchmarks.commands import run, table
from benchmarks.random_plants import badly_scaled_plant, random_plant, slow_and_fast_plant
from benchmarks.timing import timed
from ncs_gym import Ball, Bounds, LinearPlant, cart_pole, family, truck_trailer
from ncs_gym.envs.env import ncs_env
from ncs_gym.estimation.error_bound import certified_error_set
from ncs_gym.plants.library import convoy, lane_keeping
from ncs_gym.registration import registered_ids
from shields import Certificate, Infeasible, synthesize, verify
from shields.paper.bounds import with_noise
from shields.synthesis import certification

# Largest half-width of the error set of random plants, of 1.
ERROR_RADIUS = 0.6


def certified(plant: LinearPlant) -> Certificate | Infeasible:
    """Returns a certificate with an ellipsoid that verifies, or why there is none; anything else is an error.

    Raises:
        AssertionError: If a certificate does not verify.
    """
    try:
        certificate = synthesize(plant, safe_set="ellipsoid")
    except Infeasible as infeasible:
        return infeasible
    report = verify(certificate, plant)
    if not report.valid:
        raise AssertionError(f"a certificate does not verify:\n{report}")
    return certificate


def times(seeds: int = 3, largest: int = 12) -> None:
    """How long the certified synthesis takes and how large its sets are, over plants of growing size.

    Random plants are stable and their error set reaches 0.6 of the box's half-width, which leaves little room. Volumes
    are relative to the largest ellipsoid in the box, which no disturbance at all would allow. Every certificate is
    verified exactly, which counts.
    """
    plants: dict[str, list[LinearPlant]] = {}
    for mass in (1000.0, 4000.0):
        for gamma, Q, what in ((5e-4, 1e-4, ""), (2e-3, 4e-4, ", D radius doubled")):
            plant = with_noise(truck_trailer(mass=mass), gamma=gamma, Q=Q * np.eye(2))
            plants[f"truck-trailer, {mass:.0f} kg{what}"] = [plant]
    for n, m in ((2, 1), (4, 1), (4, 2), (6, 2), (8, 3), (12, 3)):
        if n <= largest:
            several = [_with_little_room(random_plant(100 * n + seed, n, m)) for seed in range(seeds)]
            plants[f"random, n = {n}, m = {m}, {seeds} seeds"] = several
    show = table("plant", "median [s]", "longest [s]", "least volume", "most", "infeasible", first=42)
    for name, several in plants.items():
        found = [timed(certified, plant) for plant in several]
        volumes = [each.provenance["volume_of_box_ellipsoid"] for each, _ in found if isinstance(each, Certificate)]
        seconds = [taken for _, taken in found]
        ends = [f"{end(volumes):.4f}" if volumes else "-" for end in (min, max)]
        show(name, f"{np.median(seconds):.2f}", f"{max(seconds):.2f}", *ends, len(several) - len(volumes))


def _with_little_room(plant: LinearPlant) -> LinearPlant:
    """Returns a plant with disturbances such that its error set has a largest half-width of ERROR_RADIUS."""
    model, limits = replace(plant.model, H=None), replace(plant.limits, input=1.0)
    plant = LinearPlant(model, limits, Bounds(disturbance=Ball(1e-3**0.5), sensor=0.0, first_error=0.0))
    radius = np.sqrt(np.diag(certified_error_set(plant).Sigma).max())
    return with_noise(plant, gamma=1e-3 * (ERROR_RADIUS / radius) ** 2)


def trust(plants: int = 20, most_states: int = 8) -> None:
    """How often badly scaled and nearly unstable plants get a certificate; none may fail its verification.

    A row is about so many --plants, whose states and inputs have units of their own. "coupling" is how far A is from
    normal.
    """
    columns = ("m", "units", "radius", "coupling", "certified", "s/plant", "others")
    show = table("n", *columns, first=3, width=12)
    for n, m in ((2, 1), (4, 2), (6, 3), (8, 2)):
        for decades, radius, coupling in ((0, 0.99, 0.3), (6, 0.99, 0.3), (6, 0.9999, 0.3), (6, 0.9999, 2.0)):
            if n > most_states:
                continue
            made = [badly_scaled_plant(seed, n, m, decades, radius, coupling) for seed in range(plants)]
            found, seconds = timed(lambda made=made: Counter(map(outcome, made)))
            count = f"{found.pop('certificate', 0)}/{plants}"
            units = f"1e-{decades}..1e{decades}" if decades else "1"
            others = ", ".join(f"{each} {name}" for name, each in sorted(found.items()))
            show(n, m, units, radius, coupling, count, f"{seconds / plants:.2f}", f"  {others}")


def outcome(plant: LinearPlant) -> str:
    """ "certificate", or which condition of `Infeasible` binds."""
    found = certified(plant)
    return "certificate" if isinstance(found, Certificate) else f"infeasible: {found.binding}"


def units(plants: int = 100) -> None:
    """Random plants with bad units and slow beside fast modes: is what is found for them also verified, in any units?

    Time constants are spread over four powers of ten, and every state and input has a unit of its own, spread over six.
    A plant is synthesized as it is and once more with all units 1: the outcome should be the same, and "lost", found
    but not verified in exact arithmetic, should be none. Disturbances and errors are a share of the limits.
    """

    def judged(plant: LinearPlant) -> str:
        try:
            synthesize(plant)
        except Infeasible as infeasible:
            return "lost" if "in exact arithmetic" in str(infeasible) else "refused"
        return "certified"

    counts: Counter[tuple[str, str]] = Counter()
    seconds: dict[str, list[float]] = {"certified": [], "refused": [], "lost": []}
    for seed in range(plants):
        own, taken = timed(judged, slow_and_fast_plant(seed, in_own_units=True))
        plain = judged(slow_and_fast_plant(seed, in_own_units=False))
        counts[own, plain] += 1
        seconds[own].append(taken)
        if own != plain or "lost" in (own, plain):
            print(f"plant {seed}: {own} in its own units, {plain} with units 1", flush=True)
    show = table("in its own units", "with units 1", "plants", first=18)
    for (own, plain), count in sorted(counts.items()):
        show(own, plain, count)
    for own, taken in seconds.items():
        if taken:
            print(f"{own} in own units: median {np.median(taken):.1f} s, longest {max(taken):.1f} s of processor time")


@dataclass(frozen=True)
class Varied:
    """What of a plant varies: the parameters of a function, with their values in the environment."""

    make: Callable[..., LinearPlant]
    values: dict[str, float]

    def family(self, plant: LinearPlant, share: float) -> LinearPlant:
        """Returns the family of all parameters within a share of their values."""
        ranges = {name: ((1.0 - share) * value, (1.0 + share) * value) for name, value in self.values.items()}
        return family(self.make, ranges, monotone=True)


@dataclass(frozen=True)
class Gain:
    """The gain of inputs varies, as deviations from the operating point, where all are at rest."""

    values: ClassVar[dict[str, float]] = {"input gain": 1.0}

    def family(self, plant: LinearPlant, share: float) -> LinearPlant:
        """Returns the hull of the plants with the smallest and the largest gain."""
        plain, factors = replace(plant.model, continuous=None), (1.0 - share, 1.0 + share)
        return family([replace(plant, model=replace(plain, B=factor * plain.B)) for factor in factors], at_rest=True)


_POLE, _MASS = {"pole_mass": 0.1, "length": 0.5}, {"mass": 4000.0}
VARIED: dict[str, list[Varied]] = {
    "TruckTrailer": [Varied(truck_trailer, {"mass": 1000.0})],
    "TruckTrailerCruise": [
        Varied(truck_trailer, _MASS),
        Varied(truck_trailer, _MASS | {"stiffness": 4500.0, "damping": 4600.0}),
    ],
    "TruckTrailerCruiseTwoWay": [Varied(truck_trailer, _MASS)],
    "CartPole": [Varied(cart_pole, each) for each in ({"pole_mass": 0.1}, _POLE, _POLE | {"cart_mass": 1.0})],
    "CartPoleTwoWay": [Varied(cart_pole, _POLE)],
} | {
    name + ending: [varied]
    for name, varied in {
        "Convoy": Varied(convoy, {"lag": 0.3}),
        "LaneKeeping": Varied(lane_keeping, {"speed": 20.0}),
    }.items()
    for ending in ("", "OnRequest")
}


def families(env: Sequence[str] = ()) -> None:
    """How far the plant of each registered environment, or of --env, may vary and its whole family have a certificate.

    For every environment, the largest common relative range +-r of some of its parameters for which an invariant
    ellipsoid is found under its contract, to a tenth of r or of a percent; a polytope alone may bear more. The input
    gain, by which B is multiplied, is a parameter of all plants; the hull of two of them is exact for it. The other
    parameters are those of the functions that make the plants (`ncs_gym.family`, which checks on a grid that
    entries are monotone in them). Takes about twenty minutes on one core.
    """
    largest = 0.5  # greater ranges are not tried
    show = table(f"{'id':36}what varies", "may vary by", first=64)
    for env_id in env or registered_ids():
        if ncs_env(gym.make(env_id)).plant.remainder is not None:
            show(env_id, "not at all: a remainder of its own")
            continue
        for varied in [*VARIED.get(env_id.removeprefix("ncs_gym/").removesuffix("-v0"), []), Gain()]:
            share = _largest_share(partial(_has_certificate, varied, env_id), largest)
            found = f"{100 * share:.1f} %" if share < largest else f"{100 * share:.0f} % or more"
            show(f"{env_id:36}{', '.join(varied.values)}", found)


def _has_certificate(varied: Varied | Gain, env_id: str, share: float) -> bool:
    """Returns whether the family has a certificate under the environment's contract."""
    env = ncs_env(gym.make(env_id))
    try:
        family = varied.family(env.plant, share)
    except ValueError:  # entries that are not monotone, or a plant that is none
        return False
    without_hints = mock.patch.object(certification, "_with_hints", lambda infeasible, *_, **__: infeasible)
    try:
        with without_hints:  # nobody reads them
            synthesize(family, contract=env.certificate_contract, safe_set="ellipsoid")
    except Infeasible:
        return False
    return True


def _largest_share(is_possible: Callable[[float], bool], largest: float) -> float:
    """Returns the largest share for which something is possible, found by bisection to a tenth or .001."""
    low, high = 0.0, largest
    if is_possible(high):
        return high
    while high - low > 0.001 and high > 1.1 * low:
        middle = (low * high) ** 0.5 if low else high / 4.0
        low, high = (middle, high) if is_possible(middle) else (low, middle)
    return low


COMMANDS = (times, trust, units, families)

if __name__ == "__main__":
    run(__doc__, COMMANDS)
