"""Arrival histories: everything of an estimator but its means, worked out once for whatever arrived when."""

from __future__ import annotations

import struct
import threading
import weakref
from hashlib import blake2b
from typing import Any

import numpy as np

from ncs_gym.ellipsoid import common_axes, quick_test
from ncs_gym.estimation.error_bound import ErrorSet, certified_error_set
from ncs_gym.estimation.kalman_filter import ErrorRecursion, ErrorStatistics
from ncs_gym.network.channel import Channel, ChannelContract
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.validation import frozen

# Number of what is not worked out yet, and of "no sample is used here", whose gain is zero.
UNKNOWN, NO_SAMPLE = -1, 0
# Numbers that arrays have room for to begin with.
FIRST_CAPACITY = 256
# What a dictionary takes for a key of bytes and its number, without those bytes.
BYTES_PER_KEY = 150
# Bytes of the hash that statistics are found by.
_HASH_SIZE = 16
# The arrays of a table, whose last or first axis is the number.
_BY_NUMBER_LAST = "gains", "quick_tests"
_BY_NUMBER = (
    *("_gains", "_by_columns", "_quick_tests", "_covariances", "_shapes"),
    *("_after_step", "_after_update", "_certified", "_ages"),
)


class ErrorTable:
    """The distinct error statistics met so far, and what a prediction and an update make of each, worked out once.

    The recursion rounds statistics, so that they recur; equal ones have one number. Who adds to the table holds the
    lock of its graph.

    Attributes:
        recursion: Moves the error statistics.
        oldest: Ages above this make no difference.
        gains: Of an update, by number, shape (n, p, capacity); zero until it is worked out.
        quick_tests: W of the quick innovation test, by number, shape (p, p, capacity); zero until it is worked out.
    """

    def __init__(self, recursion: ErrorRecursion, oldest: int) -> None:
        n, p, size = recursion.plant.n, recursion.plant.p, FIRST_CAPACITY
        self.recursion, self.oldest = recursion, oldest
        self._count = 0
        self._numbers: dict[bytes, int] = {}
        self._axes: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self.gains, self.quick_tests = np.zeros((n, p, size)), np.zeros((p, p, size))
        self._ages, self._after_step, self._after_update = np.zeros((3, size), np.int64)
        # The same once more, for one at a time. Gains in the order in memory in which they were made: the last bit of a
        # product depends on it, and who runs an experiment again expects the same numbers.
        self._gains, self._by_columns = np.zeros((size, n * p)), np.zeros(size, np.bool_)
        self._quick_tests = np.zeros((size, p, p))
        self._covariances, self._shapes = np.zeros((2, size, n, n))
        self._certified = np.zeros(size, np.bool_)
        self._after_update[self._add(recursion.first)] = NO_SAMPLE  # which no other statistics are equal to

    def __len__(self) -> int:
        return self._count

    def __deepcopy__(self, memo: dict[int, Any]) -> ErrorTable:
        return self  # shared by all estimators

    @property
    def bytes_each(self) -> int:
        """What the statistics of one number take, about [bytes]."""
        n, p = self.recursion.plant.n, self.recursion.plant.p
        return BYTES_PER_KEY + _HASH_SIZE + 8 * (2 * n**2 + 2 * n * p + 2 * p**2 + 3) + 2

    @property
    def shapes(self) -> np.ndarray:
        """The error shapes Sigma_k by number, shape (count, n, n), read-only."""
        return frozen(self._shapes[: self._count])

    @property
    def certified(self) -> np.ndarray:
        """`ErrorStatistics.certified` by number, shape (count,), read-only."""
        return frozen(self._certified[: self._count])

    def is_certified(self, number: int) -> bool:
        """Returns `ErrorStatistics.certified` of a number."""
        return self._certified.item(number)

    def shape(self, number: int) -> np.ndarray:
        """Returns an error shape Sigma_k, shape (n, n), read-only."""
        shape = self._shapes[number]
        shape.flags.writeable = False
        return shape

    def statistics(self, number: int) -> ErrorStatistics:
        """Returns statistics by their number, read-only.

        They are copies: on some processors the last bit of a sum depends on where in memory its terms lie.
        """
        covariance, shape = self._covariances[number].copy(), self._shapes[number].copy()
        return ErrorStatistics(frozen(covariance), frozen(shape), self._ages.item(number), self._certified.item(number))

    def number_of(self, statistics: ErrorStatistics) -> int:
        """Returns the number of statistics, a new one if they have not occurred."""
        age = min(statistics.age, self.oldest)
        small = age.to_bytes(4, "little") + bytes([statistics.certified])
        whole = b"".join((statistics.covariance.tobytes(), statistics.shape.tobytes(), small))
        key = blake2b(whole, digest_size=_HASH_SIZE).digest()
        number = self._numbers.get(key)
        if number is None:
            number = self._add(statistics._replace(age=age))
            self._numbers[key] = number  # last: if this is interrupted, the statistics have not occurred
        return number

    def after_step(self, number: int) -> int:
        """Returns the number of the statistics one step later."""
        after = self._after_step.item(number)
        if after == UNKNOWN:
            after = self.number_of(self.recursion.predicted(self.statistics(number)))
            self._after_step[number] = after
        return after

    def after_update(self, number: int) -> int:
        """Returns the number of the statistics after an update; the same where the sample must not be used."""
        after = self._after_update.item(number)
        if after == UNKNOWN:
            statistics, after = self.statistics(number), number
            weight = quick_test(self._spread(statistics.shape), self.recursion.sets.noise)
            if (update := self.recursion.updated(statistics)) is not None:
                gain, updated = update
                after = self.number_of(updated)
                self.gains[..., number], self._gains[number] = gain, gain.ravel(order="K")
                self._by_columns[number] = not gain.flags.c_contiguous
            self.quick_tests[..., number] = self._quick_tests[number] = weight
            self._after_update[number] = after  # last: another thread may look it up, and then wants the rest too
        return after

    def update(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns the gain of an update that is worked out, (n, p), zero if the sample is not used, and W, (p, p)."""
        gain, (n, p, _) = self._gains[number], self.gains.shape
        gain = gain.reshape(p, n).T if self._by_columns[number] else gain.reshape(n, p)
        return gain, self._quick_tests[number]

    def innovation_axes(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns `common_axes` for residuals before an update of some statistics."""
        if number not in self._axes:
            self._axes[number] = common_axes(self._spread(self.shape(number)), self.recursion.sets.noise)
        return self._axes[number]

    def _spread(self, shape: np.ndarray) -> np.ndarray:
        H = self.recursion.plant.H
        return H @ shape @ H.T

    def _add(self, statistics: ErrorStatistics) -> int:
        number = self._count
        if number == len(self._ages):
            for name in _BY_NUMBER_LAST:
                setattr(self, name, with_room(getattr(self, name)))
            for name in _BY_NUMBER:  # the last one tells how much
                setattr(self, name, with_room(getattr(self, name), axis=0))
        self._covariances[number], self._shapes[number], self._ages[number], self._certified[number] = statistics
        self._after_step[number] = self._after_update[number] = UNKNOWN
        self._gains[number], self._by_columns[number] = 0.0, False
        self.gains[..., number] = 0.0
        self._count = number + 1
        return number


def with_room(array: np.ndarray, axis: int = -1) -> np.ndarray:
    """Returns an array with room for twice as many numbers along an axis."""
    return np.concatenate([array, np.zeros_like(array)], axis=axis)


# In place of the age at which a replay begins, where there are no new samples.
NO_REPLAY = -1
# Histories are forgotten but for those in use when there are this many, or when all takes about this much memory.
MAX_HISTORIES, MAX_BYTES = 1 << 17, 20 << 20
# A graph takes at least this many times the histories it began with, or it would be forgotten at every step.
SMALLEST_GROWTH = 4
# Some sample of these many steps should move an estimate by this share of its distance from the sample.
FIRST_STEPS, SMALLEST_SHARE = 50, 0.01
# Of more plants and channels than this, graphs are kept only as long as an estimator uses them.
MAX_GRAPHS = 32
# The arrays of a graph, whose last axis is the history.
_BY_HISTORY = (
    *("present", "replay_from", "target", "new_age", "accepted", "arrival", "used"),
    *("_priors", "_held", "next"),
)


class ArrivalHistories:
    """The graph of arrival histories of a plant behind a channel, filled as histories are met.

    A history is what an estimator remembers besides means, inputs and samples: the error statistics of its present
    estimate, those before the update at the step of each age, which of the samples of these steps it holds, and the age
    of the oldest one that arrived at this step and is not used yet. Arrays are UNKNOWN where nothing is worked out yet.

    Attributes:
        recursion: Moves the error statistics.
        channel: Gives the length of the replay buffer.
        buffer: Age of the oldest sample that is of use [steps].
        root: Number of the history at the start of an episode.
        table: The distinct error statistics met so far.
        is_full: Whether it is time to forget histories that are not in use (`keeping`).
        present: Statistics of the present estimate, shape (capacity,).
        replay_from: Age at which the replay of new samples begins, shape (capacity,); NO_REPLAY without any.
        next: History one step later, shape (capacity,).
        arrival: History after a sample of each age 0..buffer arrived, shape (buffer + 1, capacity).
        target: History after the replay of new samples, shape (capacity,); the same where there is nothing to replay.
        accepted: Whether that replay is kept, shape (capacity,).
        new_age: Age of the newest sample used after it, shape (capacity,); UNKNOWN where that does not change.
        used: Statistics before the update at each age, NO_SAMPLE without one, shape (buffer + 1, capacity).
    """

    def __init__(self, recursion: ErrorRecursion, channel: Channel) -> None:
        self.recursion, self.channel = recursion, channel
        self.buffer, size = channel.longest_delay, FIRST_CAPACITY
        # Ages above this make no difference: neither to a certified set nor to what the buffer holds.
        oldest = max(self.buffer + 1, recursion.error_set.oldest + 1)
        self.table = ErrorTable(recursion, oldest)
        held_ages = self.buffer + 1
        self._key = f"{held_ages + 2}q{held_ages}?"
        self._count = 0
        self._numbers: dict[bytes, int] = {}
        self._bytes_each = BYTES_PER_KEY + struct.calcsize(self._key) + 8 * (6 + 3 * held_ages) + 1 + held_ages
        self.present, self.replay_from, self.next, self.target, self.new_age = np.zeros((5, size), np.int64)
        self.arrival, self.used, self._priors = np.zeros((3, held_ages, size), np.int64)
        self._held, self.accepted = np.zeros((held_ages, size), np.bool_), np.zeros(size, np.bool_)
        self._ahead: dict[int, np.ndarray] = {}  # by number of steps, then by number of the statistics
        self._lock = threading.RLock()
        # Weak, or an estimator that never moves on from this graph would keep all that came after it.
        self._successor: weakref.ref[ArrivalHistories] | None = None
        self._adopted_count, self.is_full = 0, False
        first = self.table.number_of(recursion.first)
        self.root = self._number_of(first, (UNKNOWN,) * held_ages, (False,) * held_ages, NO_REPLAY)

    def __len__(self) -> int:
        return self._count

    def __deepcopy__(self, memo: dict[int, Any]) -> ArrivalHistories:
        return self  # shared by all estimators

    def __getstate__(self) -> dict[str, Any]:
        """Leaves out the lock, which cannot be pickled."""
        return vars(self) | {"_lock": None, "_successor": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state | {"_lock": threading.RLock()})

    def after_step(self, history: int) -> int:
        """Returns the number of the history one step later, before anything arrives."""
        after = self.next.item(history)
        if after == UNKNOWN:
            with self._lock:
                present, priors, held, _ = self._history(history)
                predicted = self.table.after_step(present)
                after = self._number_of(predicted, (predicted, *priors[:-1]), (False, *held[:-1]), NO_REPLAY)
                self.next[history] = after
        return after

    def after_arrival(self, history: int, age: int) -> int:
        """Returns the number of the history with one more sample, of some age; the same where it is of no use.

        Samples older than the buffer, from before the first step or received before are of no use, and those since
        whose step the error was not certified all the time, if it is now: a replay could take it out again.
        """
        if not 0 <= age <= self.buffer:
            return history
        after = self.arrival.item(age, history)
        if after == UNKNOWN:
            with self._lock:
                present, priors, held, replay_from = self._history(history)
                after = history
                is_new, certified = priors[age] != UNKNOWN and not held[age], self.table.is_certified
                if is_new and (not certified(present) or all(map(certified, priors[: age + 1]))):
                    held = (*held[:age], True, *held[age + 1 :])
                    after = self._number_of(present, priors, held, max(replay_from, age))
                self.arrival[age, history] = after
        return after

    def after_replay(self, history: int) -> int:
        """Returns the number of the history after the samples that arrived at this step are used, or are not."""
        target = self.target.item(history)
        if target == UNKNOWN:
            with self._lock:
                target = self._replayed(history)
        return target

    def predicted(self, statistics: int, steps: int) -> int:
        """Returns the number of what some steps without a sample make of statistics."""
        if steps:
            with self._lock:
                for _ in range(steps):
                    statistics = self.table.after_step(statistics)
        return statistics

    def predicted_many(self, statistics: np.ndarray, steps: int) -> np.ndarray:
        """Returns `predicted` for many statistics, shape (N,)."""
        if steps == 0:
            return statistics
        known = self._ahead.get(steps, np.full(0, UNKNOWN))
        if (count := len(self.table)) > len(known):
            known = self._ahead[steps] = np.concatenate([known, np.full(count, UNKNOWN)])
        ahead = known.take(statistics)
        unknown = ahead == UNKNOWN
        if unknown.any():
            for number in np.unique(statistics[unknown]).tolist():
                known[number] = self.predicted(number, steps)
            ahead = known.take(statistics)
        return ahead

    @property
    def uses_samples(self) -> bool:
        """Whether a sample of one of the first steps moves the estimate towards it, if it arrives at once."""
        number, H, table = self.present.item(self.root), self.recursion.plant.H, self.table
        with self._lock:
            for _ in range(FIRST_STEPS):
                number = table.after_step(number)
                updated = table.after_update(number)
                is_used = self.recursion.prefers(table.statistics(updated), table.statistics(number))
                if is_used and np.diagonal(H @ table.update(number)[0]).max() >= SMALLEST_SHARE:
                    return True
        return False

    def keeping(self, histories: np.ndarray) -> tuple[ArrivalHistories, np.ndarray]:
        """Returns a graph with some histories, shape (k,), only, and their numbers there."""
        with self._lock:
            successor = None if self._successor is None else self._successor()
            if successor is None or successor.is_full:
                successor = ArrivalHistories(self.recursion, self.channel)
                self._successor = weakref.ref(successor)
            with _shared_lock:
                for key, shared in _shared.items():
                    if shared is self:
                        _shared[key] = successor
        return successor, successor.taking_over(self, histories)

    def taking_over(self, other: ArrivalHistories, histories: np.ndarray) -> np.ndarray:
        """Returns the numbers here of histories, shape (k,), of a graph of the same plant with no more delays."""

        def same(number: int) -> int:
            return number if number == UNKNOWN else self.table.number_of(other.table.statistics(number))

        numbers, older = {}, self.buffer - other.buffer
        with self._lock:
            for each in np.unique(histories).tolist():
                present, priors, held, replay_from = other._history(each)
                known = (*map(same, priors), *[UNKNOWN] * older)
                numbers[each] = self._number_of(same(present), known, (*held, *[False] * older), replay_from)
            self._adopted_count, self.is_full = max(self._adopted_count, len(numbers)), False
        return np.array([numbers[each] for each in histories.tolist()], np.int64)

    def _history(self, number: int) -> tuple[int, tuple[int, ...], tuple[bool, ...], int]:
        """Returns present statistics, priors and samples held by age, and where a replay begins."""
        priors, held = self._priors[:, number].tolist(), self._held[:, number].tolist()
        return self.present.item(number), tuple(priors), tuple(held), self.replay_from.item(number)

    def _number_of(self, present: int, priors: tuple[int, ...], held: tuple[bool, ...], replay_from: int) -> int:
        """Returns the number of a history, a new one if it has not occurred."""
        key = struct.pack(self._key, present, replay_from, *priors, *held)
        number = self._numbers.get(key)
        if number is None:
            number = self._count
            if number == len(self.next):
                for name in _BY_HISTORY:  # the last one tells how much
                    setattr(self, name, with_room(getattr(self, name)))
            self.present[number], self.replay_from[number] = present, replay_from
            self._priors[:, number], self._held[:, number] = priors, held
            self.next[number] = self.arrival[:, number] = self.new_age[number] = UNKNOWN
            self.target[number] = number if replay_from == NO_REPLAY else UNKNOWN
            self.accepted[number], self.used[:, number] = False, NO_SAMPLE
            self._count = number + 1
            self._numbers[key] = number  # last: if this is interrupted, the history has not occurred
            size = self._count * self._bytes_each + len(self.table) * self.table.bytes_each
            is_large = self._count >= MAX_HISTORIES or size >= MAX_BYTES
            self.is_full = is_large and self._count >= SMALLEST_GROWTH * self._adopted_count
        return number

    def _replayed(self, history: int) -> int:
        """Works out the history from its oldest new sample on, and whether it is kept; returns its number."""
        present, priors, held, oldest = self._history(history)
        table, replayed, used, number = self.table, list(priors), [NO_SAMPLE] * (oldest + 1), present
        for age in range(oldest, -1, -1):
            number = replayed[age]
            if held[age]:
                used[age] = number
                number = table.after_update(number)
            if age > 0:
                replayed[age - 1] = table.after_step(number)
        accepted = self.recursion.prefers(table.statistics(number), table.statistics(present))
        if accepted:
            present, priors = number, tuple(replayed)
            age = table.statistics(number).age
            self.new_age[history] = age if age < table.oldest else UNKNOWN
        target = self._number_of(present, priors, held, NO_REPLAY)
        self.accepted[history], self.used[: oldest + 1, history] = accepted, used
        self.target[history] = target  # last: another thread may look it up, and then wants the rest too
        return target


_shared: dict[tuple[str, Channel, ChannelContract | None], ArrivalHistories] = {}
_shared_lock = threading.Lock()


def arrival_histories(plant: LinearPlant, channel: Channel, contract: ChannelContract | None) -> ArrivalHistories:
    """Returns the graph that all estimators of a plant behind a channel share; raises as `certified_error_set`."""
    # Only delays and quantization matter to it, not how packets are lost or when they are sent.
    kept = Channel(quantization_step=channel.quantization_step, delay=channel.delay, jitter=channel.jitter)
    key = plant.fingerprint, kept, contract
    histories = _shared.get(key)
    if histories is None:
        histories = histories_of(plant, kept, certified_error_set(plant, contract))
    with _shared_lock:
        histories = _shared[key] = _shared.pop(key, histories)
        if len(_shared) > MAX_GRAPHS:  # the one that was asked for the longest ago
            del _shared[next(iter(_shared))]
    return histories


def histories_of(plant: LinearPlant, channel: Channel, error_set: ErrorSet, **precision: Any) -> ArrivalHistories:
    """Returns a graph of its own; see `ErrorRecursion` for the precision of covariances and shapes."""
    recursion = ErrorRecursion(plant, channel.quantization_step, error_set, **precision)
    return ArrivalHistories(recursion, channel)
