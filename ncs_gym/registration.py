"""The registered environments: the only place with numbers."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from ncs_gym.envs.env import NCSEnv
from ncs_gym.envs.vector_env import NCSVectorEnv
from ncs_gym.json_settings import DISTURBANCES, PROCESSES, TASKS, as_plant, from_json
from ncs_gym.network.channel import Channel
from ncs_gym.network.contract import ChannelContract, contract_of
from ncs_gym.plants.batch_reactor import batch_reactor
from ncs_gym.plants.cart_pole import cart_pole
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.plants.truck_trailer import truck_trailer
from ncs_gym.processes import (
    CartPoleProcess,
    InvertedPendulumProcess,
    PendulumProcess,
    Process,
    inverted_pendulum,
    nonlinear_cart_pole,
    pendulum,
)
from ncs_gym.tasks.regulation import Regulation
from ncs_gym.tasks.setpoint_tracking import SetpointTracking
from ncs_gym.tasks.speed_tracking import SpeedTracking
from ncs_gym.tasks.task import Task
from ncs_gym.uncertainty.bounded_disturbances import BoxDisturbance
from ncs_gym.uncertainty.ellipsoid import Ellipsoid

# Steps per episode of every registered environment (Liu et al. Section 5).
EPISODE_STEPS = 200
# The four impairments of Liu et al. Section 5, all at once.
CASE_STUDY_CHANNEL = Channel(loss=0.3, quantization_step=0.05, send_period=2, delay=2)
# The disturbance box of Liu et al. Section 5 [m, m/s]; its corner has squared length gamma = 5e-4.
CASE_STUDY_BOX = BoxDisturbance((0.02, 0.01))

# What dictionaries of fields stand for in the settings that may be given as JSON values.
_KINDS: dict[str, tuple[type, ...]] = {
    "channel": (Channel,),
    "task": TASKS,
    "disturbance": DISTURBANCES,
    "initial_set": (Ellipsoid,),
    "contract": (ChannelContract,),
    "process": PROCESSES,
    "downlink": (Channel,),
    "downlink_contract": (ChannelContract,),
}


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """Defaults of a registered environment; calling it makes the environment.

    Attributes:
        plant: Makes the default plant; None if the user has to give one.
        channel: Default channel.
        task: Default task.
        box: Default disturbance where it suits the plant; "ball" elsewhere.
        contract: What the default channel promises; for the scenario's own plant only.
        terminates: Whether a violation ends the episode by default: an unstable plant does not come back.
        start: Radius of the disc of starts, for plants of two states; None and elsewhere: `NCSEnv`'s default.
        process: What really moves, whose fields a dictionary may hold; None for the plant's own equations.
        extra: Extra that installs the module of this name, which the process needs; empty for none.
        downlink: Default downlink; None for an ideal one.
    """

    plant: Callable[[], LinearPlant] | None
    channel: Channel
    task: Task
    box: BoxDisturbance | None = None
    contract: ChannelContract | None = None
    terminates: bool = False
    start: float | None = None
    process: Process | None = None
    extra: str = ""
    downlink: Channel | None = None
    metadata: ClassVar[dict[str, Any]] = NCSEnv.metadata

    def __call__(self, **settings: Any) -> NCSEnv:
        """Returns the environment; see `settings` for the keywords.

        Raises:
            ValueError: If the scenario has no plant of its own and none is given, or a setting is wrong.
        """
        return NCSEnv(**self.settings(**settings))

    def settings(self, *, plant: LinearPlant | str | os.PathLike[str] | None = None, **given: Any) -> dict[str, Any]:
        """Returns the arguments of `NCSEnv`.

        Settings may be JSON values, so that an `EnvSpec` may: dictionaries of fields (`Channel(**channel)`), a
        disturbance by its name, a plant by the path of a file that `LinearPlant.save` wrote.

        Args:
            plant: The plant; None for the scenario's own.
            given: Other arguments of `NCSEnv`; None stands for the scenario's own value where it has one.

        Raises:
            ValueError: If the scenario has no plant of its own and none is given, or a JSON value is wrong.
        """
        plant = as_plant(plant)
        own: dict[str, Any] = {"channel": self.channel, "task": self.task, "terminate_on_violation": self.terminates}
        kinds = _KINDS if self.process is None else _KINDS | {"process": (type(self.process),)}
        own |= {"downlink": self.downlink} | ({} if self.process is None else {"process": self.process})
        if plant is None:
            if self.plant is None:
                raise ValueError(
                    "this environment has no plant of its own: give plant=LinearPlant(...), or register_plant it"
                )
            plant, own["contract"] = self.plant(), self.contract
        own |= {"plant": plant, "disturbance": self._disturbance(plant), "horizon": EPISODE_STEPS}
        if self.start is not None and getattr(plant, "n", 0) == 2:
            own["initial_set"] = Ellipsoid(self.start**2 * np.eye(2))
        for name, value in given.items():
            if name in kinds or name == "terminate_on_violation":
                if value is not None:
                    own[name] = from_json(value, kinds[name], name) if name in kinds else value
            else:
                own[name] = value
        return own

    @property
    def is_installed(self) -> bool:
        """Whether what the process needs is installed."""
        return not self.extra or find_spec(self.extra) is not None

    def _disturbance(self, plant: Any) -> Any:
        if self.box is None or not isinstance(plant, LinearPlant) or self.box.check(plant) or self.box.excess(plant):
            return "ball"
        return self.box


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


class VectorScenario:
    """Makes vector environments of a scenario.

    Args:
        scenario: Gives the settings.
    """

    metadata: ClassVar[dict[str, Any]] = NCSEnv.metadata | {"render_modes": []}

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario

    def __call__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: Any = "NextStep",
        **settings: Any,
    ) -> NCSVectorEnv:
        """Returns the vector environment; see `NCSVectorEnv`, and `Scenario.settings` for the rest."""
        return NCSVectorEnv(
            num_envs,
            max_episode_steps=max_episode_steps,
            autoreset_mode=autoreset_mode,
            **self.scenario.settings(**settings),
        )


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
