"""A record of packets: when each was sent and when it arrived, and how old a control loop's samples become by that."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Self

import numpy as np

from ncs_gym.network.channel import LONGEST_DELAY, TraceChannel, replayed_ages
from ncs_gym.network.log_files import read_record
from ncs_gym.reading import MOST_STEPS, require_packets
from ncs_gym.validation import ReadOnlyArrays, as_number, as_setting

# Times that differ by less than this fraction of a step are the same; where the resolution of the times themselves is
# coarser than the second fraction they cannot be placed.
_SAME, _COARSE = 1e-6, 1e-2
# A pause is longer than so many usual periods; span and number disagree by more than this fraction.
_PAUSE, _DISAGREE = 1.5, 0.01


@dataclass(frozen=True, eq=False)
class PacketLog(ReadOnlyArrays):
    """A list of times, in the order of sending: when each packet was sent and how long it was on its way.

    A control loop of step dt is laid over the record by its clock: step k is k dt after the first packet.

    - The sample of step k is the *first* packet that is sent from step k until before step k + 1; others within the
      step are left out, whether the first one arrived or not.
    - A sample that is sent between two steps counts as taken at the earlier one, and one that arrives between two steps
      is there at the later one: it never looks fresher than it was.
    - At a step without a packet nothing is sent, which is the same as a lost sample.
    - A sample that takes longer than 1000 steps counts as lost.

    A packet that is not in the record cannot be seen. In a log of the receiver, which has none that was lost, ages may
    be too small: at both ends, and where several packets are sent per step.

    Attributes:
        sent: When each was sent, shape (k,), ascending [s].
        delays: How long each was on its way, shape (k,); NaN for a lost one [s].
        read_as: How a file was read, in a sentence; empty for a log that was not read from a file.

    Raises:
        ValueError: If there are fewer than two packets or more than two million, they are not in order or all sent at
            once, or one arrived before it was sent.
    """

    sent: np.ndarray
    delays: np.ndarray
    read_as: str = ""

    def __post_init__(self) -> None:
        sent, delays = as_setting(self.sent), as_setting(self.delays)
        if sent is None or delays is None or sent.ndim != 1 or sent.shape != delays.shape or len(sent) < 2:
            raise ValueError("a log needs at least two packets, each with the time at which it was sent")
        require_packets(len(sent))
        if not np.isfinite(sent).all() or (np.diff(sent) < 0.0).any() or sent[0] == sent[-1]:
            raise ValueError("packets must be sent one after the other, at finite times")
        if (delays < 0.0).any() or np.isinf(delays).any():
            raise ValueError(
                "a packet arrived before it was sent: the clocks of sender and receiver differ, set one by the other"
            )
        object.__setattr__(self, "sent", sent)
        object.__setattr__(self, "delays", delays)
        self._make_arrays_read_only()

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Returns the packets in a file (docs/contracts.md has recipes that make one of other records).

        Args:
            path: A table (CSV; Parquet where pyarrow is installed) with the columns sent and received alone, in
                seconds and in the order of sending, received empty where a packet was lost; or the output of Linux
                `ping -D`.

        Raises:
            ValueError: If the file cannot be read, is neither, has more than 256 MiB, or more than two million packets
                with those that were lost.
        """
        return cls(*read_record(path))

    @property
    def period(self) -> float:
        """Median time between packets that are not sent at once [s]."""
        gaps = np.diff(self.sent)
        return float(np.median(gaps[gaps > 0.0]))

    @property
    def disagreement(self) -> str:
        """A sentence where the span of the record and its number of packets disagree; empty where they do not."""
        gaps, period = np.diff(self.sent), self.period
        span, packets = self.sent[-1] - self.sent[0], len(self.sent)
        expected = span / period + 1.0
        if abs(packets / expected - 1.0) <= _DISAGREE:
            return ""
        pauses = gaps[gaps > _PAUSE * period]
        sentence = (
            f"Span and number of packets disagree: a packet every {1000.0 * period:.4g} ms for {span:.4g} s would be "
            f"{expected:,.0f} packets, the record has {packets:,}"
        )
        if not len(pauses):
            return f"{sentence}."
        many = "in one pause" if len(pauses) == 1 else f"in {len(pauses):,} pauses"
        return (
            f"{sentence}. There is no packet {many}, {pauses.max():.4g} s at the longest: for a loop it is as if "
            "samples were lost there."
        )

    def trace(self, dt: float) -> tuple[int, ...]:
        """Returns after how many control steps of duration dt the sample of each `send_period` arrived, -1 if never."""
        return tuple(self._trace(dt).tolist())

    def send_period(self, dt: float) -> int:
        """Returns the largest number of control steps of which all samples are taken at multiples."""
        return max(int(np.gcd.reduce(self._samples(dt)[0])), 1)

    def channel(self, dt: float, *, quantization_step: float = 0.0) -> TraceChannel:
        """Returns the channel that replays the record in control steps of duration dt [s], with the ages of `ages`.

        Raises:
            ValueError: If the record spans more than ten million steps, or the trace has more than two million entries.
        """
        return TraceChannel(
            trace=self.trace(dt), send_period=self.send_period(dt), quantization_step=quantization_step, dt=dt
        )

    def ages(self, dt: float) -> np.ndarray:
        """Returns the age of the newest sample that has arrived at every control step, shape (steps,) [steps].

        That is the time since it was sent, rounded up to steps; the first estimate counts as a sample of step 0.

        Raises:
            ValueError: If the record spans more than ten million steps.
        """
        stamps, _ = self._samples(dt)
        return replayed_ages(self._trace(dt), self.send_period(dt), int(stamps[-1]) + 1)

    def left_out(self, dt: float) -> int:
        """Returns how many packets are sent within a step that has one already, so that they are no samples."""
        return len(self.sent) - len(self._samples(dt)[0])

    def _samples(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Returns the steps with a sample, and after how many steps each arrives, -1 if never; shape (steps,) each."""
        dt = as_number(dt, "dt", low=0.0, low_open=True)
        since = self.sent - self.sent[0]
        if not since[-1] / dt < MOST_STEPS:
            raise ValueError(
                f"the record spans {since[-1] / dt:,.3g} control steps of {dt:g} s, more than {MOST_STEPS:,}: take a "
                "longer step or a part of the record, and write its times in seconds"
            )
        same = _SAME + 4.0 * np.spacing(np.abs(self.sent).max()) / dt
        if same > _COARSE:
            raise ValueError(f"the times of the record are too large to place packets in control steps of {dt:g} s")
        steps = np.floor(since / dt + same)
        stamps, first = np.unique(steps.astype(np.int64), return_index=True)
        delays = np.maximum(np.ceil((since + self.delays)[first] / dt - same) - stamps, 0.0)
        return stamps, np.where(delays <= LONGEST_DELAY, delays, -1.0).astype(np.int64)

    def _trace(self, dt: float) -> np.ndarray:
        stamps, delays = self._samples(dt)
        period = self.send_period(dt)
        trace = np.full(stamps[-1] // period + 1, -1)
        trace[stamps // period] = delays
        return trace
