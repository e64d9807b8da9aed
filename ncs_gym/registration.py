"""The registered environments: one table of them, the only place with numbers, and the factory that makes them."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np

from ncs_gym.disturbances import BallDisturbance, BoxDisturbance, Disturbance, SinusoidDisturbance
from ncs_gym.ellipsoid import Ellipsoid
from ncs_gym.envs.env import NCSEnv
from ncs_gym.envs.json_settings import JSON_SETTINGS, from_json, read_plant, to_json
from ncs_gym.envs.vector_env import NCSVectorEnv
from ncs_gym.network.channel import Channel, ChannelContract, contract_of
from ncs_gym.plants.library import batch_reactor, cart_pole, convoy, lane_keeping, stirred_tank, truck_trailer
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes.cart_pole_process import CartPoleProcess, nonlinear_cart_pole
from ncs_gym.processes.gym_pendulum import PendulumProcess, pendulum
from ncs_gym.processes.mujoco_pendulum import InvertedPendulumProcess, inverted_pendulum
from ncs_gym.processes.process import Process
from ncs_gym.tasks import Regulation, SetpointTracking, SpeedTracking, Task
from ncs_gym.validation import as_count

# Steps per episode of every registered environment (Liu et al. Section 5).
EPISODE_STEPS = 200


@dataclass(frozen=True, kw_only=True)
class Factory:
    """Makes a registered environment from its defaults, alone or many at once.

    Attributes:
        plant: Makes the default plant; None if the user has to give one.
        channel: Default channel.
        task: Default task.
        disturbance: Default disturbance where it suits the plant; "ball" elsewhere.
        terminates: Whether a violation ends the episode by default: an unstable plant does not come back.
        start: Radius of the disc of starts, for plants of two states; None and elsewhere: `NCSEnv`'s default.
        process: What really moves, whose fields a dictionary may hold; None for the plant's own equations.
        extra: Extra that installs the module of this name, which the process needs; empty for none.
        downlink: Default downlink; None for an ideal one.
        contract: Contract of the default plant; None for that of the default channel.
        is_vector: Whether it makes vector environments.
    """

    plant: Callable[[], LinearPlant] | None
    channel: Channel
    task: Task
    disturbance: Disturbance = field(default_factory=BallDisturbance)
    terminates: bool = False
    start: float | None = None
    process: Process | None = None
    extra: str = ""
    downlink: Channel | None = None
    contract: ChannelContract | None = None
    is_vector: bool = False

    def __call__(self, **settings: Any) -> NCSEnv | NCSVectorEnv:
        """Returns the environment; see `settings` for the keywords, `NCSVectorEnv` for more of them.

        Raises:
            ValueError: If there is no default plant and none is given, or a setting is wrong.
        """
        if not self.is_vector:
            return NCSEnv(**self.settings(**settings))
        if settings.get("max_episode_steps", -1) is None:  # the id's own for gym.make, but gym.make_vec hides that one
            raise ValueError("max_episode_steps must be a number: leave it out for that of the id, -1 is for no end")
        return NCSVectorEnv(**self.settings(**settings))

    def settings(
        self,
        *,
        plant: LinearPlant | Mapping[str, Any] | str | os.PathLike[str] | None = None,
        between_samples: int | None = None,
        **given: Any,
    ) -> dict[str, Any]:
        """Returns the arguments of `NCSEnv`.

        Settings may be JSON values, as those of an `EnvSpec` are: dictionaries of fields (`Channel(**channel)`), a
        disturbance by its name, a plant by its `document` or the path of its file.

        Args:
            plant: The plant; None for the default one.
            between_samples: Times per step at which the box counts (`LinearPlant`); None for the plant's own.
            given: Other arguments of `NCSEnv`; None stands for the default where there is one.

        Raises:
            ValueError: If there is no default plant and none is given, or a JSON value is wrong.
        """
        read: Any = read_plant(plant)
        own: dict[str, Any] = {
            "channel": self.channel,
            "task": self.task,
            "terminate_on_violation": self.terminates,
            "downlink": self.downlink,
            "process": self.process,
            "horizon": EPISODE_STEPS,
        }
        kinds = JSON_SETTINGS if self.process is None else JSON_SETTINGS | {"process": (type(self.process),)}
        if read is None:
            if self.plant is None:
                found = f"got {', '.join(given)}" if given else "got no settings"
                raise ValueError(f"this environment has no plant of its own: give plant=LinearPlant(...), {found}")
            read, own["contract"] = _made(self.plant), self.contract or contract_of(self.channel)
        if between_samples is not None:
            read = replace(read, limits=replace(read.limits, between_samples=between_samples))
        fits = isinstance(read, LinearPlant) and not self.disturbance.check(read)
        own |= {"plant": read, "disturbance": self.disturbance if fits else "ball"}
        if self.start is not None and getattr(read, "n", 0) == 2:
            own["initial_set"] = Ellipsoid(self.start**2 * np.eye(2))
        for name, value in given.items():
            if value is not None or name not in (*kinds, "terminate_on_violation"):
                own[name] = from_json(value, kinds[name], name) if name in kinds else value
        return own

    @property
    def metadata(self) -> dict[str, Any]:
        """What gymnasium asks of an entry point before it is called."""
        return NCSEnv.metadata

    @property
    def is_installed(self) -> bool:
        """Whether what the process needs is installed."""
        return not self.extra or find_spec(self.extra) is not None


@cache
def _made(plant: Callable[[], LinearPlant]) -> LinearPlant:
    """Returns a default plant, which environments share: nothing can change it, and what follows from it is kept."""
    return plant()


# The four impairments of Liu et al. Section 5, all at once.
CASE_STUDY_CHANNEL = Channel(loss=0.3, quantization_step=0.05, send_period=2, delay=2)
# The disturbance box of Liu et al. Section 5 [m, m/s]; its corner has squared length gamma = 5e-4.
CASE_STUDY_BOX = BoxDisturbance((0.02, 0.01))

# Throttle commands that go over a mobile network, too, are one step late (0.5 s, what a busy one takes at worst) and as
# lossy as samples, but never more than two in a row are lost. Inputs are committed 3 steps ahead.
CRUISE_DOWNLINK = Channel(loss=0.3, delay=1, max_consecutive_losses=2)
# One sample per step that is 1 to 2 steps late; 20 % are lost, never more than two in a row: no sample in use is older
# than 4 steps. Measurements are rounded to 1e-4 of their units.
CART_POLE_CHANNEL = Channel(loss=0.2, delay=1, jitter=1, max_consecutive_losses=2, quantization_step=1e-4)
# Motor commands go back over the same radio as the samples: 1 to 2 steps late (20 to 40 ms, a wireless network shared
# with others), 20 % lost, never more than two in a row. Inputs are committed 4 steps ahead.
CART_POLE_DOWNLINK = replace(CART_POLE_CHANNEL, quantization_step=0.0)
CART_POLE_TASK = SetpointTracking(output=np.array([1.0, 0.0, 0.0, 0.0]), reach=2.0, width=2.0, change_probability=0.02)
# A sample per step, one step late; 20 % are lost, never more than two in a row: none in use is older than 3 steps.
BATCH_REACTOR_CHANNEL = Channel(loss=0.2, delay=1, max_consecutive_losses=2, quantization_step=1e-3)
# A sample per step; 30 % are lost, never more than two in a row.
PENDULUM_CHANNEL = Channel(loss=0.3, max_consecutive_losses=2)


# The network decides here (docs/experiments.md): a sample per step, one step late, 40 % of which are lost, for the tank
# never more than five in a row, for the vehicles seven. What disturbs them keeps its sign for half a period.
CSTR_CHANNEL = Channel(loss=0.4, delay=1, max_consecutive_losses=5, quantization_step=0.1)
CONVOY_CHANNEL = Channel(loss=0.4, delay=1, max_consecutive_losses=7, quantization_step=0.05)
LANE_CHANNEL = replace(CONVOY_CHANNEL, quantization_step=0.002)
PERSISTENT = SinusoidDisturbance(period=100.0)
# The same contracts on request: at most two packets are lost in a row, so that five of the eight samples that may be
# missing are the controller's to leave out (docs/requests.md).
CONVOY_REQUESTS = replace(CONVOY_CHANNEL, max_consecutive_losses=2, on_request=True)
LANE_REQUESTS = replace(LANE_CHANNEL, max_consecutive_losses=2, on_request=True)


def loaded_truck_trailer() -> LinearPlant:
    """Returns the truck with a trailer of 4000 kg: full throttle overstretches its coupling."""
    return truck_trailer(mass=4000.0)


# The loaded trailer on the same coupling, noise and channel; the truck follows a random speed profile and starts within
# 0.2 of rest of the coupling.
_CRUISE = Factory(
    plant=loaded_truck_trailer, channel=CASE_STUDY_CHANNEL, task=SpeedTracking(), disturbance=CASE_STUDY_BOX, start=0.2
)
_CONVOY = Factory(
    plant=convoy,
    channel=CONVOY_CHANNEL,
    task=SetpointTracking(output=np.array([1.0, 0.0]), reach=0.9, width=0.9, preview=10, change_price=0.5),
    disturbance=PERSISTENT,
    terminates=True,
)
_LANE_KEEPING = Factory(
    plant=lane_keeping,
    channel=LANE_CHANNEL,
    task=SetpointTracking(output=np.array([1.0, 0.0]), reach=0.45, width=0.45, preview=10),
    disturbance=PERSISTENT,
    terminates=True,
)
_CART_POLE = Factory(plant=cart_pole, channel=CART_POLE_CHANNEL, task=CART_POLE_TASK, terminates=True)

# By id. The entry point of "ncs_gym/CartPole-v0" is `ncs_gym.registration:CART_POLE`, which `__getattr__` finds.
ENVIRONMENTS = {
    # Liu et al. Section 5: 1000 kg, dt 0.5 s, gamma 5e-4, Q = P0 = R = 1e-4 I (the paper prints no R), delta 0.05;
    # starts uniformly in the disc of radius 1.9.
    "ncs_gym/TruckTrailer-v0": Factory(
        plant=truck_trailer, channel=CASE_STUDY_CHANNEL, task=Regulation(), disturbance=CASE_STUDY_BOX, start=1.9
    ),
    "ncs_gym/TruckTrailerCruise-v0": _CRUISE,
    # The same truck with its controller elsewhere.
    "ncs_gym/TruckTrailerCruiseTwoWay-v0": replace(_CRUISE, downlink=CRUISE_DOWNLINK),
    # Any plant of the user's, behind a perfect channel unless given.
    "ncs_gym/LinearNCS-v0": Factory(plant=None, channel=Channel(), task=Regulation()),
    "ncs_gym/CartPole-v0": _CART_POLE,
    "ncs_gym/CartPoleTwoWay-v0": replace(_CART_POLE, downlink=CART_POLE_DOWNLINK),
    "ncs_gym/BatchReactor-v0": Factory(
        plant=batch_reactor,
        channel=BATCH_REACTOR_CHANNEL,
        task=SetpointTracking(output=np.array([1.0, 0.0, 0.0, 0.0]), reach=0.9, width=1.0, change_probability=0.05),
        terminates=True,
    ),
    "ncs_gym/CSTR-v0": Factory(
        plant=stirred_tank,
        channel=CSTR_CHANNEL,
        task=SetpointTracking(output=np.array([0.0, 1.0]), reach=4.5, width=4.5, preview=10),
        disturbance=PERSISTENT,
        terminates=True,
    ),
    "ncs_gym/Convoy-v0": _CONVOY,
    "ncs_gym/LaneKeeping-v0": _LANE_KEEPING,
    # The same vehicles, which ask for samples.
    "ncs_gym/ConvoyOnRequest-v0": replace(_CONVOY, channel=CONVOY_REQUESTS, contract=contract_of(CONVOY_CHANNEL)),
    "ncs_gym/LaneKeepingOnRequest-v0": replace(
        _LANE_KEEPING, channel=LANE_REQUESTS, contract=contract_of(LANE_CHANNEL)
    ),
    # Gymnasium's `Pendulum-v1` inside.
    "ncs_gym/Pendulum-v0": Factory(
        plant=pendulum,
        channel=PENDULUM_CHANNEL,
        task=SetpointTracking(output=np.array([1.0, 0.0]), reach=0.15, width=0.15, change_probability=0.02),
        terminates=True,
        process=PendulumProcess(),
    ),
    # Gymnasium's MuJoCo environment `InvertedPendulum-v5` inside.
    "ncs_gym/InvertedPendulum-v0": Factory(
        plant=inverted_pendulum,
        channel=PENDULUM_CHANNEL,
        task=SetpointTracking(output=np.array([1.0, 0.0, 0.0, 0.0]), reach=0.6, width=0.6, change_probability=0.02),
        terminates=True,
        process=InvertedPendulumProcess(),
        extra="mujoco",
    ),
    # The nonlinear equations of the cart-pole.
    "ncs_gym/CartPoleNonlinear-v0": replace(_CART_POLE, plant=nonlinear_cart_pole, process=CartPoleProcess()),
}
_LINEAR_NCS = "ncs_gym/LinearNCS-v0"


def _entry_point(env_id: str) -> str:
    """Returns the name of an environment among the entry points of this module: CART_POLE of "ncs_gym/CartPole-v0"."""
    return re.sub("(?<=[a-z])(?=[A-Z])", "_", env_id.removeprefix("ncs_gym/").removesuffix("-v0")).upper()


_BY_ENTRY_POINT = {_entry_point(env_id): factory for env_id, factory in ENVIRONMENTS.items()}


def __getattr__(name: str) -> Factory:
    """Returns the factory at an entry point: CART_POLE, or CART_POLE_VECTOR for many environments at once."""
    factory = _BY_ENTRY_POINT.get(name.removesuffix("_VECTOR"))
    if factory is None:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    return replace(factory, is_vector=name.endswith("_VECTOR"))


def _entry_points(env_id: str) -> dict[str, Any]:
    """Returns where gymnasium finds the factories of an environment of this module."""
    entry_point = f"{__name__}:{_entry_point(env_id)}"
    return {"entry_point": entry_point, "vector_entry_point": f"{entry_point}_VECTOR"}


def register_all() -> None:
    """Registers the ids with gymnasium; `import ncs_gym` calls it."""
    for env_id in ENVIRONMENTS:
        if env_id not in gym.registry:
            gym.register(id=env_id, max_episode_steps=EPISODE_STEPS, **_entry_points(env_id))


def registered_ids() -> list[str]:
    """Returns the ids of environments with a plant of their own, users' included, whose extra is installed."""
    own = [env_id for env_id, each in ENVIRONMENTS.items() if each.plant is not None and each.is_installed]
    entry_point = _entry_points(_LINEAR_NCS)["entry_point"]
    return own + [spec.id for spec in gym.registry.values() if spec.entry_point == entry_point and spec.kwargs]


