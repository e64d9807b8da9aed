"""What environments of one loop and of many have in common."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym.disturbances import Disturbance
from ncs_gym.ellipsoid import Ellipsoid
from ncs_gym.envs.episode_channels import EpisodeChannels
from ncs_gym.envs.loop import Loop, LoopState
from ncs_gym.estimation.error_bound import ErrorSet
from ncs_gym.estimation.estimator import Belief
from ncs_gym.network.channel import Channel, ChannelContract, require_on_request
from ncs_gym.network.downlink import DownlinkProtocol
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes.process import Process
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
    guard: Any = setting("guard")

    np_random: np.random.Generator  # of gymnasium
    _now: LoopState
    _task_random: Any = None
    _belief: Belief
    # What decides the inputs: `shields.runtime.guard`. A step is `decide` and `observe`, a start is `begin`; `info`
    # follows, and what it lost is told last, when the step has happened. None for an environment without a shield.
    _guard: Any = None
    # Whether there is an episode that no exception has interrupted.
    _consistent = False

    def install(self, guard: Any) -> None:
        """Has a guard decide the inputs, from the next reset on; a shield does this.

        Raises:
            ValueError: If there is one.
        """
        if self._guard is not None:
            raise ValueError("the environment has a shield already: leave one out, or make an environment for each")
        self._guard, self._consistent = guard, False

    @property
    def links(self) -> dict[tuple[str, None], EpisodeChannels]:
        """The channels of the present episodes, by the name of their option of `reset`."""
        return self._now.links

    @property
    def state(self) -> np.ndarray:
        """The true state, shape (n,) or (N, n), a copy; only `reset(options={"state": x})` sets it."""
        return self._now.state.T.copy()

    def request(self, asked: Any = True) -> None:
        """Asks for a sample in the next step, where the channel takes samples on request (docs/requests.md).

        The request is decided together with the next action: without a downlink it is about the sample that the next
        step ends with, behind one about that of c steps later. Where nobody asks, samples are requested only if the
        contract needs them.

        Args:
            asked: A bool; of many environments also a mask, shape (N,).

        Raises:
            ValueError: If the channel does not take samples on request, or what is given is no bool.
        """
        require_on_request(self._now.requests).ask(asked)

    @property
    def outstanding(self) -> Any:
        """Number of samples requested that are newer than the newest one used (docs/requests.md, "The rule").

        An int, or shape (N,). Under a contract lost ones count, too; without one those that cannot arrive any more do
        not.

        Raises:
            ValueError: If the channel does not take samples on request.
        """
        found = require_on_request(self._now.requests).outstanding(self._now.estimator.age)
        return found if found.ndim else found.item()

    def _begin_draws_of_task(self, seed: int | None) -> None:
        """Gives the task a generator of its own, so that what it draws changes nothing in the loop."""
        if seed is not None or self._task_random is None:
            self._task_random = self.np_random.spawn(1)[0]
