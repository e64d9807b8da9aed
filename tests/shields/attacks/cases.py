"""What is attacked: plants of every kind, behind networks that use all that their contracts allow."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Any

import gymnasium as gym
import numpy as np

from ncs_gym import (
    Channel,
    ChannelContract,
    Ellipsoid,
    GilbertElliott,
    LinearPlant,
    cart_pole,
    truck_trailer,
)
from ncs_gym.network.channel import contract_of
from ncs_gym.plants.library import batch_reactor
from ncs_gym.processes.process import FamilyProcess, Process
from shields import Certificate
from tests.certificates import certificate_of
from tests.plants import random_plant, servo, varying_cart_pole, varying_truck
from tests.product import altered, library_plant

CHANNELS = {
    "perfect": Channel(),
    "blackout": Channel(loss=1.0),
    "bursts": Channel(loss=GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.1), quantization_step=0.05),
    "overtaking": Channel(loss=0.2, quantization_step=0.05, send_period=2, delay=1, jitter=3),
}
TRUCKS = {
    "1000 kg": truck_trailer(),
    "4000 kg": truck_trailer(mass=4000.0),
    "4000 kg, position only": library_plant(truck_trailer, mass=4000.0, H=np.array([[1.0, 0.0]])),
}
# n = 2..8, m = 1..3, p < n; inputs so weak that the shield lets some through and overrides others.
RANDOM = {
    f"n={n} m={m} p={p}": altered(random_plant(seed, n, m, p), u_max=u_max)
    for seed, (n, m, p, u_max) in enumerate(
        (
            (2, 1, 1, 0.2),
            (3, 2, 1, 0.5),
            (4, 3, 2, 0.1),
            (5, 1, 3, 0.2),
            (6, 2, 3, 0.2),
            (7, 3, 5, 0.08),
            (8, 3, 4, 0.16),
        )
    )
}


def edges(age: int, quantization_step: float = 0.0) -> dict[str, Channel]:
    """Channels that keep ChannelContract(age) and use all of it: late, lost in the longest runs, overtaking."""
    same = {"quantization_step": quantization_step}
    return {
        "constant delay": Channel(delay=age, **same),
        "longest gap each time": Channel(loss=1.0, max_consecutive_losses=age, **same),
        "overtaking": Channel(loss=0.4, max_consecutive_losses=1, jitter=age - 1, **same),
    }


@dataclass(frozen=True, kw_only=True)
class Case:
    """A plant, the networks that it is attacked behind, and what is proved of it.

    Attributes:
        plant: The plant.
        networks: Uplinks with, perhaps, downlinks.
        contract: Of the uplink; None for none.
        safe_set: "ellipsoid" or "polytope".
        horizon: Longest plan of mode "lookahead".
        process: What really moves; None for the plant's equations.
        start: Share of the safe set that episodes start on the boundary of.
        at_all_times: Whether the box counts between samples; None if the plant says so.
        claimed: A certificate in the place of the right one, for what is to be caught.
    """

    plant: LinearPlant
    networks: tuple[tuple[Channel, Channel | None], ...]
    contract: ChannelContract | None = None
    safe_set: str = "ellipsoid"
    horizon: int = 4
    process: Process | None = None
    start: float = 1.0
    at_all_times: bool | None = None
    claimed: Certificate | None = None

    @property
    def uplink(self) -> Channel:
        """Of the first network."""
        return self.networks[0][0]

    @property
    def downlink(self) -> Channel | None:
        """Of the first network; those of the others delay inputs as long."""
        return self.networks[0][1]

    @cached_property
    def certificate(self) -> Certificate:
        """Counts the steps of both channels."""
        if self.claimed is not None:
            return self.claimed
        contract = self.contract
        if contract is not None and self.downlink is not None:
            contract = replace(contract, max_age=contract.max_age + contract_of(self.downlink).max_age)
        return certificate_of(self.plant, contract, self.safe_set)


def stable(plant: LinearPlant, *channels: str, **settings: Any) -> Case:
    return Case(plant=plant, networks=tuple((CHANNELS[name], None) for name in channels or CHANNELS), **settings)


def unstable(plant: LinearPlant, age: int = 3, step: float = 0.0, **settings: Any) -> Case:
    contract = ChannelContract(age, step)
    return Case(plant=plant, networks=tuple((each, None) for each in edges(age, step).values()), contract=contract,
                **settings)  # fmt: skip


def behind(plant: LinearPlant, *networks: tuple[Channel, Channel], **settings: Any) -> Case:
    """Behind both directions; episodes start well inside, since their first inputs are zero."""
    contract = None if plant.spectral_radius < 1.0 else contract_of(networks[0][0])
    return Case(plant=plant, networks=networks, contract=contract, start=0.3, **settings)


def two_ways(plant: LinearPlant, age: int = 2, **settings: Any) -> Case:
    """Both directions at their edges, each in another way."""
    ways = [*edges(age).values()]
    return behind(plant, *zip(ways, [*ways[1:], ways[0]], strict=True), **settings)


def registered(name: str, **settings: Any) -> Case:
    """A registered environment whose process is not the plant's own equations."""
    env = gym.make(f"ncs_gym/{name}-v0").unwrapped
    age, step = env.contract.max_age, env.contract.quantization_step
    return unstable(env.plant, age, step, process=env.process, safe_set="polytope", **settings)


