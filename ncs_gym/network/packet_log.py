"""Recorded packets: when each was sent and when it arrived, from a CSV file or the output of ping."""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np

from ncs_gym.network.channel import LONGEST_DELAY, TraceChannel
from ncs_gym.reading import LARGEST_LOG, MOST_PACKETS, MOST_STEPS, read_text
from ncs_gym.validation import ReadOnlyArrays, as_number, as_setting, shown, warn_caller

# A line of ping: the stamp that -D prints, the number of the packet, and the time until its answer.
_PING = re.compile(r"^(?:\[(?P<stamp>\d+\.\d+)\] )?.*\bicmp_seq=(?P<number>\d+)\b(?:.*\btime=(?P<time>[\d.]+) ?ms)?")
# Times that differ by less than this fraction of a step are the same.
_SAME = 1e-6


@dataclass(frozen=True, eq=False)
class PacketLog(ReadOnlyArrays):
    """Packets in the order in which they were sent.

    Attributes:
        sent: When each was sent, shape (k,), ascending [s].
        delays: How long each was on its way, shape (k,); NaN for a lost one [s].

    Raises:
        ValueError: If there are fewer than two packets or more than two million, they are not in order, or one arrived
            before it was sent.
    """

    sent: np.ndarray
    delays: np.ndarray

    def __post_init__(self) -> None:
        sent, delays = as_setting(self.sent), as_setting(self.delays)
        if sent is None or delays is None or sent.ndim != 1 or sent.shape != delays.shape or len(sent) < 2:
            raise ValueError("a log needs at least two packets, each with the time at which it was sent")
        _require_moderate(len(sent))
        if not np.isfinite(sent).all() or (np.diff(sent) <= 0.0).any():
            raise ValueError("packets must be sent one after the other, at finite times")
        if (delays < 0.0).any() or np.isinf(delays).any():
            raise ValueError(
                "a packet arrived before it was sent: the clocks of sender and receiver differ, set one by the other"
            )
        object.__setattr__(self, "sent", sent)
        object.__setattr__(self, "delays", delays)
        self._make_arrays_read_only()

    @classmethod
    def load(cls, path: str | os.PathLike[str], period: float | None = None, step: float = 1.0) -> Self:
        """Returns the packets in a file.

        A CSV file has a line per packet: when it was sent and when it was received, in seconds, the second empty for a
        lost packet. A first line of names that has "sent" and "received" among them says where they are; another one is
        skipped. With "episode" besides it is a log of `ncs loop`, whose numbers are those of steps: episodes count as
        one after the other, and steps without a packet as lost packets. Of the output of ping the delay is that of the
        whole way and back, and numbers without an answer are lost packets.

        Args:
            path: The file.
            period: Time between the packets of ping without stamps (`ping -D` prints them) [s]; 1 by default.
            step: Duration of the steps of `ncs loop` [s].

        Raises:
            ValueError: If the file cannot be read or holds neither, has more than 128 MiB, or more than two million
                packets with those that were lost (`ncs_gym.reading`).
        """
        try:
            lines = read_text(path, LARGEST_LOG).splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise ValueError(f"cannot read packets from {shown(path)}: {error}") from error
        if any("icmp_seq=" in line for line in lines):
            return cls._of_ping(lines, 1.0 if period is None else as_number(period, "period", low=0.0, low_open=True))
        names = [name.strip() for name in lines[0].split(",")] if lines else []
        named = {"sent", "received"} <= {*names}
        columns = [names.index(name) for name in ("sent", "received")] if named else [0, 1]
        if named and "episode" in names:
            dt = as_number(step, "step", low=0.0, low_open=True)
            return cls._of_steps(lines[1:], names.index("episode"), columns, path, dt)
        log = cls._of_csv(lines, columns, path)
        if log.period >= 1.0 and np.nanmedian(np.append(log.delays, -np.inf)) >= 1.0:
            warn_caller(
                f"the times in {shown(path)} look like milliseconds, but are taken for seconds: packets every "
                f"{log.period:g} s, most of which take more than a second",
                UserWarning,
            )
        return log

    @classmethod
    def _of_steps(
        cls, lines: Iterable[str], episode: int, columns: list[int], path: str | os.PathLike[str], dt: float
    ) -> Self:
        """Returns the packets of a log of `ncs loop`: the steps at which those that arrived were sent and received."""
        arrivals: dict[str, dict[int, int]] = {}
        for number, row in _rows(lines, 2, path):
            try:
                sent, received = (int(row[column]) for column in columns)
                arrived = arrivals.setdefault(row[episode], {})
            except (ValueError, IndexError):
                raise ValueError(
                    f"line {number} of {shown(path)} is not an episode, a step sent and one received"
                ) from None
            arrived[sent] = min(received, arrived.get(sent, received))  # a second one is a duplicate
        _require_moderate(sum(max(*arrived, 0) for arrived in arrivals.values()))
        delays = [
            arrived.get(step, np.nan) - step for arrived in arrivals.values() for step in range(1, max(arrived) + 1)
        ]
        return cls(dt * np.arange(len(delays)), dt * np.array(delays))

    @classmethod
    def _of_csv(cls, lines: Iterable[str], columns: list[int], path: str | os.PathLike[str]) -> Self:
        packets = []
        for number, row in _rows(lines, 1, path):
            cells = [cell.strip() for cell in row]
            if not any(cells):
                continue
            try:
                sent, received = (cells[column] if column < len(cells) else "" for column in columns)
                sent, received = float(sent), float(received) if received else np.nan
            except ValueError:
                if packets or number > 1:
                    raise ValueError(f"line {number} of {shown(path)} is not a time sent and a time received") from None
                continue  # the names of the columns
            packets.append((sent, received - sent))
        sent, delays = np.array(packets).reshape(-1, 2).T
        order = np.argsort(sent, kind="stable")
        return cls(sent[order], delays[order])

    @classmethod
    def _of_ping(cls, lines: Iterable[str], period: float) -> Self:
        answers: dict[int, float] = {}
        stamps: dict[int, float] = {}
        last, wraps = 0, 0
        for line in lines:
            if (found := _PING.match(line)) is None:
                continue
            number = int(found["number"]) + 65536 * wraps
            if number < last - 32768:  # numbers begin anew after 65535
                wraps, number = wraps + 1, number + 65536
            last = max(last, number)
            if found["time"] is not None and number not in answers:  # a second answer is a duplicate
                answers[number] = float(found["time"]) / 1000.0
                if found["stamp"] is not None:
                    stamps[number] = float(found["stamp"]) - answers[number]
            else:
                answers.setdefault(number, np.nan)
        if not answers:
            raise ValueError("no packet of ping has a number")
        _require_moderate(max(answers) - min(answers) + 1)
        numbers = np.arange(min(answers), max(answers) + 1)
        delays = np.array([answers.get(number, np.nan) for number in numbers.tolist()])
        if len(stamps) > 1:
            known = sorted(stamps)
            sent = np.interp(numbers, known, np.maximum.accumulate([stamps[each] for each in known]))
            slope = (stamps[known[-1]] - stamps[known[0]]) / (known[-1] - known[0])
            sent[numbers > known[-1]] = stamps[known[-1]] + slope * (numbers[numbers > known[-1]] - known[-1])
            sent[numbers < known[0]] = stamps[known[0]] - slope * (known[0] - numbers[numbers < known[0]])
        else:
            sent = period * numbers
        return cls(sent, delays)

    @property
    def period(self) -> float:
        """Median time between packets [s]."""
        return float(np.median(np.diff(self.sent)))

    def trace(self, dt: float) -> tuple[int, ...]:
        """Returns after how many control steps of duration dt each packet arrived, rounded up; -1 for a lost one.

        A packet that is later than a channel can delay it counts as lost.
        """
        dt = as_number(dt, "dt", low=0.0, low_open=True)
        steps = np.ceil(self.delays / dt - _SAME)
        usable = np.isfinite(steps) & (steps <= LONGEST_DELAY)
        return tuple(np.where(usable, steps, -1.0).astype(int).tolist())

    def send_period(self, dt: float) -> int:
        """Returns the number of control steps between packets, at least one.

        Raises:
            ValueError: If there are more than ten million.
        """
        steps = self.period / as_number(dt, "dt", low=0.0, low_open=True)
        if not steps <= MOST_STEPS:
            raise ValueError(f"packets are {steps:,.3g} control steps of {dt:g} s apart, more than {MOST_STEPS:,}")
        return max(round(steps), 1)

    def channel(self, dt: float, *, quantization_step: float = 0.0) -> TraceChannel:
        """Returns the channel that replays the log in control steps of duration dt [s]."""
        return TraceChannel(trace=self.trace(dt), send_period=self.send_period(dt), quantization_step=quantization_step)

    def ages(self, dt: float) -> np.ndarray:
        """Returns the age of the newest sample at every step, shape (steps,), from the first arrival on [steps].

        Sample i is taken at step i times `send_period`.

        Raises:
            ValueError: If these are more than ten million steps.
        """
        period = self.send_period(dt)
        steps = len(self.sent) * period
        if steps > MOST_STEPS:
            raise ValueError(f"the record spans {steps:,} control steps of {dt:g} s, more than {MOST_STEPS:,}")
        trace = np.array(self.trace(dt))
        newest = np.full(steps, -1)
        for i in np.flatnonzero(trace >= 0).tolist():
            if (arrival := i * period + trace[i]) < steps:
                newest[arrival] = max(newest[arrival], i * period)
        newest = np.maximum.accumulate(newest)
        return (np.arange(steps) - newest)[newest >= 0]


def _require_moderate(packets: int) -> None:
    if packets > MOST_PACKETS:
        raise ValueError(f"a log has at most {MOST_PACKETS:,} packets, with those that were lost; this one {packets:,}")


def _rows(lines: Iterable[str], first: int, path: str | os.PathLike[str]) -> Iterator[tuple[int, list[str]]]:
    """Yields the rows of a CSV file with their numbers; raises ValueError for what is no such file."""
    try:
        yield from enumerate(csv.reader(lines), first)
    except csv.Error as error:
        raise ValueError(f"{shown(path)} is no CSV file: {error}") from error
