"""Arrival histories: everything of an estimator but its means, worked out once for whatever arrived when.

Covariances, gains, error shapes and the choice between two replays depend only on when packets arrive. Histories form a
graph: its nodes are what arrived when, as far as it still matters, its edges are steps in time and arrivals. Error
statistics are kept by number beside it (`error_table`).
"""

from __future__ import annotations

import struct
import threading
import weakref
from typing import Any

import numpy as np

from ncs_gym.estimation.error_bound import certified_error_set
from ncs_gym.estimation.error_sets import ErrorSet
from ncs_gym.estimation.error_table import BYTES_PER_KEY, FIRST_CAPACITY, NO_SAMPLE, UNKNOWN, ErrorTable, with_room
from ncs_gym.estimation.kalman_filter import ErrorRecursion
from ncs_gym.network.channel import Channel
from ncs_gym.network.contract import ChannelContract
from ncs_gym.plants.linear_plant import LinearPlant

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
