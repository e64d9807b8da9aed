"""Files of recorded packets: a table of the columns sent and received, or the output of Linux `ping -D`.

Nothing is guessed: what is not certain is refused.
"""

from __future__ import annotations

import csv
import io
import os
import re
from array import array
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from ncs_gym.reading import LARGEST_LOG, read_file, require_packets
from ncs_gym.validation import reason_of, shown

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


class Record(NamedTuple):
    """What a file says.

    Attributes:
        sent: When each packet was sent, shape (k,), ascending [s].
        delays: How long each was on its way, shape (k,); NaN for a lost one [s].
        read_as: How the file was read, in a sentence.
    """

    sent: np.ndarray
    delays: np.ndarray
    read_as: str


def read_record(path: str | os.PathLike[str]) -> Record:
    """Returns the record in a file: CSV, Parquet, or the output of Linux `ping -D`.

    Raises:
        ValueError: If the file cannot be read, or is none of these.
    """
    try:
        content = read_file(path, LARGEST_LOG)
    except OSError as error:
        raise ValueError(f"cannot read packets from {shown(path)}: {error.strerror or error}") from error
    try:
        if content.startswith(b"PING "):
            return _of_ping(content.decode().replace("\r\n", "\n"))
        return _of_table(table_rows(content, _chosen, _FORMS))
    except UnicodeDecodeError as error:
        raise ValueError(f"{shown(path)}: it is no text in UTF-8; {_FORMS}") from error
    except ValueError as error:
        raise ValueError(f"{shown(path)}: {error}") from None


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


def _of_table(rows: Iterable[tuple[float, ...]]) -> Record:
    """Returns the packets of a table, whose rows are in the order of sending.

    A packet without a row is not seen, as in a log of the receiver, which has none of what was lost.
    """
    numbers = array("d")
    for count, times in enumerate(rows, 1):
        require_packets(count)
        numbers.extend(times)
    sent, received = np.reshape(np.array(numbers), (-1, 2)).T
    for wrong, words in (
        (~np.isfinite(sent), "it has no time of sending"),
        (~(np.abs(sent) < _LATEST_TIME) | (np.abs(received) >= _LATEST_TIME), "its times are too large for seconds"),
        (np.diff(sent, prepend=sent[:1]) < 0.0, "it was sent before the one above: sort the rows by sent, unless a "
         "clock was set back, where the record has to be cut"),
        (received < sent, "it arrived before it was sent: the clocks of sender and receiver differ, set one by the "
         "other"),
    ):  # fmt: skip
        if wrong.any():
            raise ValueError(f"row {int(np.argmax(wrong)) + 1} of the packets: {words}")
    return Record(sent, received - sent, "Read as a table: 'sent' in s, 'received' in s.")


def _of_ping(text: str) -> Record:
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
    return Record(moments / 1e6, delays / 1e6, read_as)


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
