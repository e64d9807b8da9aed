"""The downlink of one control loop: what the actuator applies, and what is known of the time of the next effect."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ncs_gym.downlink.actuator import Actuator, Command
from ncs_gym.downlink.committed_inputs import CommittedInputs
from ncs_gym.downlink.protocol import DownlinkProtocol
from ncs_gym.estimation.estimator import Estimator
from ncs_gym.network.packet_transmission import ChannelState
from ncs_gym.tasks.task import Task


class Inputs(NamedTuple):
    """The inputs of one step; of many environments, arrays whose last axis is the environment.

    Attributes:
        applied: What the actuator applies now, shape (m,) or (m, N) [physical units].
        committed: What was decided now, for c steps later, of the same shape.
        missing: Whether zero is applied because the input committed for now has not arrived, a bool or shape (N,).
    """

    applied: np.ndarray
    committed: np.ndarray
    missing: np.ndarray | bool


def no_inputs(inputs: int, size: int | None = None) -> Inputs:
    """Returns the inputs at a reset: zeros, shape (m,), or (m, N) for a size."""
    if size is None:
        return Inputs(np.zeros(inputs), np.zeros(inputs), False)
    return Inputs(np.zeros((inputs, size)), np.zeros((inputs, size)), np.zeros(size, np.bool_))


class IdealDownlink:
    """Applies at once what is decided.

    Args:
        estimator: Knows the present.

    Attributes:
        protocol: None.
        lead: c = 0.
    """

    protocol: DownlinkProtocol | None = None
    lead: int = 0

    def __init__(self, estimator: Estimator) -> None:
        self._estimator = estimator

    def begin(self, rng: np.random.Generator) -> None:
        """Starts an episode."""

    def exchange(self, rng: np.random.Generator, step: int, u: np.ndarray) -> Inputs:
        """Takes the input decided at a step, shape (m,), and returns what is applied then."""
        return Inputs(u, u, False)

    def predicted(self, task: Task, task_state: Any) -> Any:
        """Returns what is known of the task's state at the time at which the next decision takes effect."""
        return task_state

    def belief(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns estimate, (n,), and error shape, (n, n), of the time at which the next decision takes effect."""
        return self._estimator.mean, self._estimator.shape

    def beliefs(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Returns estimates and error shapes of now and of the c steps to come, the last of which is `belief`."""
        return [self.belief()]


class CommittedDownlink(IdealDownlink):
    """Sends the committed inputs over a channel, and predicts their effect.

    Args:
        protocol: The channel, and how far ahead inputs are committed.
        estimator: Knows the present.

    Attributes:
        in_flight: The channel and the commands on their way.
    """

    def __init__(self, protocol: DownlinkProtocol, estimator: Estimator) -> None:
        super().__init__(estimator)
        self.protocol, self.lead = protocol, protocol.lead
        self._channel = protocol.channel
        self._actuator = Actuator(self.lead, estimator.plant.m)
        self._inputs = CommittedInputs(self.lead, estimator.plant.m)
        self.in_flight: ChannelState

    def begin(self, rng: np.random.Generator) -> None:  # noqa: D102
        self.in_flight, self._episode = ChannelState(self._channel, rng), self._estimator.episode
        self._actuator.start(self._episode)
        self._inputs.start()

    def exchange(self, rng: np.random.Generator, step: int, u: np.ndarray) -> Inputs:  # noqa: D102
        self._inputs.commit(u)
        arrived: list[Command] = self.in_flight.carry(rng, step, self._inputs.command(step, self._episode))
        self._actuator.receive(arrived)
        self._inputs.pop()
        return Inputs(self._actuator.apply(step), u, self._actuator.missing)

    def predicted(self, task: Task, task_state: Any) -> Any:  # noqa: D102
        for u in self._inputs.pending:
            task_state = task.predict(self._estimator.plant, task_state, u)
        return task_state

    def belief(self) -> tuple[np.ndarray, np.ndarray]:  # noqa: D102
        return self._estimator.predicted(self._inputs.pending)

    def beliefs(self) -> list[tuple[np.ndarray, np.ndarray]]:  # noqa: D102
        pending = self._inputs.pending
        return [self._estimator.predicted(pending[:ahead]) for ahead in range(self.lead + 1)]


def downlink_of(protocol: DownlinkProtocol | None, estimator: Estimator) -> IdealDownlink:
    """Returns the downlink of a control loop; None stands for an ideal one."""
    return IdealDownlink(estimator) if protocol is None else CommittedDownlink(protocol, estimator)
