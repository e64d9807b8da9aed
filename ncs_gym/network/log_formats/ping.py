"""The output of ping and fping: of Linux, BusyBox, macOS and Windows."""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import Decimal
from typing import NamedTuple

import numpy as np

from ncs_gym.network.log_formats.record import MOST_LATE, WAY_AND_BACK, Record, require_time
from ncs_gym.reading import require_packets
from ncs_gym.validation import counted, shown

# Longer lines are not ping's [characters].
_LONGEST_LINE = 1000
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
# nobody waits for.
_NUMBERS, _LATEST = 65536, 1024
# Who is sent later than the newest by more than this is no late one, whenever its answer was printed [s].
_PRINTED = 1.0
# Windows waits so long for an answer before it sends the next packet, unless told otherwise [s].
_WINDOWS_TIMEOUT = 4.0


class _Summary(NamedTuple):
    transmitted: int
    received: int
    duration: float | None


def is_ping(text: str) -> bool:
    """Returns whether a text is the output of one of these programs."""
    return any(each.search(text) for each in (_ANY_PING, _ANY_FPING, _ANY_WINDOWS))


def of_ping(text: str, period: float | None) -> Record:
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
    header = next((line for line in lines if line.startswith("PING")), None)
    answers, stamps = _answers_of(lines, pattern, program, has_header=header is not None)
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
    if before := min(answers) - first:
        notes += f" Its first answer has the number {min(answers)}: {before:,} before it count as lost."
    return Record(sent, delays, f"Read as the output of {program}: {WAY_AND_BACK}, packets were {how}.{notes}")


def _answers_of(
    lines: Sequence[str], pattern: re.Pattern[str], program: str, *, has_header: bool
) -> tuple[dict[int, float], dict[int, float]]:
    """Returns how long the answer to each number took, NaN for none, and when those with a stamp were sent [s].

    Numbers begin anew after the largest one of 16 bits: what is returned goes on.

    Raises:
        ValueError: If a clock was set back, the lines are of several runs or hosts, or none has a number.
    """
    answers: dict[int, float] = {}
    stamps: dict[int, float] = {}
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
            if too_late or late > MOST_LATE or (has_header and number < 0):
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
    return answers, stamps


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
        f"Read as the output of ping on Windows: {WAY_AND_BACK}; a packet was sent {every:g} s after the one before, "
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
    require_time(known, times)
    steps, gaps = np.diff(known), np.diff(times)
    slope = float(np.median(gaps / steps))
    sent = np.interp(numbers, known, times)
    before, after = numbers < known[0], numbers > known[-1]
    sent[before] = times[0] - slope * (known[0] - numbers[before])
    sent[after] = times[-1] + slope * (numbers[after] - known[-1])
    return sent


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
        f" Its summary has {counted(summary.transmitted, 'packet')} and {counted(summary.received, 'answer')}, its "
        f"lines {len(delays):,} and {answers:,}: lines are missing or are counted twice."
    )
