"""Arrival patterns: everything of an estimator but its means, computed once for whatever arrived when.

Covariances, gains, error shapes and the choice of a history depend only on when packets arrive, never on what they say.
Patterns form a graph: its nodes are patterns, its edges are steps in time and arrivals. The scalar estimator follows it
one node at a time, the vectorized one for all environments at once.
"""

from __future__ import annotations

import threading
import weakref
from typing import Any

import numpy as np

from ncs_gym.estimation.error_bound import ErrorSet, certified_error_set
from ncs_gym.estimation.error_statistics_table import NO_SAMPLE, UNKNOWN, NumberedUpdate, StatisticsTable
from ncs_gym.estimation.kalman_filter import ErrorRecursion, ErrorStatistics
from ncs_gym.estimation.pattern_arrays import NO_REPLAY, Pattern, PatternArrays, Replay
from ncs_gym.network.channel import Channel
from ncs_gym.network.contract import ChannelContract
from ncs_gym.plants.linear_plant import LinearPlant

# Patterns are forgotten but for those in use when there are this many, or when they and their statistics take about
# this much memory, in numbers of 8 bytes.
MAX_PATTERNS, MAX_NUMBERS = 1 << 17, 1 << 25
# A graph takes at least this many times the patterns it began with, or it would be forgotten at every step.
SMALLEST_GROWTH = 4
# Some sample of these many steps should move an estimate by this share of its distance from the sample.
FIRST_STEPS, SMALLEST_SHARE = 50, 0.01
# Of more plants and channels than this, graphs are kept only as long as an estimator uses them.
MAX_GRAPHS = 32


