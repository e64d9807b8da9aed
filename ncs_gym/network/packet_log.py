"""A record of packets: the files that it is read from, and how old a control loop's samples become by it."""

from __future__ import annotations

import csv
import io
import os
import re
from array import array
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from ncs_gym.network.channel import LONGEST_DELAY, TraceChannel, replayed_ages
from ncs_gym.reading import LARGEST_LOG, MOST_STEPS, read_file, require_packets
from ncs_gym.validation import ReadOnlyArrays, as_number, as_setting, reason_of, shown

_FORMS = (
    "a record is a table with the columns sent and received alone, in seconds, received empty where a packet was lost, "
    "or the output of Linux ping -D (recipes for others are in the documentation under "
    '"Contracts and recorded networks")'
)
_NAMES = ["received", "sent"]
_NUMBER = re.compile(r"[+-]?\d{1,20}(?:\.\d{0,20})?(?:[eE][+-]?\d{1,3})?")
# No time in seconds is larger, since 1970 or any other year that clocks count from.
_LATEST_TIME = 1e10

_ADDRESS = r"(?P<address>[0-9A-Fa-f.:]+(?:%[^\s()]+)?)"
_HEADER = re.compile(
    rf"PING \S+ ?\((?:\S+ \()?{_ADDRESS}\)+ (?:from \S+ \S*: )?(?:\d+\(\d+\) bytes of data\.|\d+ data bytes)"
)
_STAMP = re.compile(r"\[(\d{1,10})\.(\d{6})\] ")
_REPLY = re.compile(
    rf"\d+ bytes from (?:\S+ \()?{_ADDRESS}\)?: icmp_seq=(?P<number>\d{{1,5}}) ttl=\d+ "
    r"time=(?P<time>\d{1,8}(?:\.\d{1,3})?) ms(?P<again> \(DUP!\))?"
)
# Lines of packets that were not answered, or not yet: what counts is that a number has no reply.
_UNANSWERED = re.compile(
    r"no answer yet for icmp_seq=\d{1,5}|From \S+(?: \(\S+\))?:? icmp_seq=\d{1,5} .+|ping: sendmsg: .+"
)
_STATISTICS = re.compile(
    r"\S+ ping statistics ---\n(\d{1,12}) packets transmitted, (\d{1,12}) received(?:, \+\d+ duplicates)?"
    r"(?:, \+\d+ errors)?, \S+% packet loss, time \d+ms\n(?:rtt min/avg/max/mdev = \S+ ms)?(?:, pipe \d+)?"
    r"(?:, ipg/ewma \S+ ms)?\n*"
)
# Numbers of ping begin anew after 16 bits.
_NUMBERS = 65536
# Stamps are no later than this [us].
_LATEST_STAMP = 1e5


def table_rows(content: bytes, chosen: Callable[[list[str]], list[str]], forms: str) -> Iterable[tuple[float, ...]]:
    """Returns the numbers of some columns of a table, CSV or Parquet, by rows; NaN for an empty cell.

    Args:
        content: Of the file.
        chosen: Returns the columns that are read, given the names of all; raises ValueError if they are not there.
        forms: What tables may be like, for messages.

    Raises:
        ValueError: If it is no such table, as the rows are read.
        UnicodeDecodeError: If it is no text in UTF-8.
    """
    if content.startswith(b"PAR1"):
        return _parquet_rows(content, chosen, forms)
    return _csv_rows(io.TextIOWrapper(io.BytesIO(content), "utf-8-sig", newline=""), chosen, forms)


def _csv_rows(file: io.TextIOBase, chosen: Callable[[list[str]], list[str]], forms: str) -> Iterable[tuple[float, ...]]:
    rows = csv.reader(file, strict=True)
    try:
        names = next(rows, [])
        columns = [names.index(each) for each in chosen(names)]
        for cells in rows:
            if len(cells) != len(names):
                raise ValueError(f"line {rows.line_num} has not {len(names)} cells; {forms}")
            for cell in (cells[each] for each in columns):
                if cell and not _NUMBER.fullmatch(cell):
                    raise ValueError(f"line {rows.line_num}: {shown(cell)} is no number; {forms}")
            yield tuple(float(cells[each] or "nan") for each in columns)
    except csv.Error as error:
        raise ValueError(f"line {rows.line_num} is not of a CSV file ({reason_of(error)}); {forms}") from error


