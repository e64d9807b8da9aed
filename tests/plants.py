"""Plants of tests: random ones, and some with a name that share their certificates."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import gymnasium as gym
import numpy as np

from benchmarks.random_plants import random_plant as random_plant
from ncs_gym import ChannelContract, Ellipsoid, LinearPlant, cart_pole, truck_trailer
from ncs_gym.plants.family import Remainder
from tests.product import altered, family_of, linear_plant, sampled_plant


def small(A: object, **changes: object) -> LinearPlant:
    """Two states and one input, in the unit box; without changes everything is Gaussian but a ball of disturbances."""
    sizes = {"B": [[0.1], [0.2]], "box": np.eye(2), "u_max": 2.0, "dt": 0.1, "gamma": 1e-5}
    noises = dict.fromkeys(("process_noise_cov", "measurement_noise_cov", "initial_cov"), 1e-6 * np.eye(2))
    return linear_plant(**{"A": A} | sizes | noises | changes)


def with_remainder() -> LinearPlant:
    """The linear model of another process."""
    left_out = Remainder(Ellipsoid(1e-4 * np.eye(2)), False, "an example")
    bounds = {"disturbance_bound": 0.0, "sensor_bound": 0.001, "initial_bound": 0.001}
    return linear_plant(
        A=[[0.9, 0.1], [0.0, 0.8]], B=[[0.0], [0.3]], box=[1.0, 1.0], u_max=1.0, dt=0.1, remainder=left_out, **bounds
    )


def oscillator(between_samples: int | None = 3) -> LinearPlant:
    """A mass on a spring, with few samples per period; its box counts between them, too."""
    model = [[0.0, 1.0], [-1.0, -0.4]], [[0.0], [1.0]], np.eye(2), np.zeros((2, 1))
    bounds = {"disturbance_bound": 0.01, "sensor_bound": 1e-3, "initial_bound": 1e-3}
    return sampled_plant(model, dt=0.5, box=[1.0, 1.0], u_max=1.0, between_samples=between_samples, **bounds)


def swinging(damping: float, u_max: float) -> LinearPlant:
    """Swings once around within a step, whose input pushes it far out and back between two samples."""
    w = 2.0 * np.pi
    model = [[0.0, 1.0], [-w * w, -2.0 * damping * w]], [[0.0], [w * w]], np.eye(2), np.zeros((2, 1))
    bounds = {"gamma": 1e-6, "initial_bound": 1e-3, "sensor_bound": 1e-4}
    return sampled_plant(model, dt=1.0, box=(1.0, 8.0), u_max=u_max, between_samples=32, **bounds)


def servo(factor: float = 1.2, **changes: object) -> LinearPlant:
    """A DC servo; of these radii an ellipsoid bears up to about 1.04 times those of factor 1, a polytope more."""
    motor = ([[0.0, 1.0], [0.0, -20.0]], [[0.0], [40.0]], [[1.0, 0.0]], [[0.0]])
    bounds = {"disturbance_bound": [0.0, 0.25], "sensor_bound": 5e-4, "initial_bound": [1e-3, 0.05]}
    scaled = {name: factor * np.array(bound) for name, bound in bounds.items()}
    return sampled_plant(motor, **{"dt": 0.005, "box": [0.2, 4.0], "u_max": 12.0} | scaled | changes)


def delayed(steps: int) -> LinearPlant:
    """A damped oscillator whose inputs arrive some steps late."""
    model = [[0.0, 1.0], [-0.2, -0.5]], [[0.0], [1.0]], [[1.0, 0.0]], None
    bounds = {"disturbance_bound": [0.0005, 0.003], "sensor_bound": 0.01, "initial_bound": 0.02}
    return sampled_plant(model, dt=0.1, box=[1.0, 1.5], u_max=0.8, input_delay=steps, **bounds)


def counted_between(name: str, points: int) -> tuple[LinearPlant, ChannelContract | None]:
    """The plant of a registered environment, whose box counts between samples, too, and its contract."""
    env = gym.make(f"ncs_gym/{name}-v0").unwrapped
    return altered(env.plant, between_samples=points), env.certificate_contract


@cache
def varying_truck() -> LinearPlant:
    """The loaded truck, 4000 kg +- 5 %."""
    return family_of(truck_trailer, {"mass": (3800.0, 4200.0)}, monotone=True)


@cache
def varying_cart_pole() -> LinearPlant:
    """The cart-pole, mass and length of the pole +- 2 %."""
    return family_of(cart_pole, {"pole_mass": (0.098, 0.102), "length": (0.49, 0.51)}, monotone=True)


# Plants with contracts, whose certificates with polytopes are checked in: data/certificates.
NAMED: dict[str, Callable[[], tuple[LinearPlant, ChannelContract | None]]] = {
    "stable": lambda: (small([[0.9, 0.1], [0.0, 0.8]]), None),
    "unstable": lambda: (small([[1.02, 0.1], [0.0, 0.8]]), ChannelContract(1, 0.001)),
    "remainder": lambda: (with_remainder(), None),
    "oscillator": lambda: (oscillator(), ChannelContract(1)),
    "delayed": lambda: (delayed(1), None),
    "servo": lambda: (servo(), ChannelContract(3)),
    "servo, bearable": lambda: (servo(0.8), ChannelContract(3)),
    "servo, at all times": lambda: (servo(1.1, between_samples=4), ChannelContract(3)),
    "cruise, at all times": lambda: counted_between("TruckTrailerCruise", 8),
    "reactor, at all times": lambda: counted_between("BatchReactor", 4),
}


@cache
def named(name: str) -> tuple[LinearPlant, ChannelContract | None]:
    """A plant of `NAMED`, and the contract of its certificate."""
    return NAMED[name]()


# Where a plant has what the adapter of tests calls so.
SOURCES = {"disturbance_bound": "of_disturbance", "sensor_bound": "of_sensor", "initial_bound": "of_first_error"}


def with_radii(plant: LinearPlant, factor: float) -> LinearPlant:
    """The plant with the radii of its declared disturbances, sensor noise and first errors multiplied."""
    own = plant.n - plant.past
    sizes = {"disturbance_bound": own, "sensor_bound": plant.p, "initial_bound": own}
    given = {name: bound.shape_matrix for name in sizes if (bound := getattr(plant, SOURCES[name]).bound) is not None}
    scaled = {name: Ellipsoid(factor**2 * D[: sizes[name], : sizes[name]]) for name, D in given.items()}
    return altered(plant, gamma=factor**2 * plant.gamma, **scaled)