def needing_extras() -> list[str]:
    """Returns the ids of this module's environments whose extra is not installed: `gym.make` says which one."""
    return [env_id for env_id, each in ENVIRONMENTS.items() if not each.is_installed]


def register_plant(
    env_id: str,
    plant: LinearPlant | Mapping[str, Any] | str | os.PathLike[str],
    *,
    channel: Channel | dict[str, Any] | None = None,
    task: Task | dict[str, Any] | None = None,
    contract: ChannelContract | dict[str, Any] | None = None,
    max_episode_steps: int = EPISODE_STEPS,
    **settings: Any,
) -> None:
    """Registers a plant as a Gymnasium environment, scalar and vectorized, with a time limit (docs/own_plant.md).

    With `register_plant("Plants/Tanks-v0", plant, channel=Channel(loss=0.3))` in a module `tank.py` the id works
    wherever Gymnasium's do, `gym.make("tank:Plants/Tanks-v0")`, and for the commands, `ncs compare --env
    tank:Plants/Tanks-v0`.

    Args:
        env_id: Id, such as "Plants/Tanks-v0".
        plant: The plant, its `document`, or the path of a file that `LinearPlant.save` wrote. The spec holds the
            document of a plant, so that it is JSON.
        channel: The network; a perfect one by default.
        task: The reward; `Regulation` by default.
        contract: What the channel promises; by default that of the channel if the plant is unstable, else none.
        max_episode_steps: Steps after which an episode is truncated; also the `horizon`.
        settings: Other keywords of `NCSEnv`.

    Raises:
        UnstablePlantError: If the plant is not Schur stable and there is no contract.
        TypeError: If a keyword is unknown.
        ValueError: If a setting is wrong, or the id is that of an environment of this package.
    """
    if env_id in ENVIRONMENTS:
        raise ValueError(f"{env_id} is an environment of this package: register the plant under an id of its own")
    steps = as_count(max_episode_steps, "max_episode_steps", low=1)
    given = {"channel": channel, "task": task, "contract": contract} | settings
    given = {name: value for name, value in given.items() if value is not None}
    is_path = isinstance(plant, (str, os.PathLike))
    given |= {"plant": os.path.abspath(plant) if is_path else plant, "horizon": steps}
    ENVIRONMENTS[_LINEAR_NCS](**given)  # wrong settings are noticed here rather than when the first environment is made
    gym.register(id=env_id, max_episode_steps=steps, kwargs=to_json(given), **_entry_points(_LINEAR_NCS))