def _parquet_rows(content: bytes, chosen: Callable[[list[str]], list[str]], forms: str) -> Iterable[tuple[float, ...]]:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ModuleNotFoundError:
        raise ValueError("a Parquet table is read with pyarrow: install it, or write the table as CSV") from None
    try:
        file = pq.ParquetFile(io.BytesIO(content))
        names = chosen(file.schema_arrow.names)
        require_packets(file.metadata.num_rows)
        if any(file.schema_arrow.field(name).type not in (pa.float64(), pa.int64()) for name in names):
            raise ValueError(f"its columns are not numbers of 64 bits; {forms}")
        columns: Any = file.read(columns=names)
        found = [columns[name].cast(pa.float64()).fill_null(float("nan")).to_numpy() for name in names]
    except (pa.ArrowException, OSError) as error:
        raise ValueError(f"it is no Parquet table ({reason_of(error)}); {forms}") from error
    return zip(*(each.tolist() for each in found), strict=True)


def _chosen(names: list[str]) -> list[str]:
    """Returns sent and received; raises ValueError unless a table has both columns and no other."""
    if sorted(names) != _NAMES:
        raise ValueError(f"its first line or its columns are {shown(names)}; {_FORMS}")
    return ["sent", "received"]


def _of_table(rows: Iterable[tuple[float, ...]]) -> tuple[np.ndarray, np.ndarray, str]:
    """Returns times of sending, delays and how it was read, of a table, whose rows are in the order of sending.

    A packet without a row is not seen, as in a log of the receiver, which has none of what was lost.
    """
    numbers = array("d")
    for count, times in enumerate(rows, 1):
        require_packets(count)
        numbers.extend(times)
    sent, received = np.reshape(np.array(numbers), (-1, 2)).T
    return sent, received - sent, "Read as a table: 'sent' in s, 'received' in s."


def _of_ping(text: str) -> tuple[np.ndarray, np.ndarray, str]:
    """Returns the packets of one run of Linux `ping -D` to one host, of which every line is known.

    A packet was sent so long before the stamp of its answer as ping says that the answer took. Stamps that are printed
    late make samples fresher than they were: no packet counts as sent after a later one, and the answer came when it
    was printed. A number without an answer is a lost packet, sent between its neighbors, up to the number of packets
    in the statistics. A second answer to a packet (DUP!) changes nothing.
    """
    body, _, end = text.partition("\n--- ")
    statistics = _STATISTICS.fullmatch(end)
    if statistics is None:
        raise ValueError(
            "the output of ping -D ends with the statistics of one run in English, which say how many packets were "
            f"sent after the last answer: stop it by Ctrl-C or -w; {_FORMS}"
        )
    transmitted, received = map(int, statistics.groups())
    require_packets(transmitted)
    lines = io.StringIO(body.removesuffix("^C").rstrip("\n"))
    header = _HEADER.fullmatch(next(lines).rstrip("\n"))
    if header is None:
        raise ValueError(f"line 1 is not what Linux ping begins with; {_FORMS}")
    answers, last = [], 0
    for count, line in enumerate(lines, 2):
        stamp = _STAMP.match(line)
        rest = line[stamp.end() if stamp else 0 :].rstrip("\n")
        reply = _REPLY.fullmatch(rest) if stamp else None
        if reply is None and not _UNANSWERED.fullmatch(rest):
            raise ValueError(f"line {count} is none of Linux ping -D in English, {shown(line.rstrip())}; {_FORMS}")
        if reply is not None and reply["address"] != header["address"]:
            raise ValueError(f"line {count} is an answer of another host, {shown(reply['address'])}; {_FORMS}")
        if stamp:
            now = int(stamp[1]) * 1_000_000 + int(stamp[2])
            if now < last:
                raise ValueError(f"line {count}: the clock was set back by {last - now} us: record anew")
            last = now
            if reply is not None and not reply["again"]:
                answers.append((int(reply["number"]), now - round(1000 * float(reply["time"])), now))
    if len(answers) < 2:
        raise ValueError(f"a log needs at least two packets that were answered; {_FORMS}")
    number, sent, arrived = np.array(answers).T
    number, sent, arrived = _in_order(number, sent - sent.min(), arrived - sent.min())
    if number[0] < 1 or number[-1] > transmitted or len(number) != received:
        raise ValueError(
            f"its statistics have {transmitted:,} packets and {received:,} answers, its lines {number[-1]:,} and "
            f"{len(number):,}: lines are missing or of another run; {_FORMS}"
        )
    # None was sent after a later one.
    sent = np.minimum.accumulate(sent[::-1])[::-1]
    usual = _usual_gap(number, sent)
    # What was not answered lies evenly between the neighbors, at both ends at the usual distance.
    known = np.array([0, *number, transmitted + 1])
    times = np.array([sent[0] - usual * number[0], *sent, sent[-1] + usual * (transmitted + 1 - number[-1])])
    moments = np.interp(np.arange(1, transmitted + 1), known, times)
    delays = np.full(transmitted, np.nan)
    delays[number - 1] = arrived - sent
    read_as = "Read as the output of ping -D: delays are those of the whole way and back."
    return moments / 1e6, delays / 1e6, read_as


