"""Packets that were lost and have no line in a record: missing numbers, and moments at which a regular sender sent."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ncs_gym.network.log_formats.record import require_time
from ncs_gym.reading import require_packets

# A sender is regular if so many of the times between packets, and at least so many, differ by no more than this from
# multiples of the usual one. Where more periods have no packet, it paused.
_REGULAR_SHARE, _FEWEST, _IRREGULAR, _LONGEST_ABSENCE = 0.9, 20, 0.25, 100

# By how many periods, and by what part of a time, a number of packets may differ from the time that passed.
_ROOM, _DRIFT = 1.5, 0.01


def median_gap(sent: np.ndarray) -> float:
    """Returns the usual time between two packets [s]; 0.0 where all were sent at once."""
    gaps = np.diff(sent)
    return float(np.median(gaps[gaps > 0.0])) if gaps.any() else 0.0


class Completed(NamedTuple):
    """The packets of a record with those whose numbers are missing.

    Attributes:
        sent: When each was sent, shape (k,) [s].
        delays: How long each took, shape (k,); NaN for a lost one [s].
        missing: How many numbers were missing.
        restarts: How often numbers begin anew; what was lost there is not known.
    """

    sent: np.ndarray
    delays: np.ndarray
    missing: int
    restarts: int


def with_missing(sent: np.ndarray, delays: np.ndarray, numbers: np.ndarray) -> Completed:
    """Returns the packets with those whose numbers are missing, evenly between their neighbors, and without duplicates.

    What comes twice arrived when it came first. A counter of so many bits goes on from zero. Other numbers that go back
    begin anew, and nothing is missing there.
    """
    order = np.lexsort((np.where(np.isnan(delays), np.inf, delays), numbers, sent))
    sent, delays, numbers = sent[order], delays[order], numbers[order]
    same = np.diff(numbers) == 0
    again = np.flatnonzero(same & (np.diff(sent) > 0.0))
    if len(again):
        raise ValueError(
            f"packet {numbers[again[0]]} was sent at two times, as what is sent again until it arrives: log the time "
            "at which its sample was taken"
        )
    sent, delays, numbers = (each[np.append(True, ~same)] for each in (sent, delays, numbers))
    numbers = _without_wraps(sent, numbers)
    back = np.flatnonzero((numbers[1:-1] < numbers[:-2]) & (numbers[:-2] < numbers[2:]))
    if len(back):
        raise ValueError(
            f"by its time packet {numbers[back[0] + 1]} was sent after packet {numbers[back[0]]}: a clock was set "
            "back, or numbers come twice"
        )
    require_time(numbers, sent)
    steps = np.diff(numbers)
    gaps = np.where(steps > 1, steps - 1, 0)
    require_packets(len(sent) + int(np.minimum(gaps, 10**9).sum()))
    return Completed(*_with_lost(sent, delays, gaps), int(gaps.sum()), int(np.count_nonzero(steps < 0)))


def _without_wraps(sent: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Returns the numbers of a counter of so many bits as if it had more, shape (k,).

    It went on from zero where so many packets, a multiple of the power of two above the largest number included, fit
    the time that passed; also where none of its zeros was received. Where the first number or the second follows a long
    pause, it began anew.
    """
    steps, gaps = np.diff(numbers), np.diff(sent)
    if not (steps < 0).any() or not (steps == 1).any() or not (usual := float(np.median(gaps[steps == 1]))):
        return numbers
    size, periods = 1 << int(numbers.max()).bit_length(), gaps / usual
    room = _ROOM + _DRIFT * periods
    wraps = np.maximum(np.rint((periods - steps) / size), 0.0)
    fits = (np.abs(steps + wraps * size - periods) <= room) & (np.abs(steps - periods) > room) & (room <= size / 16)
    fits &= (numbers[1:] > 1) | (periods <= _LONGEST_ABSENCE)
    if not fits[steps < 0].any():
        return numbers  # what begins anew has no size
    return numbers + size * np.cumsum(np.append(0, np.where(fits, wraps, 0.0))).astype(np.int64)


def with_absent(sent: np.ndarray, delays: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Returns the packets of a record without numbers with those that a regular sender sent and that have no line.

    A receiver's log has lines of what it received alone. Nothing is added to longer pauses, in which nothing was sent.

    Returns:
        When each was sent, and how long it took, shape (k,) each [s]; None if the sender is not regular: times between
        packets are no multiples of the usual one, or more would be added than there are, as between bursts.
    """
    usual = median_gap(sent)
    periods = np.diff(sent) / usual if usual else np.zeros(len(sent) - 1)
    whole = np.rint(periods)
    if len(whole) < _FEWEST or np.mean(np.abs(periods - whole) <= _IRREGULAR) < _REGULAR_SHARE:
        return None
    missing = np.where((whole >= 2.0) & (whole <= _LONGEST_ABSENCE), whole - 1.0, 0.0).astype(np.int64)
    if missing.sum() > len(sent):
        return None
    require_packets(len(sent) + int(missing.sum()))
    return _with_lost(sent, delays, missing)


def _with_lost(sent: np.ndarray, delays: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the packets with so many lost ones after each but the last, evenly between their neighbors."""
    before = np.repeat(np.arange(len(counts)), counts)
    place = np.arange(len(before)) - np.repeat(np.cumsum(counts) - counts, counts) + 1
    added = sent[before] + (sent[before + 1] - sent[before]) * place / (counts[before] + 1)
    sent, delays = np.append(sent, added), np.append(delays, np.full(len(added), np.nan))
    order = np.argsort(sent, kind="stable")
    return sent[order], delays[order]