class ArrivalPatterns:
    """The graph of arrival patterns of a plant behind a channel, filled as patterns are met.

    Statistics are rounded by the recursion, so that they recur; patterns with equal statistics are one.

    Args:
        recursion: Moves the error statistics.
        channel: Gives the ages at which packets can arrive, and the length of the replay buffer.

    Attributes:
        root: Number of the pattern at the start of an episode.
        table: The distinct error statistics met so far.
        arrays: What vectorized environments look up by pattern.
        is_full: Whether it is time to forget patterns that are not in use (`keeping`).
    """

    def __init__(self, recursion: ErrorRecursion, channel: Channel) -> None:
        self.recursion, self.channel = recursion, channel
        self.buffer, ages = channel.longest_delay, recursion.error_set.ages
        # Ages above this make no difference: neither to a certified set nor to what the buffer holds.
        oldest = max(self.buffer + 1, 0 if ages is None else len(ages.shapes))
        self.table, self.arrays = StatisticsTable(recursion, oldest), PatternArrays(channel)
        self._patterns: list[Pattern] = []
        self._pattern_numbers: dict[Pattern, int] = {}
        self._next: list[int] = []
        self._arrivals: dict[tuple[int, int], int] = {}
        self._replays: dict[int, Replay] = {}
        self._ahead: dict[int, np.ndarray] = {}  # by number of steps, then by number of the statistics
        self._lock = threading.RLock()
        # Weak, or an estimator that never moves on from this graph would keep all that came after it.
        self._successor: weakref.ref[ArrivalPatterns] | None = None
        self._adopted_count, self.is_full = 0, False
        # What a pattern and what statistics take, in numbers of 8 bytes.
        n, p = recursion.plant.n, recursion.plant.p
        self._sizes = 80 + 5 * (self.buffer + 1), 150 + 6 * n**2 + 4 * n * p
        ages_held = self.buffer + 1
        first = self.table.number_of(recursion.first)
        self.root = self._number_of_pattern(Pattern(first, (UNKNOWN,) * ages_held, (False,) * ages_held, NO_REPLAY))

    def __len__(self) -> int:
        return len(self._patterns)

    def __deepcopy__(self, memo: dict[int, Any]) -> ArrivalPatterns:
        return self  # shared by all estimators; nothing in it belongs to one of them

    def __getstate__(self) -> dict[str, Any]:
        """Leaves out the lock, which cannot be pickled."""
        return vars(self) | {"_lock": None, "_successor": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state | {"_lock": threading.RLock()})

    def error_statistics(self, pattern: int) -> ErrorStatistics:
        """Returns the statistics of the present estimate."""
        return self.table.statistics[self._patterns[pattern].present]

    def after_step(self, pattern: int) -> int:
        """Returns the number of the pattern one step later, before anything arrives."""
        if self._next[pattern] == UNKNOWN:
            with self._lock:
                present, priors, held, _ = self._patterns[pattern]
                moved = self.table.predicted(present)
                after = self._number_of_pattern(Pattern(moved, (moved, *priors[:-1]), (False, *held[:-1]), NO_REPLAY))
                self.arrays.next[pattern] = self._next[pattern] = after
        return self._next[pattern]

    def after_arrival(self, pattern: int, age: int) -> int:
        """Returns the number of the pattern with one more sample, of some age; the same where it is of no use.

        Samples older than the buffer, from before the first step or received before are of no use.
        """
        after = self._arrivals.get((pattern, age))
        if after is None:
            with self._lock:
                present, priors, held, replay_from = self._patterns[pattern]
                after = pattern
                if 0 <= age <= self.buffer and priors[age] != UNKNOWN and not held[age]:
                    held = (*held[:age], True, *held[age + 1 :])
                    after = self._number_of_pattern(Pattern(present, priors, held, max(replay_from, age)))
                if 0 <= age <= self.buffer:
                    self.arrays.set_arrival(pattern, age, after)
                    self._arrivals[pattern, age] = after
        return after

    def replay(self, pattern: int) -> Replay:
        """Returns what becomes of the samples that arrived at this step."""
        if pattern not in self._replays:
            with self._lock:
                replay = self._replayed(self._patterns[pattern])
                self.arrays.set_replay(pattern, replay)
                self._replays[pattern] = replay
        return self._replays[pattern]

    def update(self, statistics: int) -> NumberedUpdate:
        """Returns what an update makes of some statistics, by their number."""
        found = self.table.known_update(statistics)
        if found is None:
            with self._lock:
                found = self.table.update(statistics)
        return found

    def predicted(self, statistics: int, steps: int) -> int:
        """Returns the number of what some steps without a sample make of statistics, by their number."""
        with self._lock:
            for _ in range(steps):
                statistics = self.table.predicted(statistics)
        return statistics

    def predicted_many(self, statistics: np.ndarray, steps: int) -> np.ndarray:
        """Returns what `predicted` does for many statistics, given and returned by their numbers, shape (N,)."""
        if steps == 0:
            return statistics
        known = self._ahead.get(steps, np.full(0, UNKNOWN))
        if (count := len(self.table.statistics)) > len(known):
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
        number, H = self.statistics_of(self.root), self.recursion.plant.H
        for _ in range(FIRST_STEPS):
            number = self.predicted(number, 1)
            if np.diagonal(H @ self.update(number).gain).max() >= SMALLEST_SHARE:
                return True
        return False

    def statistics_of(self, pattern: int) -> int:
        """Returns the number of the statistics of the present estimate."""
        return self._patterns[pattern].present

    def keeping(self, patterns: np.ndarray) -> tuple[ArrivalPatterns, np.ndarray]:
        """Returns a graph with some patterns, shape (k,), only, and their numbers there."""
        with self._lock:
            successor = None if self._successor is None else self._successor()
            if successor is None or successor.is_full:
                successor = ArrivalPatterns(self.recursion, self.channel)
                successor._lock = self._lock  # the recursion, which belongs to both, has a filter that moves
                self._successor = weakref.ref(successor)
            for key, shared in list(_shared.items()):
                if shared is self:
                    _shared[key] = successor
            numbers = successor._adopted(self, np.unique(patterns).tolist())
        return successor, np.array([numbers[each] for each in patterns.tolist()], np.int64)

    def taking_over(self, other: ArrivalPatterns, patterns: np.ndarray) -> np.ndarray:
        """Returns the numbers here of patterns, shape (k,), of a graph with fewer delays of the same plant."""
        with self._lock:
            numbers = self._adopted(other, np.unique(patterns).tolist())
        return np.array([numbers[each] for each in patterns.tolist()], np.int64)

    def _adopted(self, other: ArrivalPatterns, patterns: list[int]) -> dict[int, int]:
        """Returns the numbers of another graph's patterns."""
        older = self.buffer - other.buffer

        def same(number: int) -> int:
            return number if number == UNKNOWN else self.table.number_of(other.table.statistics[number])

        numbers = {}
        for each in patterns:
            present, priors, held, replay_from = other._patterns[each]
            known = (*map(same, priors), *[UNKNOWN] * older)
            adopted = Pattern(same(present), known, (*held, *[False] * older), replay_from)
            numbers[each] = self._number_of_pattern(adopted)
        self._adopted_count, self.is_full = max(self._adopted_count, len(patterns)), False
        return numbers

    def _number_of_pattern(self, pattern: Pattern) -> int:
        """Returns the number of a pattern, a new one if it has not occurred."""
        if pattern not in self._pattern_numbers:
            count = len(self._patterns) + 1
            self.arrays.add_pattern(count - 1, pattern.present, replays=pattern.replay_from != NO_REPLAY)
            self._next.append(UNKNOWN)
            self._patterns.append(pattern)
            self._pattern_numbers[pattern] = count - 1  # last: if it is interrupted, the pattern has not occurred
            numbers = self._sizes[0] * count + self._sizes[1] * len(self.table.statistics)
            is_large = count >= MAX_PATTERNS or numbers >= MAX_NUMBERS
            self.is_full = is_large and count >= SMALLEST_GROWTH * self._adopted_count
        return self._pattern_numbers[pattern]

    def _replayed(self, pattern: Pattern) -> Replay:
        """Returns the history from the oldest new sample on, and whether it is kept."""
        present, priors, held, oldest = pattern
        replayed, used, number = list(priors), [NO_SAMPLE] * (oldest + 1), priors[oldest]
        for age in range(oldest, -1, -1):
            number = replayed[age]
            if held[age]:
                used[age] = number
                number = self.table.update(number).after
            if age > 0:
                replayed[age - 1] = self.table.predicted(number)
        accepted = self.recursion.prefers(self.table.statistics[number], self.table.statistics[present])
        age = self.table.statistics[number].age
        new_age = age if accepted and self.table.age_matters(age) else UNKNOWN
        if accepted:
            present, priors = number, tuple(replayed)
        target = self._number_of_pattern(Pattern(present, priors, held, NO_REPLAY))
        return Replay(oldest, tuple(used), accepted, new_age, target)


