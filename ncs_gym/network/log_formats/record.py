"""What a file of recorded packets says, and what readers of several formats share."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# Repeated or late numbers are few in a row, unless something began anew.
MOST_LATE = 16
# In longer records some numbers follow each other, and no more than this share goes back, where counters begin anew.
_FEW, _BACK_SHARE = 20, 0.25
# Stamps are no later than this [s].
_LATEST_STAMP = 0.1
BEFORE = "the packet arrived before it was sent: the clocks of sender and receiver differ, set one by the other"
WAY_AND_BACK = "delays are those of the whole way and back"


class Record(NamedTuple):
    """What a file says.

    Attributes:
        sent: When each packet was sent, shape (k,), ascending [s].
        delays: How long each was on its way, shape (k,); NaN for a lost one [s].
        read_as: How the file was read, in sentences.
        tells_losses: Whether it says which packets were lost; False where those without a line are not noticed.
    """

    sent: np.ndarray
    delays: np.ndarray
    read_as: str
    tells_losses: bool = True


def require_time(numbers: np.ndarray, sent: np.ndarray) -> None:
    """Raises ValueError if numbers do not count packets, or there is too little time for those that are missing.

    A packet may be sent as late as others are: by what the shortest time between two is shorter than the usual one.
    """
    steps, gaps = np.diff(numbers), np.diff(sent)
    if len(steps) >= _FEW and (not (steps == 1).any() or (steps < 0).mean() > _BACK_SHARE):
        raise ValueError("the numbers of its packets do not count them: hardly any follows that of the packet before")
    if not (steps == 1).any():
        return
    usual = gaps[steps == 1]
    late = min(2.0 * float(np.median(usual) - usual.min()), _LATEST_STAMP)
    expected = steps * np.quantile(usual, 0.05)
    hurried = np.flatnonzero((steps > 1) & (gaps < 0.9 * expected) & (gaps < expected - late))
    if len(hurried):
        raise ValueError(
            f"between the packets {numbers[hurried[0]]} and {numbers[hurried[0] + 1]} its stamps leave too little time "
            "for the lost ones: the clock was set back there, cut the record"
        )
