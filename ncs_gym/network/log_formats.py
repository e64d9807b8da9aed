"""Formats of files with recorded packets: tables, ping, fping, logs of `ncs loop`, lists of round trips, irtt.

Every reader returns the times that stand in the file and says how it took them. What is ambiguous is refused.
"""

from __future__ import annotations

import codecs
import csv
import itertools
import os
import re
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime, timedelta
from decimal import Decimal, InvalidOperation
from typing import Any, NamedTuple, NoReturn

import numpy as np

from ncs_gym.reading import LARGEST_LOG, MOST_LINES, json_values, read_file, require_packets
from ncs_gym.validation import reason_of, shown


class Record(NamedTuple):
    """What a file says.

    Attributes:
        sent: When each packet was sent, shape (k,), ascending [s].
        delays: How long each was on its way, shape (k,); NaN for a lost one [s].
        read_as: How the file was read, in sentences.
    """

    sent: np.ndarray
    delays: np.ndarray
    read_as: str


# Longer lines are not ping's, longer rows not those of a table, and longer cells are no numbers [characters].
_LONGEST_LINE, _LONGEST_ROW, _LONGEST_CELL = 1000, 4096, 64


def read_record(path: str | os.PathLike[str], period: float | None, step: float) -> Record:
    """Returns the record in a file.

    Args:
        path: The file.
        period: Time between packets where the file does not say it; None if that is not known [s].
        step: Duration of the steps of `ncs loop` [s].

    Raises:
        ValueError: If the file cannot be read, or is none of the formats, or ambiguous.
    """
    try:
        text = _decoded(read_file(path, LARGEST_LOG))
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"cannot read packets from {shown(path)}: {error}") from error
    if text.count("\n") > MOST_LINES:
        raise ValueError(f"{shown(path)} has more than {MOST_LINES:,} lines, a log of packets has at most so many")
    try:
        if any(each.search(text) for each in (_ANY_PING, _ANY_FPING, _ANY_WINDOWS)):
            return _of_ping(text, period)
        if text.lstrip()[:1] in ("{", "["):
            return _of_json(text)
        rows = text.splitlines()
        if any(len(row) > _LONGEST_ROW for row in rows):
            raise ValueError(f"a row of a table has at most {_LONGEST_ROW:,} characters, a longer one is no record")
        return _of_table(rows, period, step)
    except csv.Error as error:
        raise ValueError(f"{shown(path)} is no CSV file: {reason_of(error)}") from error
    except ValueError as error:
        raise ValueError(f"{shown(path)}: {error}") from None


