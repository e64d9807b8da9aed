"""Tables of packets with named columns: times of sending and arrival, steps of `ncs loop`, lists of delays."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ncs_gym.network.log_formats.cells import (
    MARKS,
    MOMENTS,
    SUFFIX,
    UNITS,
    Column,
    are_flags,
    columns_of,
    count_in,
    different_cells,
    is_number,
    number_in,
    plain,
    require_decimals,
    require_no_loss,
    rows_of,
    says_lost,
)
from ncs_gym.network.log_formats.lost_packets import with_missing
from ncs_gym.network.log_formats.record import BEFORE, Record
from ncs_gym.network.log_formats.times import of_times
from ncs_gym.reading import require_packets
from ncs_gym.validation import counted, shown


class _Head(NamedTuple):
    """The line with the names of the columns, and what comes after it.

    Attributes:
        names: Of the columns; numbers where there are no names.
        separator: What stands between two cells.
        rest: The lines after it.
        first: The number of the first of these.
    """

    names: list[str]
    separator: str
    rest: Sequence[str]
    first: int


def of_table(lines: Sequence[str], period: float | None, step: float, ignore: Sequence[str] = ()) -> Record:
    """Returns the packets of a table whose columns have names, or of one number per line."""
    if lines and re.fullmatch(r"sep=.", lines[0].strip()):  # for spreadsheets
        lines = ["", *lines[1:]]
    names, separator, rest, first = _head_of(lines)
    if all(is_number(name) for name in names):
        return _without_names(lines, len(names), separator, period)
    if unknown := [name for name in ignore if name not in names]:
        raise ValueError(f"there is no column {shown(unknown[0])} to ignore: it has {shown(names)[1:-1]}")
    columns = columns_of(["" if name in ignore else name for name in names])
    is_list = set(columns) - {"lost", "kept"} == {"delay"}

    def rows() -> Iterator[tuple[int, list[str]]]:
        return rows_of(rest, separator, first, len(names), with_empty=is_list)

    cells = different_cells(rows(), len(names))
    has_flags = {"received", "delay"} <= columns.keys() and "kept" not in columns
    if has_flags and are_flags(cells[columns["received"].index]):
        columns["kept"] = columns.pop("received")
    used = {each.index for each in columns.values()}
    unused = {index: name for index, name in enumerate(names) if index not in used}
    require_decimals(rows(), [each.index for role, each in columns.items() if role in ("sent", "received", "delay")])
    if {"episode", "sent", "received"} <= columns.keys():
        _require_steps(columns, unused)
        return _of_steps(rows(), columns, step)
    moments = [name for name in unused.values() if name not in ignore and SUFFIX.sub("", plain(name)) in MOMENTS]
    if "delay" in columns or {"sent", "received"} <= columns.keys():
        for index, name in unused.items():
            if name not in moments and name not in ignore:
                require_no_loss(name, cells[index])
    if "sent" in columns and ("received" in columns or "delay" in columns):
        return of_times(rows(), columns, names)
    if set(columns) - {"number", "lost", "kept"} == {"delay"}:
        _require_list(columns["delay"], moments)
        found = _of_list(rows(), period, columns)
        more = f" Not used: {', '.join(map(shown, unused.values()))}." if unused else ""
        return found._replace(read_as=found.read_as + more)
    raise ValueError(
        f"it has the columns {shown(names)[1:-1]}; a log needs sent and received, or sent and delay, or one "
        "column of round trips, rtt_ms, with the units in their names (_s, _ms, _us, _ns)"
    )


def _head_of(lines: Sequence[str]) -> _Head:
    """Returns the line with the names of the columns, which may be a comment.

    Raises:
        ValueError: If there is nothing but comments.
    """
    head = next(((n, line) for n, line in enumerate(lines) if line.strip().lstrip("#").strip()), None)
    if head is None:
        raise ValueError("a log needs at least two packets")
    number, line = head
    if "#" in line and (found := next(((n, each) for n, each in enumerate(lines) if _is_data(each)), None)):
        # Of lines of comment in front of the numbers the last one may have the names, if no line of names follows.
        has_names = not re.match(r"[\d.+-]", found[1].lstrip())
        number = found[0] if has_names else next((n for n in reversed(range(found[0])) if lines[n].strip()), number)
        line = lines[number]
    line = line.strip().lstrip("#").strip()
    separator = next((each for each in ",;\t|" if each in line), " ")
    if separator == " ":
        line = re.sub(r"\s+(?=[(\[])", "", line)  # a unit in brackets belongs to the name before it
    names = next((cells for _, cells in rows_of([line], separator, 1, with_empty=True)), [])
    return _Head(names, separator, lines[number + 1 :], number + 2)


def _without_names(lines: Sequence[str], width: int, separator: str, period: float | None) -> Record:
    """Returns the packets of a list of delays without a name.

    Raises:
        ValueError: If there is more than one column.
    """
    if width != 1:
        raise ValueError(
            "its columns have no names, and neither their order nor their unit can be guessed safely: write them into "
            "the first line, as in sent_ms,received_ms"
        )
    require_decimals(rows_of(lines, separator, 1, with_empty=True), [0])
    return _of_list(rows_of(lines, separator, 1, with_empty=True), period)


def _require_list(delay: Column, moments: Sequence[str]) -> None:
    """Raises ValueError if a column of delays has no unit, or some other column may say when packets were sent."""
    if moments:
        unit = "" if delay.unit else f", and {shown(delay.name)} by its unit, as in rtt_ms"
        raise ValueError(
            f"the column {shown(moments[0])} may say when packets were sent or when they came back: name it sent_s "
            f"or received_s{unit}"
        )
    if not delay.unit:
        raise ValueError(f"the column {shown(delay.name)} has no unit: name it rtt_ms or rtt_s")


def _is_data(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _require_steps(columns: dict[str, Column], unused: dict[int, str]) -> None:
    """Raises ValueError if a table with episodes is no log of `ncs loop`, which has steps and what arrived alone."""
    others = [
        column.name for role, column in columns.items() if role not in ("episode", "sent", "received") or column.unit
    ]
    if others := [*others, *unused.values()]:
        raise ValueError(
            f"a table with the column episode is a log of ncs loop, in steps, and has no {shown(others[0])}: put the "
            "times of each episode into a file of its own, without that column"
        )


def _of_steps(rows: Iterator[tuple[int, list[str]]], columns: dict[str, Column], dt: float) -> Record:
    """Returns the packets of a log of `ncs loop`: the steps at which those that arrived were sent and received."""
    arrivals: dict[str, dict[int, int]] = {}
    last, newest = None, 0
    for number, row in rows:
        try:
            sent, received = (count_in(row[columns[role].index]) for role in ("sent", "received"))
            episode = row[columns["episode"].index]
        except (ValueError, IndexError):
            raise ValueError(f"line {number} is not an episode, a step sent and one received") from None
        if not 0 <= sent <= received:
            raise ValueError(f"line {number}: {BEFORE}")
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
    read_as += " The sample of step 0, which is the first estimate, is left out."
    return Record(dt * np.arange(len(delays)), dt * np.array(delays), read_as)


def _of_list(
    rows: Iterator[tuple[int, list[str]]], period: float | None, columns: dict[str, Column] | None = None
) -> Record:
    """Returns the packets of a list of delays, one per line; without a name they are milliseconds, as ping's are."""
    known = {"delay": Column(0, "", "ms")} if columns is None else columns
    column = known["delay"]
    delays, numbers, marked = [], [], 0
    for line, cells in rows:
        try:
            value = number_in(cells[column.index] if column.index < len(cells) else "")
            if "number" in known:
                numbers.append(count_in(cells[known["number"].index]))
        except (ValueError, IndexError):
            raise ValueError(f"line {line} is not a delay") from None
        lost = not cells or says_lost(line, cells, known)
        marked += not cells or value in MARKS
        delays.append(np.nan if value is None or value in MARKS or lost else float(value * UNITS[column.unit]))
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
        sent, arrived, *_ = with_missing(every * (np.array(numbers) - numbers[0]), arrived, np.array(numbers))
    name = "one number per line" if columns is None else shown(column.name)
    read_as = f"Read as a list of delays: {name}, in {column.unit}, packets sent every {1000.0 * every:.4g} ms"
    read_as += " (the file does not say)." if period is None else "."
    if marked:
        read_as += f" 0, -1 or an empty line stands for a lost packet ({counted(marked, 'line')})."
    return Record(sent, arrived, read_as)
