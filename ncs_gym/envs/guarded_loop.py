"""What environments of one loop and of many have in common."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym.envs.info import loop_info
from ncs_gym.envs.loop import Loop, LoopState
from ncs_gym.envs.report import Belief, Guard
from ncs_gym.envs.spaces import actions_of
from ncs_gym.estimation.error_sets import ErrorSet
from ncs_gym.network.channel import Channel
from ncs_gym.network.contract import ChannelContract
from ncs_gym.network.downlink import DownlinkProtocol, Inputs
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes.process import Process
from ncs_gym.uncertainty.disturbances import Disturbance
from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.validation import setting


class GuardedLoop:
    """What environments of one loop and of many have in common: the parts of the loop, and the guard inside it."""

    loop: Loop = setting("loop", "_now.loop")
    plant: LinearPlant = setting("plant", "_now.loop.plant")
    channel: Channel = setting("channel", "_now.loop.channel")
    disturbance: Disturbance = setting("disturbance", "_now.loop.disturbance")
    initial_set: Ellipsoid = setting("initial_set", "_now.loop.initial_set")
    allow_assumption_violation: bool = setting("allow_assumption_violation", "_now.loop.allow_assumption_violation")
    contract: ChannelContract | None = setting("contract", "_now.loop.contract")
    certificate_contract: ChannelContract | None = setting("certificate_contract", "_now.loop.certificate_contract")
    error_set: ErrorSet = setting("error_set", "_now.loop.error_set")
    noise: str = setting("noise", "_now.loop.noise")
    process: Process = setting("process", "_now.loop.process")
    downlink: Channel | None = setting("downlink", "_now.loop.downlink")
    downlink_contract: ChannelContract | None = setting("downlink_contract", "_now.loop.downlink_contract")
    downlink_protocol: DownlinkProtocol = setting("downlink_protocol", "_now.loop.protocol")
    belief: Belief = setting("belief")
    guard: Guard | None = setting("guard")

    np_random: np.random.Generator  # of gymnasium
    _now: LoopState
    _task_random: np.random.Generator | None = None
    _belief: Belief
    _guard: Guard | None = None
    # Whether there is an episode that no exception has interrupted.
    _consistent = False

    def install(self, guard: Guard) -> None:
        """Has a guard decide the inputs, from the next reset on; a shield does this.

        Raises:
            ValueError: If there is one.
        """
        if self._guard is not None:
            raise ValueError("the environment has a shield already: leave one out, or make an environment for each")
        self._guard, self._consistent = guard, False

    def _draws_of_task(self, seed: int | None = None) -> np.random.Generator:
        """Returns the task's own generator, so that what a task draws changes nothing in the loop; a seed renews it."""
        if seed is not None or self._task_random is None:
            self._task_random = self.np_random.spawn(1)[0]
        return self._task_random

    def _info(self, inputs: Inputs, arrived: Any, counted: Any = None, read: Any = None) -> dict[str, Any]:
        """Returns `info`, and keeps the belief; see `LoopState.report` and `actions_of`."""
        report = self._now.report(inputs, arrived, counted)
        self._belief = report.belief
        return loop_info(report, self.loop, actions_of(inputs, self.plant, read))
