"""Tables of packets with named columns: times of sending and arrival, steps of `ncs loop`, lists of delays."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from decimal import Decimal
from typing import NoReturn

import numpy as np

from ncs_gym.network.log_formats.cells import (
    MARKS,
    MOMENTS,
    SUFFIX,
    UNITS,
    YEARS,
    Column,
    are_flags,
    columns_of,
    count_in,
    different_cells,
    is_date,
    is_number,
    number_in,
    plain,
    require_decimals,
    require_moment,
    require_no_loss,
    require_no_unit,
    require_units,
    rows_of,
    says_lost,
    units_of,
)
from ncs_gym.network.log_formats.record import MOST_LATE, Record, require_time
from ncs_gym.reading import require_packets
from ncs_gym.validation import shown

_BEFORE = "the packet arrived before it was sent: the clocks of sender and receiver differ, set one by the other"
# Packets closer to each other are in another unit than seconds, as in the days of spreadsheets [s].
_CLOSEST = 1e-4
# A sender is regular if so many of the times between packets, and at least so many, differ by no more than this from
# multiples of the usual one. Where more periods have no packet, it paused.
_REGULAR_SHARE, _FEWEST, _IRREGULAR, _LONGEST_ABSENCE = 0.9, 20, 0.25, 100


def of_table(lines: Sequence[str], period: float | None, step: float) -> Record:
    """Returns the packets of a table whose columns have names, or of one number per line."""
    if lines and re.fullmatch(r"sep=.", lines[0].strip()):  # for spreadsheets
        lines = ["", *lines[1:]]
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
    names = next((cells for _, cells in rows_of([line], separator, 1, with_empty=True)), [])
    if all(is_number(name) for name in names):
        if len(names) == 1:
            require_decimals(rows_of(lines, separator, 1, with_empty=True), [0])
            return _of_list(rows_of(lines, separator, 1, with_empty=True), period)
        raise ValueError(
            "its columns have no names, and neither their order nor their unit can be guessed safely: write them into "
            "the first line, as in sent_ms,received_ms"
        )
    columns = columns_of(names)
    first = len(lines) - len(rest) + 1
    is_list = set(columns) - {"lost", "kept"} == {"delay"}

    def rows() -> Iterator[tuple[int, list[str]]]:
        return rows_of(rest, separator, first, len(names), with_empty=is_list)

    cells = different_cells(rows(), len(names))
    if (
        {"received", "delay"} <= columns.keys()
        and "kept" not in columns
        and are_flags(cells[columns["received"].index])
    ):
        columns["kept"] = columns.pop("received")
    used = {each.index for each in columns.values()}
    unused = {index: name for index, name in enumerate(names) if index not in used}
    require_decimals(rows(), [each.index for role, each in columns.items() if role in ("sent", "received", "delay")])
    if {"episode", "sent", "received"} <= columns.keys():
        _require_steps(columns, unused)
        return _of_steps(rows(), columns, step)
    moments = [name for name in unused.values() if SUFFIX.sub("", plain(name)) in MOMENTS]
    if "delay" in columns or {"sent", "received"} <= columns.keys():
        for index, name in unused.items():
            if name not in moments:
                require_no_loss(name, cells[index])
    if "sent" in columns and ("received" in columns or "delay" in columns):
        return _of_times(rows(), columns, names)
    if set(columns) - {"number", "lost", "kept"} == {"delay"}:
        if moments:
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


def _of_times(rows: Iterator[tuple[int, list[str]]], columns: dict[str, Column], names: Sequence[str]) -> Record:
    """Returns the packets of a table with the time at which each was sent, and that of its arrival or its delay."""
    sent_at, by = columns["sent"], "received" if "received" in columns else "delay"
    until = columns[by]
    sent, arrived, delays, marked, at_zero, numbers, flagged, places = [], [], [], [], [], [], [], []
    origin, unit, until_unit, scale, until_scale = Decimal(0), "", "", Decimal(1), Decimal(1)
    dated = False
    for line, cells in rows:
        cells += (len(names) - len(cells)) * [""]
        if not sent and (dated := is_date(cells[sent_at.index])):
            require_no_unit([sent_at, until] if by == "received" else [sent_at])
        try:
            start = number_in(cells[sent_at.index], dated=dated)
            end = number_in(cells[until.index], dated=dated and by == "received")
            if "number" in columns:
                numbers.append(count_in(cells[columns["number"].index]))
        except ValueError:
            _refuse_line(line, by)
        flagged.append(says_lost(line, cells, columns))
        if start is None:
            _refuse_line(line, by)
        if not sent:
            if by == "delay":
                require_units(sent_at, until, start)
            unit, until_unit = units_of(sent_at, until, by, start)
            scale, until_scale = UNITS[unit], UNITS[until_unit]
            origin = start * scale
            named = sent_at.unit or (by == "received" and until.unit)
            require_moment(cells[sent_at.index], origin, is_guessed=not named and unit != "s")
        start *= scale
        places.append(line)
        sent.append(float(start - origin))
        if end is None:
            arrived.append(np.nan)
            delays.append(np.nan)
            continue
        if end in MARKS and (by == "delay" or start > end):  # a lost packet, marked by a number
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
    if guessed and abs(origin) < YEARS[0] and 0.0 < _median_gap(moments) < _CLOSEST:
        raise ValueError(
            f"its packets would be sent every {_median_gap(moments):.3g} s, if times were seconds: write the unit into "
            "the names of the columns (sent_ms), and the days of a spreadsheet as seconds"
        )
    if delay_is_guessed and float(np.nanmedian(np.append(delays, -np.inf))) >= 1.0:
        raise ValueError(
            "the names of the columns say no unit, and most packets would take more than a second: name it, as in "
            "sent_ms and received_ms, or sent_s and received_s"
        )
    epoch = "" if origin < YEARS[0] else ", times since 1970"
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
    if {"received", "delay"} <= columns.keys():
        read_as += f" Of {shown(columns['delay'].name)} only what it marks as lost is used."
    if unused:
        read_as += f" Not used: {', '.join(unused)}."
    return Record(moments, delays, read_as)


def _median_gap(sent: np.ndarray) -> float:
    gaps = np.diff(sent)
    return float(np.median(gaps[gaps > 0.0])) if gaps.any() else 0.0


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
    require_time(numbers, sent)
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
        sent, arrived, _ = _with_missing(every * (np.array(numbers) - numbers[0]), arrived, np.array(numbers))
    name = "one number per line" if columns is None else shown(column.name)
    read_as = f"Read as a list of delays: {name}, in {column.unit}, packets sent every {1000.0 * every:.4g} ms"
    read_as += " (the file does not say)." if period is None else "."
    if marked:
        read_as += f" 0, -1 or an empty line stands for a lost packet ({_many(marked, 'line')})."
    return Record(sent, arrived, read_as)


def _many(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"
