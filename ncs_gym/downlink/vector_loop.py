"""The downlinks of many control loops; the last axis of every array is the environment."""

from __future__ import annotations

import numpy as np

from ncs_gym.downlink.loop import Inputs
from ncs_gym.downlink.prediction import PredictedStatistics
from ncs_gym.downlink.protocol import DownlinkProtocol
from ncs_gym.estimation.vector_estimator import VectorEstimator
from ncs_gym.network.packet_transmission import VectorChannelState
from ncs_gym.tasks.task import Task

# Stamp of the newest command where none has arrived.
NEVER = -(2**31)


class VectorIdealDownlink:
    """What `IdealDownlink` does, for N environments.

    Args:
        estimator: Knows the present.
        size: N.

    Attributes:
        protocol: None.
        lead: c = 0.
    """

    protocol: DownlinkProtocol | None = None
    lead: int = 0

    def __init__(self, estimator: VectorEstimator, size: int) -> None:
        self._estimator, self._on_time = estimator, np.zeros(size, np.bool_)

    def begin(self, rng: np.random.Generator, chosen: np.ndarray) -> None:
        """Starts episodes in some environments, given by a mask of shape (N,)."""

    def exchange(self, rng: np.random.Generator, steps: np.ndarray, u: np.ndarray) -> Inputs:
        """Takes the inputs decided at steps (N,) of the episodes, shape (m, N), and returns what is applied then."""
        return Inputs(u, u, self._on_time)

    def predicted(self, task: Task, task_state: np.ndarray) -> np.ndarray:
        """Returns what is known of the task's states at the time at which the next decisions take effect."""
        return task_state

    def belief(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns estimates, (n, N), and numbers of error statistics, (N,), of the time of the next effect."""
        return self._estimator.mean, self._estimator.statistics

    def beliefs(self, chosen: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Returns those of now and of the c steps to come, for environments given by their indices."""
        mean, statistics = self.belief()
        return [(mean[:, chosen], statistics[chosen])]


class VectorCommittedDownlink(VectorIdealDownlink):
    """What `CommittedDownlink` does, for N environments.

    Every command holds the committed inputs of its c steps unchanged: which one is the newest is all that matters.

    Args:
        protocol: The channel, and how far ahead inputs are committed.
        estimator: Knows the present.
        size: N.
    """

    def __init__(self, protocol: DownlinkProtocol, estimator: VectorEstimator, size: int) -> None:
        super().__init__(estimator, size)
        self.protocol, self.lead = protocol, protocol.lead
        self._channel, self._size = protocol.channel, size
        self._inputs = [np.zeros((estimator.plant.m, size)) for _ in range(self.lead)]
        self._newest = np.full(size, NEVER, np.int64)
        self._ahead = [PredictedStatistics(steps) for steps in range(self.lead + 1)]
        self._channel_state: VectorChannelState

    def begin(self, rng: np.random.Generator, chosen: np.ndarray) -> None:  # noqa: D102
        if chosen.all():
            self._channel_state = VectorChannelState(self._channel, rng, self._size)
        else:
            self._channel_state.begin(rng, chosen)
        self._newest[chosen] = NEVER
        for u in self._inputs:
            u[:, chosen] = 0.0

    def exchange(self, rng: np.random.Generator, steps: np.ndarray, u: np.ndarray) -> Inputs:  # noqa: D102
        scheduled, *self._inputs = *self._inputs, u.copy()  # at once: never one too many, whatever interrupts a step
        self._channel_state.send(rng, steps)
        for age, arrives in self._channel_state.arrivals():
            self._newest = np.where(arrives, np.maximum(self._newest, steps - age), self._newest)
        missing = (self._newest < steps - self.lead) & (steps >= self.lead)
        return Inputs(np.where(missing, 0.0, scheduled), u, missing)

    def predicted(self, task: Task, task_state: np.ndarray) -> np.ndarray:  # noqa: D102
        for u in self._inputs:
            task_state = task.predict_many(self._estimator.plant, task_state, u)
        return task_state

    def belief(self) -> tuple[np.ndarray, np.ndarray]:  # noqa: D102
        estimator = self._estimator
        mean = estimator.predicted(estimator.mean, self._inputs)
        return mean, self._ahead[-1].of(estimator.patterns, estimator.statistics)

    def beliefs(self, chosen: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:  # noqa: D102
        estimator, found = self._estimator, []
        mean, statistics = estimator.mean[:, chosen], estimator.statistics[chosen]
        for ahead, u in enumerate([None, *self._inputs]):
            mean = mean if u is None else estimator.predicted(mean, [u[:, chosen]])
            found.append((mean, self._ahead[ahead].of(estimator.patterns, statistics)))
        return found


def vector_downlink_of(protocol: DownlinkProtocol | None, estimator: VectorEstimator, size: int) -> VectorIdealDownlink:
    """Returns the downlinks of N control loops; None stands for ideal ones."""
    if protocol is None:
        return VectorIdealDownlink(estimator, size)
    return VectorCommittedDownlink(protocol, estimator, size)
