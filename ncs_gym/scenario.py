"""Defaults of a registered environment, from which it is made, alone or for many at once."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, ClassVar

import numpy as np

from ncs_gym.envs.env import NCSEnv
from ncs_gym.envs.vector_env import NCSVectorEnv
from ncs_gym.json_settings import DISTURBANCES, PROCESSES, TASKS, as_plant, from_json
from ncs_gym.network.channel import Channel
from ncs_gym.network.contract import ChannelContract
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes import Process
from ncs_gym.tasks.task import Task
from ncs_gym.uncertainty.bounded_disturbances import BoxDisturbance
from ncs_gym.uncertainty.ellipsoid import Ellipsoid

# Steps per episode of every registered environment (Liu et al. Section 5).
EPISODE_STEPS = 200
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
