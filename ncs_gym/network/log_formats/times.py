"""Tables of packets with the time at which each was sent, and that of its arrival or its delay."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from decimal import Decimal
from typing import NamedTuple, NoReturn

import numpy as np

from ncs_gym.network.log_formats.cells import (
    MARKS,
    UNITS,
    YEARS,
    Column,
    count_in,
    has_zone,
    is_date,
    number_in,
    require_moment,
    require_no_unit,
    require_units,
    says_lost,
    units_of,
)
from ncs_gym.network.log_formats.lost_packets import median_gap, with_absent, with_missing
from ncs_gym.network.log_formats.record import BEFORE, MOST_LATE, Record
from ncs_gym.reading import require_packets
from ncs_gym.validation import counted, shown

# Packets closer to each other are in another unit than seconds, as in the days of spreadsheets [s].
_CLOSEST = 1e-4


class _Lines(NamedTuple):
    """What the lines of such a table say, in their order.

    Attributes:
        sent: When each packet was sent, since the first, shape (k,) [s].
        delays: How long it took, shape (k,); NaN for a lost one [s].
        numbers: Its number, shape (k,); no entries without a column of them.
        places: The number of its line, shape (k,).
        marked: How many a number marks as lost.
        origin: When the first was sent [s].
        units: Those of sent, and of received or the delay.
    """

    sent: np.ndarray
    delays: np.ndarray
    numbers: np.ndarray
    places: np.ndarray
    marked: int
    origin: Decimal
    units: tuple[str, str]


def of_times(rows: Iterator[tuple[int, list[str]]], columns: dict[str, Column], names: Sequence[str]) -> Record:
    """Returns the packets of a table with the columns sent, and received or delay."""
    lines = _lines_of(rows, columns, len(names))
    order = np.argsort(lines.sent, kind="stable")
    sent, delays = lines.sent[order], lines.delays[order]
    _require_receiver(sent, delays, lines.places[order])
    missing, restarts, absent, usual, tells_losses = 0, 0, 0, median_gap(sent), True
    if len(lines.numbers):
        sent, delays, missing, restarts = with_missing(sent, delays, lines.numbers[order])
    elif completed := with_absent(sent, delays):
        sent, delays = completed
        absent = len(sent) - len(order)
    else:
        tells_losses = bool(np.isnan(delays).any())
    _require_likely_units(columns, lines, sent, delays)
    read_as = _first_sentence(columns, lines)
    if lines.marked:
        mark = shown(_until(columns).name)
        read_as += f" A {mark} of 0 or -1 stands for a lost packet ({counted(lines.marked, 'line')})."
    if missing:
        read_as += f" A number without a line stands for a lost packet ({counted(missing, 'number')})."
    if restarts:
        read_as += f" Numbers begin anew {counted(restarts, 'time')}: packets without a line are not counted there."
    if absent:
        read_as += (
            f" {counted(absent, 'packet')} without a line, where one is usually sent every {1000.0 * usual:.4g} ms, "
            "stand for lost ones."
        )
    if not tells_losses:
        read_as += (
            " It does not say which packets were lost: no line marks one, packets have no number, and the times "
            "between them are not regular enough to notice those without a line."
        )
    return Record(sent, delays, read_as + _last_sentences(columns, names), tells_losses)


def _until(columns: dict[str, Column]) -> Column:
    """Returns the column that says how long packets took, by itself or with the time of sending."""
    return columns["received" if "received" in columns else "delay"]


def _lines_of(rows: Iterator[tuple[int, list[str]]], columns: dict[str, Column], width: int) -> _Lines:
    """Returns what lines say, once it is clear in which units.

    Raises:
        ValueError: If a line does not say it, or the lines are not in order.
    """
    sent_at, until, has_arrivals = columns["sent"], _until(columns), "received" in columns
    sent, arrived, delays, marked, at_zero, numbers, flagged, places = [], [], [], [], [], [], [], []
    origin, units, scale, until_scale, dated = Decimal(0), ("", ""), Decimal(1), Decimal(1), False
    zones: set[bool] = set()
    for line, cells in rows:
        cells += (width - len(cells)) * [""]
        if not sent and (dated := is_date(cells[sent_at.index])):
            require_no_unit([sent_at, until] if has_arrivals else [sent_at])
        try:
            start = number_in(cells[sent_at.index], dated=dated)
            end = number_in(cells[until.index], dated=dated and has_arrivals)
            if "number" in columns:
                numbers.append(count_in(cells[columns["number"].index]))
        except ValueError:
            _refuse_line(line, has_arrivals)
        flagged.append(says_lost(line, cells, columns))
        if start is None:
            _refuse_line(line, has_arrivals)
        if dated:
            moments = [cells[each.index] for each in ([sent_at, until] if has_arrivals else [sent_at])]
            zones.update(has_zone(each) for each in moments if is_date(each))
            if len(zones) > 1:
                raise ValueError(
                    f"line {line}: some times name their time zone and others, which would be read in UTC, do not: "
                    "write it into all of them"
                )
        if not sent:
            units = _units_in(columns, start)
            scale, until_scale = (UNITS[unit] for unit in units)
            origin = start * scale
            named = sent_at.unit or (has_arrivals and until.unit)
            require_moment(cells[sent_at.index], origin, is_guessed=not named and units[0] != "s")
        start *= scale
        places.append(line)
        sent.append(float(start - origin))
        if end is None:
            arrived.append(np.nan)
            delays.append(np.nan)
            continue
        if end in MARKS and (not has_arrivals or start > end):  # a lost packet, marked by a number
            marked.append(len(delays))
        elif end == start == 0:  # as in the other lines, if zeros are marks there
            at_zero.append(len(delays))
        delay = end * until_scale - start if has_arrivals else end * until_scale
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
        read_in = "" if until.unit else f" ({shown(until.name)} was read in {units[1]})"
        raise ValueError(f"line {places[int(np.argmax(delays < 0.0))]}: {BEFORE}{read_in}")
    return _Lines(moments, delays, np.array(numbers), np.array(places), len(marked), origin, units)


def _units_in(columns: dict[str, Column], first: Decimal) -> tuple[str, str]:
    """Returns the units of both columns, by their names or by the first moment.

    Raises:
        ValueError: If the unit of one of them cannot be told.
    """
    by = "received" if "received" in columns else "delay"
    if by == "delay":
        require_units(columns["sent"], columns["delay"], first)
    return units_of(columns["sent"], columns[by], by, first)


def _require_likely_units(columns: dict[str, Column], lines: _Lines, sent: np.ndarray, delays: np.ndarray) -> None:
    """Raises ValueError where no name says a unit, and packets would be too close or too slow if it were seconds."""
    until = _until(columns)
    guessed = not columns["sent"].unit and lines.units[0] == "s" and not until.unit
    if guessed and abs(lines.origin) < YEARS[0] and 0.0 < median_gap(sent) < _CLOSEST:
        raise ValueError(
            f"its packets would be sent every {median_gap(sent):.3g} s, if times were seconds: write the unit into "
            "the names of the columns (sent_ms), and the days of a spreadsheet as seconds"
        )
    delay_is_guessed = not until.unit and ("received" not in columns or guessed)
    if delay_is_guessed and (median := float(np.nanmedian(np.append(delays, -np.inf)))) >= 1.0:
        raise ValueError(
            f"the names of the columns say no unit, and packets would take {median:.4g} s as a rule: name it, as in "
            "sent_ms and received_ms, or sent_s and received_s; if it is seconds, is one clock set by the other?"
        )


def _first_sentence(columns: dict[str, Column], lines: _Lines) -> str:
    unit, until_unit = lines.units
    epoch = "" if lines.origin < YEARS[0] else ", times since 1970"
    names = shown(columns["sent"].name), shown(_until(columns).name)
    return f"Read as a table: {names[0]} in {unit}, {names[1]} in {until_unit}{epoch}."


def _last_sentences(columns: dict[str, Column], names: Sequence[str]) -> str:
    """Returns what is said of columns that are not used, or of which only a part is."""
    used = {each.index for each in columns.values()}
    unused = [shown(name) for index, name in enumerate(names) if index not in used]
    said = ""
    if {"received", "delay"} <= columns.keys():
        said += f" Of {shown(columns['delay'].name)} only what it marks as lost is used."
    return said + (f" Not used: {', '.join(unused)}." if unused else "")


def _require_order(sent: np.ndarray, arrived: np.ndarray, lines: Sequence[int]) -> None:
    """Raises ValueError if rows are neither in the order of sending nor, those that were overtaken, in that of arrival.

    Sorting them would hide that a clock was set back. A lost packet was not known before it was sent.
    """
    newest = np.maximum.accumulate(sent)
    logged = np.where(np.isnan(arrived), sent, arrived)
    late = sent < newest
    back = late & (np.isnan(arrived) | (logged < np.maximum.accumulate(logged)))
    since = np.arange(len(late)) - np.maximum.accumulate(np.where(late, 0, np.arange(len(late))))
    back |= since > MOST_LATE  # as many were overtaken by one: the sender's clock was set back
    if not back.any():
        return
    at = int(np.argmax(back))
    if since[at] > MOST_LATE:
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
    taken, arrived, many = delays[known], (sent + delays)[known], MOST_LATE + 1
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


def _refuse_line(number: int, has_arrivals: bool) -> NoReturn:
    second = "a time received" if has_arrivals else "a delay"
    raise ValueError(f"line {number} is not a time sent and {second}")
