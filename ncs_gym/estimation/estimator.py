"""The delay-aware Kalman filter with a running hard ellipsoid around its error, of one loop and of N; the belief."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from math import isfinite
from typing import Any, NamedTuple

import numpy as np

from ncs_gym.ellipsoid import ALARM_TOLERANCE, outside_sum, outside_sum_in_axes
from ncs_gym.estimation.arrival_histories import (
    NO_REPLAY,
    NO_SAMPLE,
    UNKNOWN,
    ArrivalHistories,
    ErrorTable,
    arrival_histories,
    histories_of,
)
from ncs_gym.estimation.error_bound import ErrorSet, require_error_set
from ncs_gym.network.channel import Channel, Packet
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.validation import CopiedWhole, frozen, setting


class Belief(NamedTuple):
    """What a controller can know of a loop now; of N loops, arrays whose last axis is the loop.

    A shield takes what it decides on from here, never from an `info`, into which wrappers may have written. Nobody
    writes into the arrays.

    Attributes:
        estimate: x_hat of the time at which the next decision takes effect, shape (n,) or (n, N).
        number: Number of the ellipsoid Sigma_k that holds its error, an int or shape (N,).
        table: What gives that number its meaning; another one after shapes were forgotten.
        age: Steps since the newest sample used was taken, an int or shape (N,).
        alarm: Whether an assumption was seen to be violated, a bool or shape (N,).
        damaged: Whether one was because a sample was no finite numbers, likewise.
        outside: Whether `alarm` is also about a step of the process outside E(D), likewise.
        applied: The input applied in the last step, shape (m,) or (m, N) [physical units]; zeros at a reset.
        committed: The input decided in the last step, of the same shape.
        moves: Steps and resets of this loop since it was made, an int or shape (N,): the one clock.
    """

    estimate: np.ndarray
    number: Any
    table: ErrorTable
    age: Any
    alarm: Any
    damaged: Any
    outside: Any
    applied: np.ndarray
    committed: np.ndarray
    moves: Any = 0

    def __deepcopy__(self, memo: dict[int, Any]) -> Belief:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return _loaded_belief, tuple(self)

    @property
    def error_shape(self) -> np.ndarray:
        """Sigma_k, shape (n, n) and read-only, or a fresh array of shape (N, n, n)."""
        if self.estimate.ndim == 1:
            return self.table.shape(self.number)
        return self.table.shapes.take(self.number, axis=0)


def _loaded_belief(*values: Any) -> Belief:
    return Belief._make(frozen(each) if isinstance(each, np.ndarray) else each for each in values)


class PastSteps(CopiedWhole):
    """What an estimator keeps of the last steps: of one loop, or of N along the last axis of every array.

    Attributes:
        plant: The plant, whose inputs are known exactly.
        histories: The graph of arrival histories in use; another one after histories were forgotten.
        mean: x_hat, shape (n,) or (n, N), read-only.
        age: Steps since the newest sample used was taken, an int or shape (N,).
    """

    mean: np.ndarray
    age: Any

    def __init__(self, plant: LinearPlant, histories: ArrivalHistories, size: int | None = None) -> None:
        self.plant, self.histories = plant, histories
        limit = plant.state_limit if size is None else plant.state_limit[:, None]
        self._limit = limit if np.isfinite(limit).all() else None
        self._remember((), (), ())

    def _remember(self, priors: Iterable, inputs: Iterable, samples: Iterable) -> None:
        """Keeps means before updates, inputs that led there and samples, by age."""
        length = self.histories.buffer + 1
        self._priors: deque[np.ndarray] = deque(priors, maxlen=length)
        self._inputs: deque[np.ndarray] = deque(inputs, maxlen=length)
        self._samples: deque[np.ndarray | None] = deque(samples, maxlen=length)

    @property
    def table(self) -> ErrorTable:
        """The error shapes by the numbers that `numbered` returns."""
        return self.histories.table

    def _predict(self, u: np.ndarray, samples: np.ndarray | None) -> None:
        """Moves the mean one step on with an input, (m,) or (m, N)."""
        self.mean = self._predicted(self.mean, u)
        self.mean.flags.writeable = False
        self._priors.appendleft(self.mean)
        self._inputs.appendleft(u)
        self._samples.appendleft(samples)
        self.age += 1

    def _predicted(self, mean: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Returns A x_hat + B u, within the limit of an unstable plant's states."""
        mean = self.plant.A.dot(mean) + self.plant.B.dot(u)
        return mean if self._limit is None else np.minimum(np.maximum(mean, -self._limit), self._limit)


