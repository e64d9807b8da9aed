"""A pattern of arrivals, what becomes of its late samples, and the arrays of a graph of patterns."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ncs_gym.estimation.error_statistics_table import UNKNOWN
from ncs_gym.network.channel import Channel

# Entries that arrays begin with; they double when they are full.
_FIRST_CAPACITY = 256
# A pattern without a history to replay.
NO_REPLAY = UNKNOWN


class Pattern(NamedTuple):
    """What an estimator remembers besides means, inputs and samples.

    Attributes:
        present: Number of the statistics of the present estimate.
        priors: Numbers of the statistics before the update at the step of each age 0..buffer; UNKNOWN before the first
            step of the episode.
        held: For each age, whether the sample taken then has arrived.
        replay_from: Age of the oldest sample that arrived at this step and is not used yet, or NO_REPLAY.
    """

    present: int
    priors: tuple[int, ...]
    held: tuple[bool, ...]
    replay_from: int


class Replay(NamedTuple):
    """What becomes of the arrivals of a pattern: the history from its oldest new sample on, once more.

    Attributes:
        oldest: Age at which the replay begins.
        used: For each age 0..oldest, the number of the statistics before the update there; NO_SAMPLE without one.
        accepted: Whether the replayed history is kept.
        new_age: Age of the newest sample used afterwards; UNKNOWN where it is the same as before.
        target: Number of the pattern afterwards.
    """

    oldest: int
    used: tuple[int, ...]
    accepted: bool
    new_age: int
    target: int


class PatternArrays:
    """What `ArrivalPatterns` knows, as arrays by pattern; UNKNOWN until it is worked out.

    Args:
        channel: Gives the ages at which packets arrive.

    Attributes:
        next: Pattern one step later, shape (patterns,).
        arrival: Pattern after a sample of age delay + i arrived, shape (jitter + 1, patterns).
        target: Pattern after the replay of new samples, shape (patterns,); the same where there is nothing to replay.
        accepted: Whether that replay is kept, shape (patterns,).
        replay_from: Age at which it begins, shape (patterns,); UNKNOWN where there is nothing to replay.
        new_age: Age of the newest sample used after it, shape (patterns,); UNKNOWN where that does not change.
        used: Statistics before the update at each age, zero where no sample is used, shape (buffer + 1, patterns).
        present: Statistics of the present estimate, shape (patterns,).
    """

    def __init__(self, channel: Channel) -> None:
        self._first_age, self._columns = channel.delay, channel.jitter + 1
        self.next, self.target, self.replay_from, self.new_age = (_unknown(_FIRST_CAPACITY) for _ in range(4))
        self.arrival = _unknown(self._columns, _FIRST_CAPACITY)
        self.accepted = np.zeros(_FIRST_CAPACITY, np.bool_)
        self.used = np.zeros((channel.longest_delay + 1, _FIRST_CAPACITY), np.int64)
        self.present = np.zeros(_FIRST_CAPACITY, np.int64)

    def row(self, table: str, index: int | None) -> np.ndarray:
        """Returns one of the arrays above, or a row of it."""
        array = getattr(self, table)
        return array if index is None else array[index]

    def add_pattern(self, number: int, present: int, *, replays: bool) -> None:
        """Adds a pattern by its number, with some statistics; whether there is something to replay."""
        if number == len(self.next):
            for name in ("accepted", "used", "present"):
                old = getattr(self, name)
                setattr(self, name, np.concatenate([old, np.zeros_like(old)], axis=-1))
            for name in ("target", "replay_from", "new_age", "arrival", "next"):  # "next" last: it tells the capacity
                old = getattr(self, name)
                setattr(self, name, np.concatenate([old, np.full_like(old, UNKNOWN)], axis=-1))
        self.present[number] = present
        self.target[number] = UNKNOWN if replays else number

    def set_arrival(self, pattern: int, age: int, after: int) -> None:
        """Notes the pattern after a sample of some age arrived; other ages than the channel's are left out."""
        if 0 <= age - self._first_age < self._columns:
            self.arrival[age - self._first_age, pattern] = after

    def set_replay(self, pattern: int, replay: Replay) -> None:
        """Notes what becomes of the new samples of a pattern."""
        self.accepted[pattern], self.new_age[pattern] = replay.accepted, replay.new_age
        self.replay_from[pattern] = replay.oldest
        self.used[: replay.oldest + 1, pattern] = replay.used
        self.target[pattern] = replay.target  # last: another thread may look it up, and then wants the rest too


def _unknown(*shape: int) -> np.ndarray:
    return np.full(shape, UNKNOWN, np.int64)
