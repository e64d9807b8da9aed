"""The estimators of many environments at once; the last axis of every array is the environment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from ncs_gym.estimation.arrival_histories import NO_REPLAY, ArrivalHistories
from ncs_gym.estimation.error_table import NO_SAMPLE, UNKNOWN
from ncs_gym.estimation.estimator import PastSteps
from ncs_gym.estimation.innovation import ALARM_TOLERANCE, outside_sum_in_axes
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.validation import frozen


class VectorEstimator(PastSteps):
    """What `Estimator` does, for N environments.

    Attributes:
        alarm: Whether a measurement contradicted the assumed bounds in the episode, shape (N,).
        damaged: Whether one was no finite numbers, which the environment sees, shape (N,).
        history: Number of each environment's history, shape (N,).
    """

    def __init__(self, plant: LinearPlant, histories: ArrivalHistories, size: int) -> None:
        super().__init__(plant, histories, size)
        self.mean, self.age = np.zeros((plant.n, size)), np.zeros(size, np.int64)
        self.alarm, self.damaged = np.zeros((2, size), np.bool_)
        self.history = np.full(size, histories.root)

    @property
    def statistics(self) -> np.ndarray:
        """Numbers of the error statistics, whose shapes are `histories.table.shapes`, shape (N,)."""
        return self.histories.present.take(self.history)

    def follow(self, histories: ArrivalHistories) -> None:
        """Goes on with a graph for more delays, that of the same plant."""
        self.histories, self.history = histories, histories.taking_over(self.histories, self.history)
        self._remember(self._priors, self._inputs, self._samples)

    def begin(self, chosen: Any, mean: np.ndarray) -> None:
        """Starts episodes in some environments with first estimates, shape (n, count)."""
        self.mean = self.mean.copy()  # the old array is kept as a mean before an update
        self.mean[:, chosen] = mean
        frozen(self.mean)
        self.age[chosen], self.history[chosen] = 0, self.histories.root
        self.alarm[chosen] = self.damaged[chosen] = False

    def advance(self, u: np.ndarray, samples: np.ndarray | None, arrivals: list[tuple[int, np.ndarray]]) -> None:
        """Moves one step on: predicts with the inputs really applied, then takes in what arrived.

        Args:
            u: Applied inputs, shape (m, N) [physical units]; kept, not copied.
            samples: What was measured at this step, shape (p, N); None if nobody sends.
            arrivals: Ages of samples that arrive now, oldest first, each with the environments, shape (N,).
        """
        if self.histories.is_full:
            self.histories, self.history = self.histories.keeping(self.history)
        self._predict(u, samples)
        histories = self.histories
        self.history = self._follow(self.history, "next", histories.after_step)
        for age, arrives in arrivals:
            work_out = partial(histories.after_arrival, age=age)
            self.history = self._follow(self.history, "arrival", work_out, arrives, age)
        if arrivals:
            self._replay()

    def numbered(self, inputs: Sequence[np.ndarray], chosen: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Returns estimates, (n, N), and numbers of statistics, (N,), of those chosen after steps with inputs."""
        mean, statistics = self.mean, self.statistics
        if chosen is not None:
            mean, statistics, inputs = mean[:, chosen], statistics[chosen], [u[:, chosen] for u in inputs]
        for u in inputs:
            mean = self._predicted(mean, u)
        return mean, self.histories.predicted_many(statistics, len(inputs))

    def _follow(
        self,
        history: np.ndarray,
        table: str,
        work_out: Callable[[int], Any],
        where: np.ndarray | None = None,
        age: int | None = None,
    ) -> np.ndarray:
        """Returns the histories, shape (N,), that some lead to by an array of `ArrivalHistories`.

        Args:
            history: Where to go from, shape (N,).
            table: Name of the array.
            work_out: Called with the number of a history whose entry is missing.
            where: Which environments move, shape (N,); all by default.
            age: Of the samples that arrive, if any.
        """

        def looked_up() -> np.ndarray:
            array = getattr(self.histories, table)
            return (array if age is None else array[age]).take(history)

        after = looked_up()
        missing = after == UNKNOWN if where is None else (after == UNKNOWN) & where
        if np.count_nonzero(missing):  # quicker than any()
            for number in np.unique(history[missing]).tolist():
                work_out(number)
            after = looked_up()
        return after if where is None else np.where(where, after, history)

    def _replay(self) -> None:
        """Replays from the oldest new sample on, and keeps whichever history is better.

        Environments without new samples use none and keep what they have.
        """
        target = self._follow(self.history, "target", self.histories.after_replay)
        histories, H = self.histories, self.plant.H
        begins = histories.replay_from.take(self.history)
        oldest = int(begins.max())
        if oldest == NO_REPLAY:
            return
        accepted, new_age = histories.accepted.take(self.history), histories.new_age.take(self.history)
        used = histories.used[: oldest + 1].take(self.history, axis=1)
        mean = self._priors[oldest]
        for age in range(oldest, -1, -1):
            if age < oldest:
                mean = np.where(begins > age, self._predicted(mean, self._inputs[age]), self._priors[age])
                self._priors[age] = np.where(accepted, mean, self._priors[age])
            statistics, samples = used[age], self._samples[age]
            if samples is not None and np.count_nonzero(statistics):
                residual = samples - H.dot(mean)
                self._monitor(residual, statistics)
                mean = mean + np.einsum("ijk,jk->ik", histories.table.gains.take(statistics, axis=2), residual)
        self.mean = frozen(np.where(accepted, mean, self.mean))
        self.age = np.where(new_age == UNKNOWN, self.age, new_age)
        self.history = target

    def _monitor(self, residual: np.ndarray, statistics: np.ndarray) -> None:
        """Latches the alarm of environments whose residual, shape (p, N), no error and noise within bounds explain."""
        table = self.histories.table
        weights = table.quick_tests.take(statistics, axis=2)
        quick = np.einsum("ik,ijk,jk->k", residual, weights, residual)
        fits = quick <= 1.0
        if np.count_nonzero(fits) == len(fits):  # the usual case
            return
        doubtful = np.flatnonzero(~fits & (statistics != NO_SAMPLE))
        if doubtful.size:
            numbers, index = np.unique(statistics[doubtful], return_inverse=True)
            axes, values = zip(*(table.innovation_axes(each) for each in numbers.tolist()), strict=True)
            coordinates = np.einsum("kij,jk->ik", np.stack(axes)[index], residual[:, doubtful])
            outside = outside_sum_in_axes(np.square(coordinates), np.stack(values)[index].T, ALARM_TOLERANCE)
            self.alarm[doubtful[outside]] = True