class Estimator(PastSteps):
    """Estimates the state from time-stamped packets that may be lost, late, reordered or duplicated.

    The packets of a step are applied at the steps their samples were taken at, and everything after is replayed. Next
    to mean and covariance runs a hard ellipsoid E(Sigma_k) that holds the error at every step and never leaves the
    certified E(Sigma) (docs/shield_proof.md). What depends only on when packets arrive is looked up
    (`ArrivalHistories`).

    Args:
        plant: The plant, whose inputs the estimator knows exactly.
        channel: Gives the quantizer's error and the longest delay, hence the replay buffer.
        error_set: E(Sigma) with its rate; computed from the plant by default.
        histories: A graph of the caller's in place of the shared one.
        after: An estimator whose episodes are counted on.

    Attributes:
        channel, error_set: The same.
        step: Steps since the start of the episode.
        episode: Number of the episode, counted from 0; packets of any other are discarded.
        alarm: Whether a measurement contradicted the assumed bounds in this episode.
        damaged: Whether one did because it was no finite numbers.

    Raises:
        UnstablePlantError: If no error set is given and the plant is not Schur stable.
        ErrorSetError: If the error set that is given does not meet its conditions, with slack for rounding.
        ValueError: If the channel rounds more coarsely than the contract of the error set allows.
    """

    buffer: int = setting("buffer", "histories.buffer")

    def __init__(
        self,
        plant: LinearPlant,
        channel: Channel,
        error_set: ErrorSet | None = None,
        histories: ArrivalHistories | None = None,
        after: Estimator | None = None,
    ) -> None:
        if error_set is not None and histories is None:
            require_error_set(error_set, plant)
            histories = histories_of(plant, channel, error_set)
        histories = arrival_histories(plant, channel, None) if histories is None else histories
        super().__init__(plant, histories)
        self._usual, self.channel, self.error_set = histories, channel, histories.recursion.error_set
        contract = self.error_set.contract
        if contract is not None and not contract.is_fine_enough_for(channel):
            raise ValueError(f"the channel rounds more coarsely than the contract of the error set: {contract}")
        self.episode, self._is_new = (0, True) if after is None else (after.episode, after._is_new)
        self._begin(np.zeros(plant.n))

    def reset(self, mean: np.ndarray) -> None:
        """Starts the next episode, or episode 0 at first, with an estimate, shape (n,), whose error is in E(X0)."""
        self.episode += not self._is_new
        self._is_new = False
        self.histories = self._usual
        self._begin(mean)

    def _begin(self, mean: np.ndarray) -> None:
        self.step = self.age = 0
        self.alarm = self.damaged = False
        self.mean = frozen(np.array(mean, dtype=np.float64))
        self.history = self.histories.root
        self._remember((), (), ())

    @property
    def shape(self) -> np.ndarray:
        """Sigma_k, shape (n, n), read-only: x_hat - x lies in E(Sigma_k)."""
        return self.table.shape(self.histories.present.item(self.history))

    @property
    def covariance(self) -> np.ndarray:
        """P, (n, n), of a Kalman filter that takes the same samples; it is never used for safety."""
        return self.table.statistics(self.histories.present.item(self.history)).covariance

    def as_filterpy(self) -> Any:
        """Returns the estimate as a `filterpy.kalman.KalmanFilter`, which does the same between two arrivals."""
        from filterpy.kalman import KalmanFilter  # takes long to import; it has no types

        plant, recursion = self.plant, self.histories.recursion
        kalman: Any = KalmanFilter(dim_x=plant.n, dim_z=plant.p, dim_u=plant.m)
        kalman.x, kalman.P = self.mean.copy(), self.covariance.copy()
        kalman.F, kalman.B, kalman.H = plant.A.copy(), plant.B.copy(), plant.H.copy()
        kalman.Q, kalman.R = recursion.Q.copy(), recursion.R.copy()
        return kalman

    def advance(self, u: np.ndarray, packets: Iterable[Packet]) -> None:
        """Moves one step on: predicts with the input really applied, then takes in what arrived.

        Args:
            u: Applied input, shape (m,) [physical units].
            packets: In any order. Those of another episode are discarded, and stamps from the future, from before the
                first step, older than the buffer or seen before; another value with a stamp seen before is an alarm.
        """
        self._is_new = False
        self.step += 1
        self._predict(np.array(u, dtype=np.float64), None)
        history = present = self.histories.after_step(self.history)
        for packet in packets:
            history = self._take_in(packet, history)
        self.history = present if history == present else self._replayed(history)
        if self.histories.is_full:
            full = self.histories
            self.histories, kept = full.keeping(np.array([self.history]))
            self.history = kept.item()
            if self._usual is full:  # or it would stay in memory, and be full again after every reset
                self._usual = self.histories

    def numbered(self, inputs: Sequence[np.ndarray]) -> tuple[np.ndarray, int]:
        """Returns estimate, (n,), and number of the error shape in `table` after steps with inputs, (m,), alone."""
        mean = self.mean
        for u in inputs:
            mean = frozen(self._predicted(mean, u))
        histories = self.histories
        return mean, histories.predicted(histories.present.item(self.history), len(inputs))

    def _take_in(self, packet: Packet, history: int) -> int:
        """Returns the history with one more packet, and keeps its sample."""
        if packet.episode != self.episode:
            return history
        age = self.step - packet.stamp
        after = self.histories.after_arrival(history, age)
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
        histories, H = self.histories, self.plant.H
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

    def _test_exactly(self, residual: np.ndarray, statistics: int) -> None:
        """Latches the alarm if a residual y - H x_hat lies outside E(H Sigma H') + E(N)."""
        recursion, H = self.histories.recursion, self.plant.H
        spread = H @ self.histories.table.shape(statistics) @ H.T
        self.alarm |= bool(outside_sum(residual[None], spread, recursion.sets.noise, ALARM_TOLERANCE)[0])


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