def _many(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def _decoded(content: bytes) -> str:
    """Returns the text of a file in UTF-8 or UTF-16, as PowerShell writes it, with or without a byte-order mark."""
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.decode("utf-16")
    if content[1:2] == b"\0":
        return content.decode("utf-16-le")
    if content[:1] == b"\0":
        return content.decode("utf-16-be")
    return content.decode("utf-8-sig")


# ---------------------------------------------------------------- ping

_MILLISECONDS = r"(?P<time>\d+(?:[.,]\d+)?) ?ms"
# A line of ping: the stamp that -D prints, the number of the packet, and the time until its answer.
_PING = re.compile(
    rf"(?:\[(?P<stamp>\d+\.\d+)\] ?)?.*?\b(?:icmp_)?seq[= ](?P<number>\d+)\b(?:.*?[^\W\d][=<]{_MILLISECONDS})?"
)
_FPING = re.compile(
    rf"(?:\[(?P<stamp>\d+\.\d+)\] ?)?(?P<host>\S+) +: \[(?P<number>\d+)\], (?:timed out|\d+ bytes, {_MILLISECONDS})"
)
_WINDOWS = re.compile(rf"Reply from \S+: (?:bytes=\d+ )?time[=<]{_MILLISECONDS}")
_WINDOWS_LOST = re.compile(
    r"(?P<timeout>Request timed out)|Reply from \S+: |General failure|PING: transmit failed|Hardware error"
)
_WINDOWS_FRAME = re.compile(r"Pinging |Ping statistics for |Packets: |Approximate round trip|Minimum = |Control-|\^C|$")
# Whether a text is one of these.
_ANY_PING = re.compile(r"\bicmp_seq[= ]\d|\bseq=\d+ (?:ttl|hlim)=|^PING ", re.MULTILINE)
_ANY_FPING = re.compile(r"^(?:\[\d+\.\d+\] ?)?\S+ +: \[\d+\], ", re.MULTILINE)
_ANY_WINDOWS = re.compile(r"^(?:Pinging \S+ |Reply from \S+: |Request timed out)|\d ?ms TTL=\d", re.MULTILINE)
# A number that nobody counts to, and no clock shows.
_ENDLESS = re.compile(r"(?<![\w.])\d{19}")
# How many packets were sent and answered, and how long ping ran; by Linux, BusyBox and macOS, Windows, and fping.
_SUMMARIES = (
    re.compile(r"\s*(\d+) [^\d,]+, (\d+) [^\d,%]+,.*?%(?:.*, [^\d,]+ (\d+) ?ms)?"),
    re.compile(r"\s*Packets: Sent = (\d+), Received = (\d+)()"),
    re.compile(r"\S+ +: xmt/rcv/%loss = (\d+)/(\d+)/()"),
)
# The first number is 0 where the header has "56 data bytes" behind a colon (BusyBox, macOS); Linux counts from 1.
_FROM_ZERO = re.compile(r"PING6|PING .*: \d+ data bytes")
# Numbers begin anew after 65535, where only stamps tell late answers from lost packets; more than so many numbers late
# nobody waits for. Repeated or late are few in a row, unless something began anew.
_NUMBERS, _LATEST, _MOST_LATE = 65536, 1024, 16
# Who is sent later than the newest by more than this is no late one, whenever its answer was printed [s].
_PRINTED = 1.0
# Windows waits so long for an answer before it sends the next packet, unless told otherwise [s].
_WINDOWS_TIMEOUT = 4.0
_BEFORE = "the packet arrived before it was sent: the clocks of sender and receiver differ, set one by the other"
_WAY_AND_BACK = "delays are those of the whole way and back"


class _Summary(NamedTuple):
    transmitted: int
    received: int
    duration: float | None


def _of_ping(text: str, period: float | None) -> Record:
    """Returns the packets of ping or fping, of Linux, BusyBox, macOS or Windows."""
    lines = text.splitlines()
    for number, line in enumerate(lines, 1):
        if len(line) > _LONGEST_LINE:
            raise ValueError(f"line {number} is longer than any of ping")
        if found := _ENDLESS.search(line):
            raise ValueError(f"line {number} has a number that is too large, {shown(line[found.start() :])}")
    if "time of day goes back" in text:
        raise ValueError("ping warns that the clock was set back: record anew, or cut the record there")
    if sum(line.startswith(("PING", "Pinging ")) for line in lines) > 1:
        raise ValueError("it holds several runs of ping: put each into a file of its own")
    found = [match for line in lines for pattern in _SUMMARIES if (match := pattern.match(line))]
    summary = None
    if found:
        transmitted, received, duration = found[-1].groups()
        summary = _Summary(int(transmitted), int(received), int(duration) / 1000.0 if duration else None)
        require_packets(summary.transmitted)
    if _ANY_FPING.search(text):
        return _of_numbers(lines, _FPING, "fping", summary, period)
    if _ANY_PING.search(text):
        return _of_numbers(lines, _PING, "ping", summary, period)
    return _of_windows(lines, summary, period)


def _of_numbers(
    lines: Sequence[str], pattern: re.Pattern[str], program: str, summary: _Summary | None, period: float | None
) -> Record:
    """Returns the packets of a program that numbers them; a number without an answer is a lost packet."""
    answers: dict[int, float] = {}
    stamps: dict[int, float] = {}
    header = next((line for line in lines if line.startswith("PING")), None)
    hosts, last, late, origin, printed, newest = set(), None, 0, None, None, -np.inf
    for count, line in enumerate(lines, 1):
        if (found := pattern.match(line)) is None:
            continue
        hosts.add(found.groupdict().get("host"))
        number = int(found["number"])
        delay = np.nan if found["time"] is None else _milliseconds(found["time"])
        now = sent = None
        if found["stamp"] is not None:
            stamp = Decimal(found["stamp"])
            origin = stamp if origin is None else origin
            if printed is not None and stamp < printed:
                raise ValueError(f"line {count}: the clock was set back by {printed - stamp:f} s, cut the record there")
            printed, now = stamp, float(stamp - origin)
            sent = None if found["time"] is None else now - delay
        if "(DUP!)" in line:
            continue
        if last is not None:
            if program == "ping" and number < _NUMBERS:  # the nearest number of which this is the remainder
                number = last + (number - last + _NUMBERS // 2) % _NUMBERS - _NUMBERS // 2
            if program == "ping" and number <= last and sent is not None and sent > newest + _PRINTED:
                number += _NUMBERS
            known = answers.get(number)
            is_late = number <= last and (known is None or not np.isnan(known))
            late = late + 1 if is_late else 0
            too_late = last - number > _LATEST and sent is None
            if too_late or late > _MOST_LATE or (header is not None and number < 0):
                raise ValueError(
                    f"line {count}: number {found['number']} may be a late answer, or come after many lost ones or of "
                    "another run: record with ping -D, whose stamps tell, and each run in a file of its own"
                )
        last = number if last is None else max(last, number)
        newest = max(newest, -np.inf if now is None else now if sent is None else sent)
        if np.isnan(answers.setdefault(number, np.nan)):  # a further answer is a duplicate
            answers[number] = delay
            if sent is not None:
                stamps[number] = sent
    if len(hosts) > 1:
        raise ValueError("it has the answers of several hosts: put each into a file of its own")
    if not answers:
        raise ValueError("no packet of ping has a number")
    first, last = min(answers), max(answers)
    begins = 0 if first == 0 or program == "fping" or (header is not None and _FROM_ZERO.match(header)) else 1
    if header is not None:
        first = min(first, begins)
    if summary is not None:
        last = max(last, begins + summary.transmitted - 1)
    require_packets(last - first + 1)
    numbers = np.arange(first, last + 1)
    delays = np.array([answers.get(number, np.nan) for number in numbers.tolist()])
    if len(stamps) > 1:
        sent, how = _between_stamps(numbers, stamps), "sent when its stamps say"
        for number, stamp in stamps.items():  # the answer came when it came
            delays[number - first] += stamp - sent[number - first]
    else:
        between, how = _period_of(summary, period)
        sent = between * (numbers - first)
    notes = _disagreements(summary, delays)
    return Record(sent, delays, f"Read as the output of {program}: {_WAY_AND_BACK}, packets were {how}.{notes}")


def _of_windows(lines: Sequence[str], summary: _Summary | None, period: float | None) -> Record:
    """Returns the packets of Windows' ping, which has no numbers: a line that is not understood might be a lost packet.

    The next packet is sent a period after an answer, but only after the timeout where there is none.
    """
    every = 1.0 if period is None else period
    delays, gaps = [], []
    for number, line in enumerate(map(str.strip, lines), 1):
        if found := _WINDOWS.match(line):
            delays.append(_milliseconds(found["time"]))
            gaps.append(max(every, delays[-1]))
        elif found := _WINDOWS_LOST.match(line):
            delays.append(np.nan)
            gaps.append(max(every, _WINDOWS_TIMEOUT) if found["timeout"] else every)
        elif not _WINDOWS_FRAME.match(line):
            raise ValueError(f"line {number} is not understood: of Windows' ping only the English output is")
    missing = 0 if summary is None else max(summary.transmitted - len(delays), 0)
    require_packets(len(delays) + missing)
    delays, gaps = np.array(delays + missing * [np.nan]), gaps + missing * [every]
    return Record(
        np.cumsum([0.0, *gaps])[:-1],
        delays,
        f"Read as the output of ping on Windows: {_WAY_AND_BACK}; a packet was sent {every:g} s after the one before, "
        f"or {_WINDOWS_TIMEOUT:g} s after one that timed out, which is how long Windows waits unless told otherwise."
        f"{_disagreements(summary, delays)}",
    )


def _milliseconds(text: str) -> float:
    return float(text.replace(",", ".")) / 1000.0


def _between_stamps(numbers: np.ndarray, stamps: dict[int, float]) -> np.ndarray:
    """Returns when packets were sent, those without a stamp evenly between their neighbors, shape (k,) [s]."""
    known = np.array(sorted(stamps))
    # None was sent after a later one: where stamps were printed late the earlier time is nearer.
    times = np.minimum.accumulate([stamps[each] for each in known[::-1].tolist()])[::-1]
    _require_time(known, times)
    steps, gaps = np.diff(known), np.diff(times)
    slope = float(np.median(gaps / steps))
    sent = np.interp(numbers, known, times)
    before, after = numbers < known[0], numbers > known[-1]
    sent[before] = times[0] - slope * (known[0] - numbers[before])
    sent[after] = times[-1] + slope * (numbers[after] - known[-1])
    return sent


def _require_time(numbers: np.ndarray, sent: np.ndarray) -> None:
    """Raises ValueError if there is too little time between two packets for those that are missing between them."""
    steps, gaps = np.diff(numbers), np.diff(sent)
    if not (steps == 1).any():
        return
    expected = steps * np.quantile(gaps[steps == 1], 0.05)
    hurried = np.flatnonzero((steps > 1) & (gaps < 0.9 * expected) & (gaps < expected - 0.1))
    if len(hurried):
        raise ValueError(
            f"between the packets {numbers[hurried[0]]} and {numbers[hurried[0] + 1]} its stamps leave too little time "
            "for the lost ones: the clock was set back there, cut the record"
        )


def _period_of(summary: _Summary | None, period: float | None) -> tuple[float, str]:
    """Returns the time between packets [s], and how that is known."""
    measured = None
    if summary is not None and summary.duration and summary.transmitted > 1:
        measured = summary.duration / (summary.transmitted - 1)
    if period is None and measured is not None:
        return measured, f"sent every {1000.0 * measured:.4g} ms by the duration in its summary"
    if period is None:
        return 1.0, "sent every second, as is usual (ping -D prints when)"
    disagrees = measured is not None and not 0.9 < period / measured < 1.1
    but = f", although by its summary every {1000.0 * (measured or 0.0):.4g} ms" if disagrees else ""
    return period, f"sent every {1000.0 * period:.4g} ms as asked for{but}"


def _disagreements(summary: _Summary | None, delays: np.ndarray) -> str:
    """Returns a sentence where the file has not as many packets and answers as its summary says."""
    answers = int(np.isfinite(delays).sum())
    if summary is None or (len(delays), answers) == summary[:2]:
        return ""
    return (
        f" Its summary has {summary.transmitted:,} packets and {summary.received:,} answers, its lines {len(delays):,} "
        f"and {answers:,}: lines are missing or are counted twice."
    )


# -------------------------------------------------------------- tables

_ROLES = {
    "sent": "sent send tx sent_time send_time time_sent time_send tx_time t_sent t_send t_tx sent_at send_at "
    "sent_timestamp send_timestamp tx_timestamp timestamp_sent departure departure_time",
    "received": "received recv receive rx received_time receive_time recv_time time_received time_recv rx_time "
    "t_received t_recv t_rx received_at receive_at recv_at received_timestamp receive_timestamp recv_timestamp "
    "rx_timestamp timestamp_received arrival arrival_time arrived",
    "delay": "delay latency rtt owd one_way_delay round_trip round_trip_time roundtrip roundtrip_time",
    "number": "seq seqno seq_no sequence sequence_number sequence_no number packet packet_number packet_id icmp_seq",
    "episode": "episode",
    "lost": "lost dropped drop loss is_lost was_lost lost_flag packet_lost packet_loss timeout timed_out missing",
    "kept": "ok success successful delivered acked ack answered",
}
# Columns of these names say when something happened, but not what.
_MOMENTS = {"time", "t", "ts", "timestamp", "time_stamp", "stamp", "date", "datetime", "epoch", "unix_time", "clock"}
_ROLE_OF = {name: role for role, names in _ROLES.items() for name in names.split()}
# Units in the names of columns [s].
_UNITS = {
    unit: Decimal(scale)
    for units, scale in (
        ("s sec secs second seconds", "1"),
        ("ms msec milliseconds", "1e-3"),
        ("us usec microseconds", "1e-6"),
        ("ns nsec nanoseconds", "1e-9"),
    )
    for unit in units.split()
}
_SUFFIX = re.compile(rf"_({'|'.join(_UNITS)})$")
# Times since 1970 of these decades, by the number before the point: a column without a unit is in this one.
_EPOCHS = ((Decimal(10) ** 11, "ms"), (Decimal(10) ** 14, "us"), (Decimal(10) ** 17, "ns"), (Decimal(10) ** 20, ""))
# Numbers that mark what is lost, and a limit of all others.
_MARKS, _MARKS_OF_DATES = {Decimal(0), Decimal(-1)}, {"0", "-1"}
_LARGEST_COUNT = 2**53
_LARGEST = Decimal(10) ** 305
_LOST = {"", "na", "n/a", "nan", "nat", "inf", "infinity", "none", "null", "-", "--", "*", "lost", "timeout"}
_YES, _NO = {"1", "1.0", "true", "yes", "y"}, {"0", "0.0", "false", "no", "n", ""}
# Words of the names of columns, and cells, that may tell of lost packets where nobody knows how.
_OF_LOSS = re.compile(
    r"(?:^|_)(?:lost|loss|losses|drop|drops|dropped|miss|missed|missing|timeout|ok|status|success|fail|failed|failure|error|ack|"
    r"acked|delivered|arrived|received)(?:_|$)"
)
_SAYS_LOST = {"lost", "loss", "dropped", "drop", "timeout", "timed out", "missing", "missed", "fail", "failed"}
_SINCE = datetime(1970, 1, 1, tzinfo=UTC)
# The years 2000 and 2100 [s since 1970].
_YEARS = 946_684_800, 4_102_444_800
# Packets closer to each other are in another unit than seconds, as in the days of spreadsheets [s].
_CLOSEST = 1e-4
# A sender is regular if so many of the times between packets, and at least so many, differ by no more than this from
# multiples of the usual one. Where more periods have no packet, it paused.
_REGULAR_SHARE, _FEWEST, _IRREGULAR, _LONGEST_ABSENCE = 0.9, 20, 0.25, 100


class _Column(NamedTuple):
    index: int
    name: str
    unit: str  # "" where the name has none


def _of_table(lines: Sequence[str], period: float | None, step: float) -> Record:
    """Returns the packets of a table whose columns have names, or of one number per line."""
    head = next(((n, line) for n, line in enumerate(lines) if line.strip().lstrip("#").strip()), None)
    if head is None:
        raise ValueError("a log needs at least two packets")
    number, line = head
    rest = lines[number + 1 :]
    if "#" in line and (found := next(((n, each) for n, each in enumerate(lines) if _is_data(each)), None)):
        # Of lines of comment in front of the numbers the last one may have the names, if no line of names follows.
        has_names = not re.match(r"[\d.+-]", found[1].lstrip())
        number = found[0] if has_names else next((n for n in reversed(range(found[0])) if lines[n].strip()), number)
        line, rest = lines[number], lines[number + 1 :]
    line = line.strip().lstrip("#").strip()
    separator = next((each for each in ",;\t|" if each in line), " ")
    if separator == " ":
        line = re.sub(r"\s+(?=[(\[])", "", line)  # a unit in brackets belongs to the name before it
    names = next((cells for _, cells in _rows([line], separator, 1, with_empty=True)), [])
    if all(_is_number(name) for name in names):
        if len(names) == 1:
            _require_decimals(_rows(lines, separator, 1, with_empty=True), [0])
            return _of_list(_rows(lines, separator, 1, with_empty=True), period)
        raise ValueError(
            "its columns have no names, and neither their order nor their unit can be guessed safely: write them into "
            "the first line, as in sent_ms,received_ms"
        )
    columns = _columns(names)
    first = len(lines) - len(rest) + 1
    is_list = set(columns) - {"lost", "kept"} == {"delay"}

    def rows() -> Iterator[tuple[int, list[str]]]:
        return _rows(rest, separator, first, len(names), with_empty=is_list)

    cells = _different_cells(rows(), len(names))
    if (
        {"received", "delay"} <= columns.keys()
        and "kept" not in columns
        and _are_flags(cells[columns["received"].index])
    ):
        columns["kept"] = columns.pop("received")
    used = {each.index for each in columns.values()}
    unused = {index: name for index, name in enumerate(names) if index not in used}
    _require_decimals(rows(), [each.index for role, each in columns.items() if role in ("sent", "received", "delay")])
    if {"episode", "sent", "received"} <= columns.keys():
        _require_steps(columns, unused)
        return _of_steps(rows(), columns, step)
    for index, name in unused.items() if "delay" in columns or {"sent", "received"} <= columns.keys() else ():
        _require_no_loss(name, cells[index])
    if "sent" in columns and ("received" in columns or "delay" in columns):
        return _of_times(rows(), columns, names)
    if set(columns) - {"number", "lost", "kept"} == {"delay"}:
        if moments := [name for name in unused.values() if _SUFFIX.sub("", _plain(name)) in _MOMENTS]:
            unit = "" if columns["delay"].unit else f", and {shown(columns['delay'].name)} by its unit, as in rtt_ms"
            raise ValueError(
                f"the column {shown(moments[0])} may say when packets were sent or when they came back: name it sent_s "
                f"or received_s{unit}"
            )
        if not columns["delay"].unit:
            raise ValueError(f"the column {shown(names[columns['delay'].index])} has no unit: name it rtt_ms or rtt_s")
        found = _of_list(rows(), period, columns)
        more = f" Not used: {', '.join(map(shown, unused.values()))}." if unused else ""
        return found._replace(read_as=found.read_as + more)
    raise ValueError(
        f"it has the columns {shown(names)[1:-1]}; a log needs sent and received, or sent and delay, or one "
        "column of round trips, rtt_ms, with the units in their names (_s, _ms, _us, _ns)"
    )


def _is_data(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _rows(
    lines: Sequence[str], separator: str, first: int, width: int | None = None, *, with_empty: bool = False
) -> Iterator[tuple[int, list[str]]]:
    """Yields the cells of the rows with their numbers, without comments, and without empty lines unless asked for."""
    # A stretch of white space separates, or any other separator with white space around it.
    texts = (" ".join(line.split()) if separator == " " else line for line in lines)
    for number, cells in enumerate(csv.reader(texts, delimiter=separator, skipinitialspace=True), first):
        cells = [cell.strip() for cell in cells]
        if not any(cells):
            if with_empty:
                yield number, []
            continue
        if cells[0].startswith("#"):
            continue
        if width is not None and separator == " " and len(cells) != width:
            raise ValueError(
                f"line {number} has {len(cells)} columns instead of {width}: mark what is missing, as by NA"
            )
        if width is not None and any(cells[width:]):
            raise ValueError(f"line {number} has more columns than the names in the first line")
        yield number, cells


# A number that may have groups of three digits, and one that has none.
_GROUPS = re.compile(r"[+-]?[1-9]\d{0,2}(?:([.,])\d{3})?")
_NO_GROUPS = re.compile(r"[+-]?(?:\d+([.,])\d+|\d{4,})")


def _different_cells(rows: Iterator[tuple[int, list[str]]], width: int) -> list[set[str]]:
    """Returns the different cells of each column in small letters: some of them, and every one that says a loss."""
    found: list[set[str]] = [set() for _ in range(width)]
    for _, cells in rows:
        for column, cell in zip(found, cells, strict=False):
            if len(column) <= len(_YES | _NO) or cell.lower() in _SAYS_LOST:
                column.add(cell.lower())
    return found


def _are_flags(cells: set[str]) -> bool:
    """Returns whether different cells of a column are flags, some yes and some no."""
    return cells <= _YES | _NO and not cells.isdisjoint(_YES) and not cells.isdisjoint(_NO)


def _require_no_loss(name: str, cells: set[str]) -> None:
    """Raises ValueError if a column that is not understood may say which packets were lost."""
    if len(cells) > 1 and (_OF_LOSS.search(_plain(name)) or not cells.isdisjoint(_SAYS_LOST) or _are_flags(cells)):
        raise ValueError(
            f"the column {shown(name)} may say which packets were lost: name it lost if 1 stands for a lost one, ok if "
            "0 does, or leave it out"
        )


def _require_decimals(rows: Iterator[tuple[int, list[str]]], indices: Sequence[int]) -> None:
    """Raises ValueError if commas or points may separate thousands.

    All commas may, and points in a column whose numbers below 1000 have none, unless larger ones have none, either.
    """
    doubtful: dict[tuple[int, str], tuple[int, str]] = {}
    decimal, small, large = set[str](), set[int](), set[int]()
    for line, cells in rows:
        for index in indices:
            if index >= len(cells) or cells[index] == "-1" or ("." in decimal and "," not in cells[index]):
                continue
            if found := _GROUPS.fullmatch(cells[index]):
                if found[1]:
                    doubtful.setdefault((index, found[1]), (line, cells[index]))
                else:
                    small.add(index)
            elif found := _NO_GROUPS.fullmatch(cells[index]):
                decimal.add(found[1]) if found[1] else large.add(index)
    for (index, separator), (line, cell) in doubtful.items():
        if separator not in decimal and (separator == "," or index in small - large):
            name, way = ("comma", "decimal points") if separator == "," else ("point", "numbers without those")
            raise ValueError(
                f"line {line}: the {name} in {shown(cell)} may be that of decimals or of thousands: write {way}"
            )


def _columns(names: Sequence[str]) -> dict[str, _Column]:
    """Returns the columns that are understood, by what they hold."""
    columns: dict[str, _Column] = {}
    for index, name in enumerate(names):
        plain = _plain(name)
        suffix = _SUFFIX.search(plain)
        role = _ROLE_OF.get(plain) or _ROLE_OF.get(_SUFFIX.sub("", plain))
        if role in columns:
            raise ValueError(f"the columns {shown(columns[role].name)} and {shown(name)} may both be what was {role}")
        if role is not None:
            columns[role] = _Column(index, name, suffix[1] if suffix and plain not in _ROLE_OF else "")
    return columns


def _plain(name: str) -> str:
    """Returns the name of a column in small letters, with underscores between its words."""
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).replace("µ", "u").replace("μ", "u")
    return re.sub(r"[^a-z0-9]+", "_", spaced.lower()).strip("_")


def _is_number(cell: str) -> bool:
    try:
        _number(cell)
    except ValueError:
        return _is_date(cell)
    return True


def _is_date(cell: str) -> bool:
    """Returns whether a cell has a date and a time of day."""
    try:
        return len(cell) <= _LONGEST_CELL and _date(cell) is not None
    except ValueError:
        return False


def _number(cell: str, *, is_date: bool = False) -> Decimal | None:
    """Returns the number in a cell, or seconds since 1970 if it is a date, None for a mark of what is lost.

    Raises:
        ValueError: If it is neither, or a number where a date should be.
    """
    if len(cell) > _LONGEST_CELL:
        raise ValueError("too long")
    if cell.lower() in _LOST:
        return None
    if is_date:
        return Decimal(cell) if cell in _MARKS_OF_DATES else _date(cell)
    try:
        value = Decimal(cell)
    except InvalidOperation:
        if not re.fullmatch(r"[+-]?\d+,\d+", cell):
            raise ValueError("no number") from None
        return Decimal(cell.replace(",", "."))  # a decimal comma, where commas do not separate
    if value.is_nan() or value == Decimal("Infinity"):  # it never arrived
        return None
    if not -_LARGEST < value < _LARGEST:
        raise ValueError("too large")
    return value


def _date(cell: str) -> Decimal:
    """Returns the seconds since 1970 of a date in ISO 8601, in UTC if it names no zone."""
    if re.fullmatch(r"[+-]?[\d.,]+", cell):
        raise ValueError("a number")
    moment = datetime.fromisoformat(cell)
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return Decimal((moment - _SINCE) // timedelta(microseconds=1)) / 10**6


def _of_times(rows: Iterator[tuple[int, list[str]]], columns: dict[str, _Column], names: Sequence[str]) -> Record:
    """Returns the packets of a table with the time at which each was sent, and that of its arrival or its delay."""
    sent_at, by = columns["sent"], "received" if "received" in columns else "delay"
    until = columns[by]
    sent, arrived, delays, marked, at_zero, numbers, flagged, places = [], [], [], [], [], [], [], []
    origin, unit, until_unit, scale, until_scale = Decimal(0), "", "", Decimal(1), Decimal(1)
    dated = False
    for line, cells in rows:
        cells += (len(names) - len(cells)) * [""]
        if not sent and (dated := _is_date(cells[sent_at.index])):
            _require_no_unit([sent_at, until] if by == "received" else [sent_at])
        try:
            start = _number(cells[sent_at.index], is_date=dated)
            end = _number(cells[until.index], is_date=dated and by == "received")
            if "number" in columns:
                numbers.append(_count(cells[columns["number"].index]))
        except ValueError:
            _refuse_line(line, by)
        flagged.append(_says_lost(line, cells, columns))
        if start is None:
            _refuse_line(line, by)
        if not sent:
            if by == "delay":
                _require_units(sent_at, until, start)
            unit, until_unit = _units(sent_at, until, by, start)
            scale, until_scale = _UNITS[unit], _UNITS[until_unit]
            origin = start * scale
            named = sent_at.unit or (by == "received" and until.unit)
            _require_moment(cells[sent_at.index], origin, is_guessed=not named and unit != "s")
        start *= scale
        places.append(line)
        sent.append(float(start - origin))
        if end is None:
            arrived.append(np.nan)
            delays.append(np.nan)
            continue
        if end in _MARKS and (by == "delay" or start > end):  # a lost packet, marked by a number
            marked.append(len(delays))
        elif end == start == 0:  # as in the other lines, if zeros are marks there
            at_zero.append(len(delays))
        delay = end * until_scale - start if by == "received" else end * until_scale
        arrived.append(float(start - origin + delay))
        delays.append(float(delay))
    if len(sent) < 2:
        raise ValueError("a log needs at least two packets, each with the time at which it was sent")
    require_packets(len(sent))
    moments, delays = np.array(sent), np.array(delays)
    marked += at_zero if marked else []
    delays[marked] = np.nan
    _require_order(moments, np.where(np.isnan(delays), np.nan, arrived), places)
    delays[flagged] = np.nan
    if (delays < 0.0).any():
        raise ValueError(f"line {places[int(np.argmax(delays < 0.0))]}: {_BEFORE}")
    order = np.argsort(moments, kind="stable")
    moments, delays = moments[order], delays[order]
    _require_receiver(moments, delays, np.array(places)[order])
    guessed = not sent_at.unit and unit == "s" and not until.unit
    delay_is_guessed = not until.unit and (by == "delay" or guessed)
    missing, absent, usual = 0, 0, _median_gap(moments)
    if "number" in columns:
        moments, delays, missing = _with_missing(moments, delays, np.array(numbers)[order])
    else:
        before = len(moments)
        moments, delays = _with_absent(moments, delays)
        absent = len(moments) - before
    if guessed and abs(origin) < _YEARS[0] and 0.0 < _median_gap(moments) < _CLOSEST:
        raise ValueError(
            f"its packets would be sent every {_median_gap(moments):.3g} s, if times were seconds: write the unit into "
            "the names of the columns (sent_ms), and the days of a spreadsheet as seconds"
        )
    if delay_is_guessed and float(np.nanmedian(np.append(delays, -np.inf))) >= 1.0:
        raise ValueError(
            "the names of the columns say no unit, and most packets would take more than a second: name it, as in "
            "sent_ms and received_ms, or sent_s and received_s"
        )
    epoch = "" if origin < _YEARS[0] else ", times since 1970"
    used = {each.index for each in columns.values()}
    unused = [shown(name) for index, name in enumerate(names) if index not in used]
    read_as = f"Read as a table: {shown(sent_at.name)} in {unit}, {shown(until.name)} in {until_unit}{epoch}."
    if marked:
        read_as += f" A {shown(until.name)} of 0 or -1 stands for a lost packet ({_many(len(marked), 'line')})."
    if missing:
        read_as += f" A number without a line stands for a lost packet ({_many(missing, 'number')})."
    if absent:
        read_as += (
            f" {_many(absent, 'packet')} without a line, where one is usually sent every {1000.0 * usual:.4g} ms, "
            "stand for lost ones."
        )
    if unused:
        read_as += f" Not used: {', '.join(unused)}."
    return Record(moments, delays, read_as)


def _require_units(sent: _Column, delay: _Column, first: Decimal) -> None:
    """Raises ValueError if one of two columns, a time and a delay, has a unit from which nothing follows for the other.

    Times since 1970 in seconds, as those of a calendar, need no unit.
    """
    of_sent = sent.unit or next((unit for above, unit in reversed(_EPOCHS) if abs(first) >= above), "")
    no_unit = delay if of_sent not in ("", "s") and not delay.unit else None
    if delay.unit and not of_sent and abs(first) < _YEARS[0]:
        no_unit = sent
    if no_unit is not None:
        other, unit = (sent, of_sent) if no_unit is delay else (delay, delay.unit)
        name = _plain(no_unit.name)
        raise ValueError(
            f"{shown(other.name)} is in {unit} and {shown(no_unit.name)} has no unit: name it "
            + " or ".join(f"{name}_{each}" for each in dict.fromkeys((unit, "s", "ms")))
        )


def _require_no_unit(columns: Sequence[_Column]) -> None:
    """Raises ValueError if a column of dates has another unit than seconds."""
    for column in columns:
        if column.unit not in ("", "s"):
            name = _SUFFIX.sub("", _plain(column.name))
            raise ValueError(f"times are dates, and {shown(column.name)} has the unit {column.unit}: name it {name}")


def _units(sent: _Column, until: _Column, by: str, first: Decimal) -> tuple[str, str]:
    """Returns the units of two columns: those of their names, or of times since 1970, or seconds.

    Where one of two times has a unit the other one has it, too.
    """
    magnitude = next((unit for above, unit in reversed(_EPOCHS) if abs(first) >= above), "")
    own = sent.unit or (until.unit if by == "received" else "") or magnitude or "s"
    return own, until.unit or (own if by == "received" else "s")


def _median_gap(sent: np.ndarray) -> float:
    gaps = np.diff(sent)
    return float(np.median(gaps[gaps > 0.0])) if gaps.any() else 0.0


def _require_moment(cell: str, moment: Decimal, *, is_guessed: bool) -> None:
    """Raises ValueError if a time is after 2100, or, where its unit follows from it, before 2000 [s]."""
    if abs(moment) > _YEARS[1] or (is_guessed and moment < _YEARS[0]):
        raise ValueError(
            f"{shown(cell)} is no time since 1970 of these decades: write times of a calendar as in "
            "2026-11-26T10:00:00.020Z, or name the unit of the others (sent_ms)"
        )


def _require_order(sent: np.ndarray, arrived: np.ndarray, lines: Sequence[int]) -> None:
    """Raises ValueError if rows are neither in the order of sending nor, those that were overtaken, in that of arrival.

    Sorting them would hide that a clock was set back. A lost packet was not known before it was sent.
    """
    newest = np.maximum.accumulate(sent)
    logged = np.where(np.isnan(arrived), sent, arrived)
    late = sent < newest
    back = late & (np.isnan(arrived) | (logged < np.maximum.accumulate(logged)))
    since = np.arange(len(late)) - np.maximum.accumulate(np.where(late, 0, np.arange(len(late))))
    back |= since > _MOST_LATE  # as many were overtaken by one: the sender's clock was set back
    if not back.any():
        return
    at = int(np.argmax(back))
    if since[at] > _MOST_LATE:
        at -= int(since[at]) - 1
    raise ValueError(
        f"line {lines[at]}: the time of sending goes back by {newest[at] - sent[at]:.6g} s: if a clock was set back "
        "or began anew, or an hour comes twice in local time, cut the record there; otherwise sort the rows by it"
    )


def _require_receiver(sent: np.ndarray, delays: np.ndarray, lines: np.ndarray) -> None:
    """Raises ValueError if a packet overtakes another, and from it on packets take less by more than they differ.

    The clock of the receiver alone was set back there, or the network became faster at once by more than a period.
    """
    known = np.flatnonzero(~np.isnan(delays))
    taken, arrived, many = delays[known], (sent + delays)[known], _MOST_LATE + 1
    if len(known) < 2 * many:
        return
    stretches = np.lib.stride_tricks.sliding_window_view(taken, many)
    least, most = stretches.min(axis=1), stretches.max(axis=1)
    faster, spread = least[:-many] - most[many:], most - least
    back = (faster > np.maximum(spread[:-many], spread[many:])) & (arrived[many : 1 - many] < arrived[many - 1 : -many])
    if back.any():
        at = int(np.argmax(back))
        raise ValueError(
            f"line {lines[known[at + many]]}: from here on packets take {faster[at]:.3g} s less or more, and this one "
            "overtakes the one before: if the clock of the receiver was set back, or the network changed, cut the "
            "record there"
        )


def _count(cell: str) -> int:
    value = int(cell)
    if abs(value) > _LARGEST_COUNT:
        raise ValueError("too large")
    return value


def _says_lost(line: int, cells: list[str], columns: dict[str, _Column]) -> bool:
    """Returns whether a row has the mark of a lost packet, or not that of one that arrived."""
    marks = {}
    for role in {"lost", "kept"} & columns.keys():
        index, name = columns[role][:2]
        cell = cells[index].lower() if index < len(cells) else ""
        if cell not in _YES | _NO:
            raise ValueError(f"line {line}: {shown(name)} has to be 0 or 1, yes or no, got {shown(cell)}")
        marks[role] = cell in _YES
    return marks.get("lost", False) or not marks.get("kept", True)


def _refuse_line(number: int, by: str) -> NoReturn:
    second = "a time received" if by == "received" else "a delay"
    raise ValueError(f"line {number} is not a time sent and {second}")


def _with_missing(sent: np.ndarray, delays: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Returns the packets with those whose numbers are missing, evenly between their neighbors, and without duplicates.

    The last value is how many were missing. What comes twice arrived when it came first. Numbers that go back begin
    anew, and nothing is missing there.
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
    back = np.flatnonzero((numbers[1:-1] < numbers[:-2]) & (numbers[:-2] < numbers[2:]))
    if len(back):
        raise ValueError(
            f"by its time packet {numbers[back[0] + 1]} was sent after packet {numbers[back[0]]}: a clock was set "
            "back, or numbers come twice"
        )
    _require_time(numbers, sent)
    steps = np.diff(numbers)
    gaps = np.where(steps > 1, steps - 1, 0)
    require_packets(len(sent) + int(np.minimum(gaps, 10**9).sum()))
    return *_with_lost(sent, delays, gaps), int(gaps.sum())


def _with_absent(sent: np.ndarray, delays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the packets of a record without numbers with those that a regular sender sent and that have no line.

    A receiver's log has lines of what it received alone. Nothing is added where times between packets are no multiples
    of the usual one, nor to longer pauses, in which nothing was sent, nor where more would be added than there are, as
    between bursts.
    """
    usual = _median_gap(sent)
    periods = np.diff(sent) / usual if usual else np.zeros(len(sent) - 1)
    whole = np.rint(periods)
    if len(whole) < _FEWEST or np.mean(np.abs(periods - whole) <= _IRREGULAR) < _REGULAR_SHARE:
        return sent, delays
    missing = np.where((whole >= 2.0) & (whole <= _LONGEST_ABSENCE), whole - 1.0, 0.0).astype(np.int64)
    if missing.sum() > len(sent):
        return sent, delays
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


def _require_steps(columns: dict[str, _Column], unused: dict[int, str]) -> None:
    """Raises ValueError if a table with episodes is no log of `ncs loop`, which has steps and what arrived alone."""
    others = [
        column.name for role, column in columns.items() if role not in ("episode", "sent", "received") or column.unit
    ]
    if others := [*others, *unused.values()]:
        raise ValueError(
            f"a table with the column episode is a log of ncs loop, in steps, and has no {shown(others[0])}: put the "
            "times of each episode into a file of its own, without that column"
        )


def _of_steps(rows: Iterator[tuple[int, list[str]]], columns: dict[str, _Column], dt: float) -> Record:
    """Returns the packets of a log of `ncs loop`: the steps at which those that arrived were sent and received."""
    arrivals: dict[str, dict[int, int]] = {}
    last, newest = None, 0
    for number, row in rows:
        try:
            sent, received = (_count(row[columns[role].index]) for role in ("sent", "received"))
            episode = row[columns["episode"].index]
        except (ValueError, IndexError):
            raise ValueError(f"line {number} is not an episode, a step sent and one received") from None
        if not 0 <= sent <= received:
            raise ValueError(f"line {number}: {_BEFORE}")
        if episode in arrivals and (episode != last or received < newest):
            raise ValueError(
                f"line {number}: episode {shown(episode)} begins twice: put each log into a file of its own"
            )
        last, newest, arrived = episode, received, arrivals.setdefault(episode, {})
        arrived[sent] = min(received, arrived.get(sent, received))  # a second one is a duplicate
    require_packets(sum(max(*arrived, 0) for arrived in arrivals.values()))
    delays = [arrived.get(step, np.nan) - step for arrived in arrivals.values() for step in range(1, max(arrived) + 1)]
    episodes = "one episode" if len(arrivals) == 1 else f"{len(arrivals):,} episodes, one after the other"
    read_as = f"Read as a log of ncs loop: {episodes}, in steps of {dt:g} s; a step without a packet lost it."
    return Record(dt * np.arange(len(delays)), dt * np.array(delays), read_as)


def _of_list(
    rows: Iterator[tuple[int, list[str]]], period: float | None, columns: dict[str, _Column] | None = None
) -> Record:
    """Returns the packets of a list of delays, one per line; without a name they are milliseconds, as ping's are."""
    known = {"delay": _Column(0, "", "ms")} if columns is None else columns
    column = known["delay"]
    delays, numbers, marked = [], [], 0
    for line, cells in rows:
        try:
            value = _number(cells[column.index] if column.index < len(cells) else "")
            if "number" in known:
                numbers.append(_count(cells[known["number"].index]))
        except (ValueError, IndexError):
            raise ValueError(f"line {line} is not a delay") from None
        lost = not cells or _says_lost(line, cells, known)
        marked += not cells or value in _MARKS
        delays.append(np.nan if value is None or value in _MARKS or lost else float(value * _UNITS[column.unit]))
    if len(delays) < 2:
        raise ValueError("a log needs at least two packets")
    require_packets(len(delays))
    median = float(np.nanmedian(np.append(delays, -np.inf)))
    if columns is None and median < 1e-3:
        raise ValueError("numbers below 1 without a name may be seconds or milliseconds: write rtt_s or rtt_ms above")
    every = 1.0 if period is None else period
    sent, arrived = every * np.arange(len(delays)), np.array(delays)
    if numbers:
        if (np.diff(numbers) <= 0).any():
            raise ValueError("the numbers of its packets do not ascend")
        sent, arrived, _ = _with_missing(every * (np.array(numbers) - numbers[0]), arrived, np.array(numbers))
    name = "one number per line" if columns is None else shown(column.name)
    read_as = f"Read as a list of delays: {name}, in {column.unit}, packets sent every {1000.0 * every:.4g} ms"
    read_as += " (the file does not say)." if period is None else "."
    if marked:
        read_as += f" 0, -1 or an empty line stands for a lost packet ({_many(marked, 'line')})."
    return Record(sent, arrived, read_as)


# ---------------------------------------------------------------- JSON


def _of_json(text: str) -> Record:
    """Returns the round trips of irtt; that of iperf3 has counts of packets, but no times."""
    try:
        document = json_values(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"it is no JSON document that can be read: {reason_of(error)}") from None
    trips = document.get("round_trips") if isinstance(document, dict) else None
    if isinstance(trips, list):
        return _of_irtt(trips)
    if isinstance(document, dict) and {"intervals", "start"} <= document.keys():
        raise ValueError(
            "iperf3 counts packets per interval and records no times, from which no age follows: record with irtt, or "
            "with ping -D"
        )
    keys = shown([*document])[1:-1] if isinstance(document, dict) else "no names"
    raise ValueError(f"it is JSON with {keys}; of JSON documents only those of irtt are read (round_trips)")


def _of_irtt(trips: list[Any]) -> Record:
    """Returns the packets of irtt, by its monotonic clock if it has one [ns]."""
    sent, delays = [], []
    for number, trip in enumerate(trips):
        try:
            moments = trip["timestamps"]["client"]["send"]
            moment = moments.get("monotonic", moments.get("wall"))
            lost = trip["lost"] not in ("false", False)
            delay = np.nan if lost else trip["delay"]["rtt"] / 1e9
            if not (abs(int(moment)) < 2**63 and (lost or 0.0 <= delay < np.inf)):
                raise ValueError("out of range")
            sent.append(int(moment))
            delays.append(float(delay))
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
            raise ValueError(f"round trip {number} of irtt has no time sent, or neither a delay nor a loss") from None
    if len(sent) < 2:
        raise ValueError("a log needs at least two packets, each with the time at which it was sent")
    require_packets(len(sent))
    for number, (before, after) in enumerate(itertools.pairwise(sent), 1):
        if after < before:
            raise ValueError(
                f"round trip {number} of irtt: the clock was set back by {(before - after) / 1e9:g} s, cut the "
                "record there"
            )
    moments = np.array([(each - sent[0]) / 1e9 for each in sent])
    return Record(moments, np.array(delays), f"Read as the JSON of irtt: {_WAY_AND_BACK}.")
