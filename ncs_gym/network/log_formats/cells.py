"""The columns and cells of a table of packets: what they hold, in which unit, and what says that one was lost."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime, timedelta
from decimal import Decimal, InvalidOperation
from typing import NamedTuple

from ncs_gym.validation import shown

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
MOMENTS = {"time", "t", "ts", "timestamp", "time_stamp", "stamp", "date", "datetime", "epoch", "unix_time", "clock"}
_ROLE_OF = {name: role for role, names in _ROLES.items() for name in names.split()}
# Units in the names of columns [s].
UNITS = {
    unit: Decimal(scale)
    for units, scale in (
        ("s sec secs second seconds", "1"),
        ("ms msec milliseconds", "1e-3"),
        ("us usec microseconds", "1e-6"),
        ("ns nsec nanoseconds", "1e-9"),
    )
    for unit in units.split()
}
SUFFIX = re.compile(rf"_({'|'.join(UNITS)})$")
# Times since 1970 of these decades, by the number before the point: a column without a unit is in this one.
_EPOCHS = ((Decimal(10) ** 11, "ms"), (Decimal(10) ** 14, "us"), (Decimal(10) ** 17, "ns"), (Decimal(10) ** 20, ""))
# Numbers that mark what is lost, and a limit of all others.
MARKS, _MARKS_OF_DATES = {Decimal(0), Decimal(-1)}, {"0", "-1"}
_LARGEST_COUNT = 2**53
_LARGEST = Decimal(10) ** 305
_LOST = {"", "na", "n/a", "nan", "nat", "inf", "infinity", "none", "null", "-", "--", "*", "lost", "timeout"}
_YES, _NO = {"1", "1.0", "true", "yes", "y"}, {"0", "0.0", "false", "no", "n", ""}
# Words of the names of columns, and cells, that may tell of lost packets where nobody knows how.
_OF_LOSS = re.compile(
    r"(?:^|_)(?:lost|loss|losses|lossy|drop|drops|dropped|miss|missed|missing|timeout|ok|status|state|success|fail|failed|"
    r"failure|err|errno|error|errors|rc|ret|code|exit|result|outcome|event|type|retry|retries|resent|valid|ack|nack|acked|"
    r"delivered|arrived|received)(?:_|$)"
)
_SAYS_LOST = {"lost", "loss", "dropped", "drop", "timeout", "timed out", "missing", "missed", "fail", "failed"}
_SINCE = datetime(1970, 1, 1, tzinfo=UTC)
# The years 2000 and 2100 [s since 1970].
YEARS = 946_684_800, 4_102_444_800
# Longer cells are no numbers [characters].
_LONGEST_CELL = 64
# A number that may have groups of three digits, and one that has none.
_GROUPS = re.compile(r"[+-]?[1-9]\d{0,2}(?:([.,])\d{3})?")
_NO_GROUPS = re.compile(r"[+-]?(?:\d+([.,])\d+|\d{4,})")


class Column(NamedTuple):
    """A column that is understood.

    Attributes:
        index: Its place in a row.
        name: Its name.
        unit: The unit in its name; "" where it has none.
    """

    index: int
    name: str
    unit: str


def columns_of(names: Sequence[str]) -> dict[str, Column]:
    """Returns the columns that are understood, by what they hold."""
    columns: dict[str, Column] = {}
    for index, name in enumerate(names):
        small = plain(name)
        suffix = SUFFIX.search(small)
        role = _ROLE_OF.get(small) or _ROLE_OF.get(SUFFIX.sub("", small))
        if role in columns:
            raise ValueError(
                f"the columns {shown(columns[role].name)} and {shown(name)} may both be what was {role}: ignore one"
            )
        if role is not None:
            columns[role] = Column(index, name, suffix[1] if suffix and small not in _ROLE_OF else "")
    return columns


def plain(name: str) -> str:
    """Returns the name of a column in small letters, with underscores between its words."""
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).replace("µ", "u").replace("μ", "u")
    return re.sub(r"[^a-z0-9]+", "_", spaced.lower()).strip("_")


def rows_of(
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


def different_cells(rows: Iterator[tuple[int, list[str]]], width: int) -> list[set[str]]:
    """Returns the different cells of each column in small letters: some of them, and all that may say a loss."""
    found: list[set[str]] = [set() for _ in range(width)]
    for _, cells in rows:
        for column, cell in zip(found, cells, strict=False):
            if len(column) <= len(_YES | _NO) or cell.lower() in _SAYS_LOST | _LOST:
                column.add(cell.lower())
    return found


def are_flags(cells: set[str]) -> bool:
    """Returns whether different cells of a column are flags, some yes and some no."""
    return cells <= _YES | _NO and not cells.isdisjoint(_YES) and not cells.isdisjoint(_NO)


def require_no_loss(name: str, cells: set[str]) -> None:
    """Raises ValueError if a column that is not understood may say which packets were lost.

    By its name or a word, or because its cells are of two kinds: two values, or some empty and others not.
    """
    is_divided = len(cells) == 2 or not cells.isdisjoint(_LOST)
    if len(cells) > 1 and (is_divided or _OF_LOSS.search(plain(name)) or not cells.isdisjoint(_SAYS_LOST)):
        raise ValueError(
            f"the column {shown(name)} may say which packets were lost: name it lost if 1 stands for a lost one, ok if "
            "0 does, or ignore it (ignore=..., --ignore) if it says something else"
        )


def says_lost(line: int, cells: list[str], columns: dict[str, Column]) -> bool:
    """Returns whether a row has the mark of a lost packet, or not that of one that arrived.

    Beside the time of arrival a delay may mark it, too.
    """
    marks = {}
    if {"received", "delay"} <= columns.keys():
        cell = cells[columns["delay"].index]
        try:
            delay = number_in(cell)
        except ValueError:
            raise ValueError(f"line {line}: {shown(columns['delay'].name)} is no delay, got {shown(cell)}") from None
        if delay is None or delay in MARKS:
            return True
    for role in {"lost", "kept"} & columns.keys():
        index, name = columns[role][:2]
        cell = cells[index].lower() if index < len(cells) else ""
        if cell not in _YES | _NO:
            raise ValueError(f"line {line}: {shown(name)} has to be 0 or 1, yes or no, got {shown(cell)}")
        marks[role] = cell in _YES
    return marks.get("lost", False) or not marks.get("kept", True)


def require_decimals(rows: Iterator[tuple[int, list[str]]], indices: Sequence[int]) -> None:
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


def is_number(cell: str) -> bool:
    """Returns whether a cell has a number, a date, or a mark of what is lost."""
    try:
        number_in(cell)
    except ValueError:
        return is_date(cell)
    return True


def is_date(cell: str) -> bool:
    """Returns whether a cell has a date and a time of day."""
    try:
        return len(cell) <= _LONGEST_CELL and _date(cell) is not None
    except ValueError:
        return False


def has_zone(cell: str) -> bool:
    """Returns whether a date names its time zone."""
    return datetime.fromisoformat(cell).tzinfo is not None


def number_in(cell: str, *, dated: bool = False) -> Decimal | None:
    """Returns the number in a cell, or seconds since 1970 if it is a date, None for a mark of what is lost.

    Raises:
        ValueError: If it is neither, or a number where a date should be.
    """
    if len(cell) > _LONGEST_CELL:
        raise ValueError("too long")
    if cell.lower() in _LOST:
        return None
    if dated:
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


def count_in(cell: str) -> int:
    """Returns the whole number in a cell; raises ValueError if there is none, or one that nobody counts to."""
    value = int(cell.removesuffix(".0"))  # as pandas writes them beside what is missing
    if abs(value) > _LARGEST_COUNT:
        raise ValueError("too large")
    return value


def units_of(sent: Column, until: Column, by: str, first: Decimal) -> tuple[str, str]:
    """Returns the units of two columns: those of their names, or of times since 1970, or seconds.

    Where one of two times has a unit the other one has it, too.
    """
    magnitude = next((unit for above, unit in reversed(_EPOCHS) if abs(first) >= above), "")
    own = sent.unit or (until.unit if by == "received" else "") or magnitude or "s"
    return own, until.unit or (own if by == "received" else "s")


def require_units(sent: Column, delay: Column, first: Decimal) -> None:
    """Raises ValueError if one of two columns, a time and a delay, has a unit from which nothing follows for the other.

    Times since 1970 in seconds, as those of a calendar, need no unit.
    """
    of_sent = sent.unit or next((unit for above, unit in reversed(_EPOCHS) if abs(first) >= above), "")
    no_unit = delay if of_sent not in ("", "s") and not delay.unit else None
    if delay.unit and not of_sent and abs(first) < YEARS[0]:
        no_unit = sent
    if no_unit is not None:
        other, unit = (sent, of_sent) if no_unit is delay else (delay, delay.unit)
        name = plain(no_unit.name)
        raise ValueError(
            f"{shown(other.name)} is in {unit} and {shown(no_unit.name)} has no unit: name it "
            + " or ".join(f"{name}_{each}" for each in dict.fromkeys((unit, "s", "ms")))
        )


def require_no_unit(columns: Sequence[Column]) -> None:
    """Raises ValueError if a column of dates has another unit than seconds."""
    for column in columns:
        if column.unit not in ("", "s"):
            name = SUFFIX.sub("", plain(column.name))
            raise ValueError(f"times are dates, and {shown(column.name)} has the unit {column.unit}: name it {name}")


def require_moment(cell: str, moment: Decimal, *, is_guessed: bool) -> None:
    """Raises ValueError if a time is after 2100, or, where its unit follows from it, before 2000 [s]."""
    if abs(moment) > YEARS[1] or (is_guessed and moment < YEARS[0]):
        raise ValueError(
            f"{shown(cell)} is no time since 1970 of these decades: write times of a calendar as in "
            "2026-11-26T10:00:00.020Z, or name the unit of the others (sent_ms)"
        )