def _in_order(number: np.ndarray, sent: np.ndarray, arrived: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns answers in the order of their numbers, which go on where those of ping begin anew, shape (k,) each.

    The time between two answers tells how often numbers began anew in between.

    Raises:
        ValueError: If that is not certain, or two answers have the same number.
    """
    order = np.argsort(sent, kind="stable")
    number, sent, arrived = number[order], sent[order], arrived[order]
    steps, gaps = np.diff(number), np.diff(sent)
    usual = float(np.median(gaps / ((steps - 1) % _NUMBERS + 1)))
    if not usual > 0.0:
        raise ValueError("its packets were not sent one after the other: record with an interval, as in -i 0.01")
    steps = steps + _NUMBERS * np.rint((gaps / usual - steps) / _NUMBERS).astype(np.int64)
    number = (number[0] or _NUMBERS) + np.append(0, np.cumsum(steps))
    order = np.argsort(number, kind="stable")
    number, sent, arrived = number[order], sent[order], arrived[order]
    if (np.abs(gaps / usual - steps) > _NUMBERS / 4).any() or (np.diff(number) == 0).any():
        raise ValueError("its numbers do not count packets: a pause is too long, or it has answers of another run")
    return number, sent, arrived


def _usual_gap(number: np.ndarray, sent: np.ndarray) -> float:
    """Returns the usual time between two packets [us].

    Raises:
        ValueError: If stamps leave too little time for packets that were not answered. A packet may be sent as late as
            others are: by what the shortest time between two is shorter than the usual one.
    """
    steps, gaps = np.diff(number), np.diff(sent)
    direct = gaps[steps == 1]
    if len(direct):
        late = min(2.0 * float(np.median(direct) - direct.min()), _LATEST_STAMP)
        expected = steps * np.quantile(direct, 0.05)
        hurried = np.flatnonzero((steps > 1) & (gaps < 0.9 * expected) & (gaps < expected - late))
        if len(hurried):
            raise ValueError(
                f"between the packets {number[hurried[0]]} and {number[hurried[0] + 1]} its stamps leave too little "
                "time for the lost ones: the clock was set back, record anew"
            )
    return float(np.median(gaps / steps))


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
        for wrong, words in (
            (~np.isfinite(sent), "has no time of sending"),
            ((np.abs(sent) >= _LATEST_TIME) | (delays >= _LATEST_TIME), "has times that are too large for seconds"),
            (np.diff(sent, prepend=sent[:1]) < 0.0, "was sent before the one above: sort the rows by sent, unless a "
             "clock was set back, where the record has to be cut"),
            (delays < 0.0, "arrived before it was sent: the clocks of sender and receiver differ, set one by the "
             "other"),
            (sent[-1:] == sent[0], "was sent together with all others: packets are sent one after the other"),
        ):  # fmt: skip
            if wrong.any():
                raise ValueError(f"packet {int(np.argmax(wrong)) + 1} {words}")
        self._set(sent=sent, delays=delays)

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
        try:
            content = read_file(path, LARGEST_LOG)
        except OSError as error:
            raise ValueError(f"cannot read packets from {shown(path)}: {error.strerror or error}") from error
        try:
            if content.startswith(b"PING "):
                return cls(*_of_ping(content.decode().replace("\r\n", "\n")))
            return cls(*_of_table(table_rows(content, _chosen, _FORMS)))
        except UnicodeDecodeError as error:
            raise ValueError(f"{shown(path)}: it is no text in UTF-8; {_FORMS}") from error
        except ValueError as error:
            raise ValueError(f"{shown(path)}: {error}") from None

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
