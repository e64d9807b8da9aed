"""The registered environments: the only place with numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np

from ncs_gym.network.channel import Channel
from ncs_gym.network.contract import contract_of
from ncs_gym.plants.batch_reactor import batch_reactor
from ncs_gym.plants.cart_pole import cart_pole
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.plants.truck_trailer import truck_trailer
from ncs_gym.processes import (
    CartPoleProcess,
    InvertedPendulumProcess,
    PendulumProcess,
    inverted_pendulum,
    nonlinear_cart_pole,
    pendulum,
)
from ncs_gym.scenario import EPISODE_STEPS, Scenario, VectorScenario
from ncs_gym.tasks.regulation import Regulation
from ncs_gym.tasks.setpoint_tracking import SetpointTracking
from ncs_gym.tasks.speed_tracking import SpeedTracking
from ncs_gym.uncertainty.bounded_disturbances import BoxDisturbance

# The four impairments of Liu et al. Section 5, all at once.
CASE_STUDY_CHANNEL = Channel(loss=0.3, quantization_step=0.05, send_period=2, delay=2)
# The disturbance box of Liu et al. Section 5 [m, m/s]; its corner has squared length gamma = 5e-4.
CASE_STUDY_BOX = BoxDisturbance((0.02, 0.01))

# Liu et al. Section 5: 1000 kg, dt 0.5 s, gamma 5e-4, Q = P0 = R = 1e-4 I (the paper prints no R), delta 0.05; starts
# uniformly in the disc of radius 1.9.
TRUCK_TRAILER = Scenario(
    plant=truck_trailer, channel=CASE_STUDY_CHANNEL, task=Regulation(), box=CASE_STUDY_BOX, start=1.9
)


def loaded_truck_trailer() -> LinearPlant:
    """Returns the truck with a trailer of 4000 kg: full throttle overstretches its coupling (theory.md section 5)."""
    return truck_trailer(mass=4000.0)


# The loaded trailer on the same coupling, noise and channel; the truck follows a random speed profile and starts within
# 0.2 of rest of the coupling.
TRUCK_TRAILER_CRUISE = Scenario(
    plant=loaded_truck_trailer, channel=CASE_STUDY_CHANNEL, task=SpeedTracking(), box=CASE_STUDY_BOX, start=0.2
)

# The same truck with its controller elsewhere: throttle commands go over a mobile network, too. They are one step late
# (0.5 s, what a busy one takes at worst) and as lossy as samples, but never more than two in a row are lost. Inputs are
# committed 3 steps ahead.
CRUISE_DOWNLINK = Channel(loss=0.3, delay=1, max_consecutive_losses=2)
TRUCK_TRAILER_CRUISE_TWO_WAY = replace(TRUCK_TRAILER_CRUISE, downlink=CRUISE_DOWNLINK)

# Any plant of the user's, behind a perfect channel unless given.
LINEAR_NCS = Scenario(plant=None, channel=Channel(), task=Regulation())

# One sample per step that is 1 to 2 steps late; 20 % are lost, never more than two in a row: no sample in use is older
# than 4 steps. Measurements are rounded to 1e-4 of their units.
CART_POLE_CHANNEL = Channel(loss=0.2, delay=1, jitter=1, max_consecutive_losses=2, quantization_step=1e-4)
CART_POLE = Scenario(
    plant=cart_pole,
    channel=CART_POLE_CHANNEL,
    task=SetpointTracking(output=np.array([1.0, 0.0, 0.0, 0.0]), reach=2.0, width=2.0, change_probability=0.02),
    contract=contract_of(CART_POLE_CHANNEL),
    terminates=True,
)

# Motor commands go back over the same radio as the samples: 1 to 2 steps late (20 to 40 ms, a wireless network shared
# with others), 20 % lost, never more than two in a row. Inputs are committed 4 steps ahead.
CART_POLE_DOWNLINK = replace(CART_POLE_CHANNEL, quantization_step=0.0)
CART_POLE_TWO_WAY = replace(CART_POLE, downlink=CART_POLE_DOWNLINK)

# A sample per step, one step late; 20 % are lost, never more than two in a row: none in use is older than 3 steps.
BATCH_REACTOR_CHANNEL = Channel(loss=0.2, delay=1, max_consecutive_losses=2, quantization_step=1e-3)
BATCH_REACTOR = Scenario(
    plant=batch_reactor,
    channel=BATCH_REACTOR_CHANNEL,
    task=SetpointTracking(output=np.array([0.0, 1.0, 0.0, 0.0]), reach=1.0, width=1.0, change_probability=0.05),
    contract=contract_of(BATCH_REACTOR_CHANNEL),
    terminates=True,
)

# Gymnasium's `Pendulum-v1` inside. A sample per step; 30 % are lost, never more than two in a row.
PENDULUM_CHANNEL = Channel(loss=0.3, max_consecutive_losses=2)
PENDULUM = Scenario(
    plant=pendulum,
    channel=PENDULUM_CHANNEL,
    task=SetpointTracking(output=np.array([1.0, 0.0]), reach=0.15, width=0.15, change_probability=0.02),
    contract=contract_of(PENDULUM_CHANNEL),
    terminates=True,
    process=PendulumProcess(),
)

# Gymnasium's MuJoCo environment `InvertedPendulum-v5` inside, behind the same channel.
INVERTED_PENDULUM = Scenario(
    plant=inverted_pendulum,
    channel=PENDULUM_CHANNEL,
    task=SetpointTracking(output=np.array([1.0, 0.0, 0.0, 0.0]), reach=0.6, width=0.6, change_probability=0.02),
    contract=contract_of(PENDULUM_CHANNEL),
    terminates=True,
    process=InvertedPendulumProcess(),
    extra="mujoco",
)

# The nonlinear equations of the cart-pole behind the channel of CART_POLE, with its task, box and limits.
CART_POLE_NONLINEAR = Scenario(
    plant=nonlinear_cart_pole,
    channel=CART_POLE_CHANNEL,
    task=CART_POLE.task,
    contract=contract_of(CART_POLE_CHANNEL),
    terminates=True,
    process=CartPoleProcess(),
)

ENTRY_POINTS = {
    "ncs_gym/TruckTrailer-v0": "TRUCK_TRAILER",
    "ncs_gym/TruckTrailerCruise-v0": "TRUCK_TRAILER_CRUISE",
    "ncs_gym/TruckTrailerCruiseTwoWay-v0": "TRUCK_TRAILER_CRUISE_TWO_WAY",
    "ncs_gym/LinearNCS-v0": "LINEAR_NCS",
    "ncs_gym/CartPole-v0": "CART_POLE",
    "ncs_gym/CartPoleTwoWay-v0": "CART_POLE_TWO_WAY",
    "ncs_gym/BatchReactor-v0": "BATCH_REACTOR",
    "ncs_gym/Pendulum-v0": "PENDULUM",
    "ncs_gym/InvertedPendulum-v0": "INVERTED_PENDULUM",
    "ncs_gym/CartPoleNonlinear-v0": "CART_POLE_NONLINEAR",
}


TRUCK_TRAILER_VECTOR = VectorScenario(TRUCK_TRAILER)
TRUCK_TRAILER_CRUISE_VECTOR = VectorScenario(TRUCK_TRAILER_CRUISE)
TRUCK_TRAILER_CRUISE_TWO_WAY_VECTOR = VectorScenario(TRUCK_TRAILER_CRUISE_TWO_WAY)
LINEAR_NCS_VECTOR = VectorScenario(LINEAR_NCS)
CART_POLE_VECTOR = VectorScenario(CART_POLE)
CART_POLE_TWO_WAY_VECTOR = VectorScenario(CART_POLE_TWO_WAY)
BATCH_REACTOR_VECTOR = VectorScenario(BATCH_REACTOR)
PENDULUM_VECTOR = VectorScenario(PENDULUM)
INVERTED_PENDULUM_VECTOR = VectorScenario(INVERTED_PENDULUM)
CART_POLE_NONLINEAR_VECTOR = VectorScenario(CART_POLE_NONLINEAR)


def register_all() -> None:
    """Registers the ids with gymnasium; `import ncs_gym` calls it."""
    for env_id, name in ENTRY_POINTS.items():
        if env_id not in gym.registry:
            gym.register(id=env_id, max_episode_steps=EPISODE_STEPS, **entry_points_of(name))


def registered_ids() -> list[str]:
    """Returns the ids of the environments that have a plant of their own: this module's, and those of users' plants.

    An environment whose extra is not installed is not among them.
    """
    scenarios = {env_id: globals()[name] for env_id, name in ENTRY_POINTS.items()}
    own = [env_id for env_id, each in scenarios.items() if each.plant is not None and each.is_installed]
    entry_point = entry_points_of("LINEAR_NCS")["entry_point"]
    return own + [spec.id for spec in gym.registry.values() if spec.entry_point == entry_point and spec.kwargs]


def needing_extras() -> list[str]:
    """Returns the ids of this module's environments whose extra is not installed: `gym.make` says which one."""
    return [env_id for env_id, name in ENTRY_POINTS.items() if not globals()[name].is_installed]


def entry_points_of(name: str) -> dict[str, Any]:
    """Returns where gymnasium finds a scenario of this module and its vector environment."""
    return {"entry_point": f"{__name__}:{name}", "vector_entry_point": f"{__name__}:{name}_VECTOR"}
