"""The delay-aware Kalman filter with a running hard ellipsoid around its error."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from math import isfinite
from typing import Any, NamedTuple

import numpy as np

from ncs_gym.estimation.arrival_histories import ArrivalHistories, arrival_histories, histories_of
from ncs_gym.estimation.error_bound import require_error_set
from ncs_gym.estimation.error_sets import ErrorSet
from ncs_gym.estimation.error_table import NO_SAMPLE, UNKNOWN, ErrorTable
from ncs_gym.estimation.innovation import ALARM_TOLERANCE, outside_sum
from ncs_gym.network.channel import Channel, Packet
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.validation import CopiedWhole, frozen, setting


class Estimate(NamedTuple):
    """What is known about the state at one step.

    Attributes:
        mean: x_hat, shape (n,).
        covariance: P, shape (n, n), of a Kalman filter that takes the same samples; picks gains and is never used for
            safety.
        shape: Sigma_k, shape (n, n): x_hat - x lies in E(Sigma_k).
        newest: Step of the newest sample used (0: the first estimate).
    """

    mean: np.ndarray
    covariance: np.ndarray
    shape: np.ndarray
    newest: int


class Estimator(CopiedWhole):
    """Estimates the state from time-stamped packets that may be lost, late, reordered or duplicated.

    The packets of a step are applied at the steps their samples were taken at, and everything after is replayed. Next
    to mean and covariance runs a hard ellipsoid E(Sigma_k) that holds the error at every step and never leaves the
    certified E(Sigma) (docs/shield_proof.md): predictions and updates are accepted only inside it. What depends only on
    when packets arrive is looked up (`ArrivalHistories`).

    Args:
        plant: The plant, whose inputs the estimator knows exactly.
        channel: Gives the quantizer's error and the longest delay, hence the replay buffer.
        error_set: E(Sigma) with its rate; computed from the plant by default.
        histories: A graph of the caller's in place of the shared one.
        after: An estimator whose episodes are counted on.

    Attributes:
        step: Steps since the start of the episode.
        episode: Number of the episode, counted from 0; packets of any other are discarded.
        alarm: Whether a measurement contradicted the assumed bounds in this episode.
        damaged: Whether one did because it was no finite numbers.

    Raises:
        UnstablePlantError: If no error set is given and the plant is not Schur stable.
        ErrorSetError: If the error set that is given does not meet its conditions, with slack for rounding.
        ValueError: If the channel rounds more coarsely than the contract of the error set allows.
    """

    plant: LinearPlant = setting("plant")
    channel: Channel = setting("channel")
    buffer: int = setting("buffer")
    error_set: ErrorSet = setting("error_set")

    def __init__(
        self,
        plant: LinearPlant,
        channel: Channel,
        error_set: ErrorSet | None = None,
        histories: ArrivalHistories | None = None,
        after: Estimator | None = None,
    ) -> None:
        self._plant, self._channel, self._buffer = plant, channel, channel.longest_delay
        if histories is None:
            if error_set is None:
                histories = arrival_histories(plant, channel, None)
            else:
                require_error_set(error_set, plant)
                histories = histories_of(plant, channel, error_set)
        self._histories = self._usual = histories
        self._error_set = self._histories.recursion.error_set
        contract = self._error_set.contract
        if contract is not None and not contract.is_fine_enough_for(channel):
            raise ValueError(f"the channel rounds more coarsely than the contract of the error set: {contract}")
        self._limit = plant.state_limit if np.isfinite(plant.state_limit).all() else None
        self.episode, self._is_new = (0, True) if after is None else (after.episode, after._is_new)
        self._begin(np.zeros(plant.n))

    def reset(self, mean: np.ndarray) -> None:
        """Starts an episode at step 0 with a first estimate, shape (n,), whose error lies in E(r0^2 I).

        The first call on an estimator that has not moved begins episode 0, every other one the next episode.
        """
        self.episode += not self._is_new
        self._is_new = False
        self._histories = self._usual
        self._begin(mean)

    def _begin(self, mean: np.ndarray) -> None:
        """Forgets everything but an estimate, shape (n,)."""
        self.step = self.age = 0
        self.alarm = self.damaged = False
        self.mean = frozen(np.array(mean, dtype=np.float64))
        self._history = self._histories.root
        # By age: means before updates, inputs that led there, and samples.
        self._priors: deque[np.ndarray] = deque(maxlen=self._buffer + 1)
        self._inputs: deque[np.ndarray] = deque(maxlen=self._buffer + 1)
        self._samples: deque[np.ndarray | None] = deque(maxlen=self._buffer + 1)

    @property
    def shape(self) -> np.ndarray:
        """Sigma_k, shape (n, n), read-only: x_hat - x lies in E(Sigma_k)."""
        histories = self._histories
        return histories.table.shape(histories.present.item(self._history))

    @property
    def estimate(self) -> Estimate:
        """What is known about the state now."""
        histories = self._histories
        covariance, shape, *_ = histories.table.statistics(histories.present.item(self._history))
        return Estimate(self.mean.copy(), covariance.copy(), shape.copy(), self.step - self.age)

    def as_filterpy(self) -> Any:
        """Returns the present estimate as a `filterpy.kalman.KalmanFilter` with the model of this estimator, a copy.

        The estimator itself looks covariances and gains up by when packets arrived, which an object that is moved step
        by step cannot; between two arrivals the two do the same.
        """
        from filterpy.kalman import KalmanFilter  # takes long to import; it has no types

        plant, recursion = self._plant, self._histories.recursion
        kalman: Any = KalmanFilter(dim_x=plant.n, dim_z=plant.p, dim_u=plant.m)
        kalman.x, kalman.P, _, _ = self.estimate
        kalman.F, kalman.B, kalman.H = plant.A.copy(), plant.B.copy(), plant.H.copy()
        kalman.Q, kalman.R = recursion.Q.copy(), recursion.R.copy()
        return kalman

    def advance(self, u: np.ndarray, packets: Iterable[Packet]) -> None:
        """Moves one step on: predicts with the input really applied, then takes in what arrived.

        Args:
            u: Applied input, shape (m,) [physical units].
            packets: In any order. Those of another episode are discarded, and stamps from the future, from before the
                first step, older than the replay buffer or seen before; another value with a stamp that was seen before
                raises the alarm.
        """
        self._is_new = False
        self.step += 1
        self.age += 1
        u = np.array(u, dtype=np.float64)
        self.mean = frozen(self._predicted(self.mean, u))
        self._priors.appendleft(self.mean)
        self._inputs.appendleft(u)
        self._samples.appendleft(None)
        history = present = self._histories.after_step(self._history)
        for packet in packets:
            history = self._take_in(packet, history)
        self._history = present if history == present else self._replayed(history)
        if self._histories.is_full:
            full = self._histories
            self._histories, kept = full.keeping(np.array([self._history]))
            self._history = kept.item()
            if self._usual is full:  # or it would stay in memory, and be full again after every reset
                self._usual = self._histories

    @property
    def table(self) -> ErrorTable:
        """The error shapes by the numbers that `numbered` returns; another one after shapes were forgotten."""
        return self._histories.table

    def predicted(self, inputs: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Returns estimate, (n,), and error shape, (n, n), after the next steps, given their inputs, (m,); read-only.

        It is what `advance` makes of the present estimate with these inputs and without packets: the error then lies in
        that ellipsoid, whatever packets arrive later.
        """
        mean, number = self.numbered(inputs)
        return mean, self.table.shape(number)

    def numbered(self, inputs: Sequence[np.ndarray]) -> tuple[np.ndarray, int]:
        """Returns what `predicted` does, the number of the error shape in `table` in place of the shape itself."""
        mean = self.mean
        for u in inputs:
            mean = frozen(self._predicted(mean, u))
        histories = self._histories
        return mean, histories.predicted(histories.present.item(self._history), len(inputs))

    def _take_in(self, packet: Packet, history: int) -> int:
        """Returns the history with one more packet, and keeps its sample."""
        if packet.episode != self.episode:
            return history
        age = self.step - packet.stamp
        after = self._histories.after_arrival(history, age)
        if after == history:
            before = self._samples[age] if 0 <= age < len(self._samples) else None
            if before is not None and before.tolist() != packet.measurement.tolist():
                self.alarm = True  # one of the two is not what the sensor measured then
            return history
        if not all(map(isfinite, packet.measurement.tolist())):
            self.alarm = self.damaged = True  # no sensor within the assumptions sends this
            return history
        self._samples[age] = packet.measurement
        return after

    def _replayed(self, history: int) -> int:
        """Replays from the oldest new sample on, keeps whichever history is better, and returns the history then."""
        histories, H = self._histories, self._plant.H
        target, oldest = histories.after_replay(history), histories.replay_from.item(history)
        used, table = histories.used[:, history].tolist(), histories.table
        mean, means = self._priors[oldest], {}
        for age in range(oldest, -1, -1):
            means[age] = mean
            statistics, sample = used[age], self._samples[age]
            if statistics != NO_SAMPLE and sample is not None:
                residual = sample - H.dot(mean)
                gain, quick_test = table.update(statistics)
                if not residual.dot(quick_test.dot(residual)) <= 1.0:
                    self._test_exactly(residual, statistics)
                mean = mean + gain.dot(residual)
            if age > 0:
                mean = self._predicted(mean, self._inputs[age - 1])
        if histories.accepted.item(history):
            self.mean = frozen(mean)
            for age, prior in means.items():
                self._priors[age] = prior
        if (new_age := histories.new_age.item(history)) != UNKNOWN:
            self.age = new_age
        return target

    def _predicted(self, mean: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Returns A x_hat + B u, shape (n,); an unstable plant's within the limit of its states."""
        mean = self._plant.A.dot(mean) + self._plant.B.dot(u)
        return mean if self._limit is None else np.minimum(np.maximum(mean, -self._limit), self._limit)

    def _test_exactly(self, residual: np.ndarray, statistics: int) -> None:
        """Latches the alarm if a residual y - H x_hat lies outside E(H Sigma H') + E(N).

        The ellipsoid of shape H Sigma H' + N, which the quick test is about, lies inside that sum.
        """
        recursion, H = self._histories.recursion, self._plant.H
        spread = H @ self._histories.table.shape(statistics) @ H.T
        self.alarm |= bool(outside_sum(residual[None], spread, recursion.sets.noise, ALARM_TOLERANCE)[0])
