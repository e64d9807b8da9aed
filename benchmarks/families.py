"""How far the plant of each registered environment may vary and still have a certificate for its whole family.

For every environment, the largest common relative range +-r of some of its parameters for which an invariant ellipsoid
is found under its contract, to a tenth of r or of a percent; a polytope alone may bear more. The input gain, by which B
is multiplied, is a parameter of all plants; the hull of two of them is exact for it. The other parameters are those of
the functions that make the plants (`LinearPlant.family`, which checks on a grid that entries are monotone in them).

    python benchmarks/families.py [--env ncs_gym/CartPole-v0]

Takes about twenty minutes on one core.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar
from unittest import mock

import gymnasium as gym

from ncs_gym import LinearPlant, cart_pole, convoy, lane_keeping, truck_trailer
from ncs_gym.envs.env import ncs_env
from ncs_gym.registration import registered_ids
from shields import Infeasible, synthesize
from shields.synthesis import certification

# Ranges above this are not tried; the search is as precise as one of the others.
LARGEST, STEP, PRECISION = 0.5, 0.001, 1.1


@dataclass(frozen=True)
class Varied:
    """What of a plant varies: the parameters of a function, with their values in the environment."""

    make: Callable[..., LinearPlant]
    values: dict[str, float]

    def family(self, plant: LinearPlant, share: float) -> LinearPlant:
        """Returns the family of all parameters within a share of their values."""
        ranges = {name: ((1.0 - share) * value, (1.0 + share) * value) for name, value in self.values.items()}
        return LinearPlant.family(self.make, ranges, monotone=True)


@dataclass(frozen=True)
class Gain:
    """The input gain varies."""

    values: ClassVar[dict[str, float]] = {"input gain": 1.0}

    def family(self, plant: LinearPlant, share: float) -> LinearPlant:
        """Returns the hull of the plants with the smallest and the largest gain."""
        plain = replace(plant, continuous_model=None)
        return LinearPlant.family([replace(plain, B=factor * plant.B) for factor in (1.0 - share, 1.0 + share)])


POLE = {"pole_mass": 0.1, "length": 0.5}
VARIED: dict[str, list[Varied]] = {
    "TruckTrailer": [Varied(truck_trailer, {"mass": 1000.0})],
    "TruckTrailerCruise": [
        Varied(truck_trailer, {"mass": 4000.0}),
        Varied(truck_trailer, {"mass": 4000.0, "stiffness": 4500.0, "damping": 4600.0}),
    ],
    "CartPole": [Varied(cart_pole, {"pole_mass": 0.1}), Varied(cart_pole, POLE | {"cart_mass": 1.0})],
    "Convoy": [Varied(convoy, {"lag": 0.3})],
    "LaneKeeping": [Varied(lane_keeping, {"speed": 20.0})],
}
VARIED["TruckTrailerCruiseTwoWay"] = VARIED["TruckTrailerCruise"][:1]
VARIED["CartPole"].insert(1, Varied(cart_pole, POLE))
VARIED["CartPoleTwoWay"] = [Varied(cart_pole, POLE)]
VARIED["ConvoyOnRequest"], VARIED["LaneKeepingOnRequest"] = VARIED["Convoy"], VARIED["LaneKeeping"]


def has_certificate(varied: Varied | Gain, env_id: str, share: float) -> bool:
    """Returns whether the family has a certificate under the environment's contract."""
    env = ncs_env(gym.make(env_id))
    try:
        family = varied.family(env.plant, share)
    except ValueError:  # entries that are not monotone, or a plant that is none
        return False
    try:
        with mock.patch.object(
            certification, "_with_hints", lambda infeasible, *_, **__: infeasible
        ):  # nobody reads them
            return synthesize(family, contract=env.certificate_contract, safe_set="ellipsoid") is not None
    except Infeasible:
        return False


def largest_share(is_possible: Callable[[float], bool]) -> float:
    """Returns the largest share for which something is possible, found by bisection."""
    low, high = 0.0, LARGEST
    if is_possible(high):
        return high
    while high - low > STEP and high > PRECISION * low:
        middle = (low * high) ** 0.5 if low else high / 4.0
        low, high = (middle, high) if is_possible(middle) else (low, middle)
    return low


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", nargs="+", help="ids; all registered ones by default")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    print(f"{'id':36}{'what varies':28}may vary by")
    for env_id in options.env or registered_ids():
        env = ncs_env(gym.make(env_id))
        if env.plant.remainder is not None:
            print(f"{env_id:36}{'':28}not at all: a remainder of its own", flush=True)
            continue
        for varied in [*VARIED.get(env_id.removeprefix("ncs_gym/").removesuffix("-v0"), []), Gain()]:
            share = largest_share(partial(has_certificate, varied, env_id))
            names = ", ".join(varied.values)
            found = f"{100 * share:.1f} %" if share < LARGEST else f"{100 * share:.0f} % or more"
            print(f"{env_id:36}{names:28}{found}", flush=True)


if __name__ == "__main__":
    main()