_shared: dict[tuple[str, Channel, ChannelContract | None], ArrivalPatterns] = {}


def arrival_patterns(plant: LinearPlant, channel: Channel, contract: ChannelContract | None) -> ArrivalPatterns:
    """Returns the graph that all estimators of a plant behind a channel share in this process.

    Raises:
        UnstablePlantError: If the plant is not Schur stable and there is no contract.
        ErrorSetError: If no error set is found.
    """
    # Only delays and quantization matter to it, not how packets are lost or when they are sent.
    kept = Channel(quantization_step=channel.quantization_step, delay=channel.delay, jitter=channel.jitter)
    key = plant.fingerprint, kept, contract
    patterns = _shared.pop(key, None)
    if patterns is None:
        patterns = patterns_of(plant, kept, certified_error_set(plant, contract))
    _shared[key] = patterns
    if len(_shared) > MAX_GRAPHS:  # the one that was asked for the longest ago
        _shared.pop(next(iter(_shared)), None)
    return patterns


def patterns_of(plant: LinearPlant, channel: Channel, error_set: ErrorSet, **precision: Any) -> ArrivalPatterns:
    """Returns a graph of its own; see `ErrorRecursion` for the precision of covariances and shapes."""
    return ArrivalPatterns(ErrorRecursion(plant, channel.quantization_step, error_set, **precision), channel)