CASES = {
    "truck": lambda: stable(TRUCKS["1000 kg"], horizon=3),
    "cruise": lambda: stable(TRUCKS["4000 kg"], horizon=3),
    "cruise, position only": lambda: stable(TRUCKS["4000 kg, position only"], horizon=3),
    "cruise, a contract": lambda: replace(unstable(TRUCKS["4000 kg"], 4), horizon=3),
    **{name: partial(stable, plant) for name, plant in RANDOM.items()},
    "cart-pole": lambda: unstable(cart_pole(), 4, horizon=12),
    "cart-pole, position and angle": lambda: unstable(cart_pole(full_state=False), horizon=8),
    "batch reactor": lambda: unstable(batch_reactor(), horizon=6),
    "cart-pole, polytope": lambda: unstable(cart_pole(), safe_set="polytope", horizon=12),
    "batch reactor, polytope": lambda: unstable(batch_reactor(), safe_set="polytope", horizon=6),
    "servo, polytope alone": lambda: unstable(servo(), safe_set="polytope", horizon=5),
    "cruise, both ways": lambda: two_ways(TRUCKS["4000 kg"], horizon=3),
    "cart-pole, both ways": lambda: two_ways(cart_pole(), horizon=12),
    "batch reactor, both ways": lambda: two_ways(batch_reactor(), horizon=6),
    "cruise, at all times": lambda: stable(altered(TRUCKS["4000 kg"], between_samples=8), horizon=3),
    "reactor, at all times": lambda: unstable(altered(batch_reactor(), between_samples=4), safe_set="polytope"),
    "cruise, both ways and at all times": lambda: two_ways(altered(TRUCKS["4000 kg"], between_samples=8), horizon=3),
    "cart-pole with remainder": lambda: registered("CartPoleNonlinear", horizon=6),
    "pendulum with remainder": lambda: registered("Pendulum"),
    "cruise of 5 %, with remainder": lambda: stable(varying_truck(), horizon=3, process=FamilyProcess()),
    "cart-pole of 2 %, with remainder": lambda: unstable(
        varying_cart_pole(), 3, safe_set="polytope", horizon=6, process=FamilyProcess()
    ),
    "cruise, polytope": lambda: stable(TRUCKS["4000 kg"], safe_set="polytope", horizon=3),
    "cart-pole, polytope, both ways": lambda: two_ways(cart_pole(), safe_set="polytope", horizon=12),
}


@cache
def case(name: str) -> Case:
    """A case by its name; made when it is first asked for."""
    return CASES[name]()


def plan_case(name: str, channel: str) -> tuple[LinearPlant, int, Channel, ChannelContract | None]:
    """Plant, horizon, a channel by its name, and contract of a case without downlink."""
    plant, contract = case(name).plant, case(name).contract
    return plant, case(name).horizon, (edges(contract.max_age) if contract else CHANNELS)[channel], contract


def box_ellipsoid(plant: LinearPlant, share: float) -> Ellipsoid:
    """An ellipsoid in the box that reaches a fraction of each half-width; far larger than S where S is small."""
    return Ellipsoid(share**2 * np.diag(plant.half_widths**2))
