"""The estimator without look-up: every prediction and every update is worked out again, at each step and replay."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ncs_gym import Channel, Packet
from ncs_gym.ellipsoid import ALARM_TOLERANCE, outside_sum
from ncs_gym.estimation.kalman_filter import ErrorRecursion, ErrorStatistics
from ncs_gym.plants.linear_plant import LinearPlant


class Prior(NamedTuple):
    """An estimate before the update of its step, and what is known of its error."""

    mean: np.ndarray
    statistics: ErrorStatistics


class PlainEstimator:
    """What `Estimator` does, as a history of `Prior`s by step: no numbers, no graph, nothing shared or remembered."""

    def __init__(self, plant: LinearPlant, channel: Channel, recursion: ErrorRecursion) -> None:
        self.plant, self.buffer, self.recursion = plant, channel.longest_delay, recursion
        self.reset(np.zeros(plant.n))

    def reset(self, mean: np.ndarray) -> None:
        self.step, self.alarm = 0, False
        self.mean, self.statistics = np.array(mean, dtype=np.float64), self.recursion.first
        self.priors: dict[int, Prior] = {}
        self.inputs: dict[int, np.ndarray] = {}
        self.samples: dict[int, np.ndarray] = {}

    @property
    def age(self) -> int:
        """Never capped, other than in the graph."""
        return self.statistics.age

    def advance(self, u: np.ndarray, packets: Iterable[Packet]) -> None:
        self.inputs[self.step] = np.array(u, dtype=np.float64)
        self.mean, self.statistics = self._predicted(self.mean, self.statistics, self.step)
        self.step += 1
        self.priors[self.step] = Prior(self.mean, self.statistics)
        new = []
        for stamp, measurement, _ in packets:
            if stamp in self.samples and not np.array_equal(measurement, self.samples[stamp]):
                self.alarm = True  # one of the two is wrong
            if stamp not in self.priors or stamp in self.samples:
                continue
            since = [self.priors[step].statistics.certified for step in range(stamp, self.step + 1)]
            if self.statistics.certified and not all(since):
                continue
            if np.isfinite(measurement).all():
                self.samples[stamp] = measurement
                new.append(stamp)
            else:
                self.alarm = True
        if new:
            self._replay(min(new))
        for history in (self.priors, self.inputs, self.samples):
            history.pop(self.step - self.buffer, None)  # too old for the packets of the next step

    def _replay(self, oldest: int) -> None:
        """Works everything out again from a step on, with every sample held, and keeps the better history."""
        mean, statistics = self.priors[oldest]
        priors = {}
        for step in range(oldest, self.step + 1):
            priors[step] = Prior(mean, statistics)
            if step in self.samples:
                residual = self.samples[step] - self.plant.H.dot(mean)
                spread, noise = self.plant.H @ statistics.shape @ self.plant.H.T, self.recursion.sets.noise
                self.alarm |= bool(outside_sum(residual[None], spread, noise, ALARM_TOLERANCE)[0])
                update = self.recursion.updated(statistics)
                if update is not None:
                    gain, statistics = update
                    mean = mean + gain.dot(residual)
            if step < self.step:
                mean, statistics = self._predicted(mean, statistics, step)
        if self.recursion.prefers(statistics, self.statistics):
            self.mean, self.statistics = mean, statistics
            self.priors.update(priors)

    def _predicted(
        self, mean: np.ndarray, statistics: ErrorStatistics, step: int
    ) -> tuple[np.ndarray, ErrorStatistics]:
        mean = self.plant.A.dot(mean) + self.plant.B.dot(self.inputs[step])
        limit = self.plant.state_limit
        return np.minimum(np.maximum(mean, -limit), limit), self.recursion.predicted(statistics)
