"""Files with recorded packets: the ages are those of the times in them, and what is not certain is refused."""

from __future__ import annotations

import codecs
import math
import re
import sys
import textwrap
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ncs_gym import PacketLog, contract_of, truck_trailer
from tests.product import loop_env

PAGE = Path(__file__).parents[3] / "docs" / "contracts.md"


def ages_by_clock(packets, dt):
    """Looks at every packet at every step; packets are pairs of when sent and when received, None if never [s]."""
    packets = [(Fraction(sent), None if received is None else Fraction(received)) for sent, received in packets]
    dt, begins = Fraction(dt), min(Fraction(sent) for sent, _ in packets)
    ends = max(sent for sent, _ in packets)
    ages, now = [], begins
    while now <= ends:
        age = (now - begins) / dt  # of the first estimate
        step = begins
        while step <= now:
            sample = next((packet for packet in packets if step <= packet[0] < step + dt), None)
            if sample is not None and sample[1] is not None and sample[1] <= now:
                age = min(age, math.ceil((now - sample[0]) / dt))
            step += dt
        ages.append(int(age))
        now += dt
    return ages


class Kind(NamedTuple):
    text: str | bytes
    packets: list
    dt: str


def times(every, delays, begins="0"):
    """Packets sent at equal distances, by their delays."""
    sent = [Fraction(begins) + i * Fraction(every) for i in range(len(delays))]
    return [(s, None if d is None else s + Fraction(d)) for s, d in zip(sent, delays, strict=True)]


LINUX = "PING host (192.0.2.1) 56(84) bytes of data.\n"
HOST = "192.0.2.1"


def at(moment):
    """A stamp of ping -D, so long after a moment of 2023 [s]."""
    seconds, micros = divmod(round(Fraction(moment) * 10**6), 10**6)
    return f"[{1700000000 + seconds}.{micros:06d}] "


def reply(number, sent, delay, host=HOST):
    """A line of ping -D: the number of a packet, when it was sent, and how long its answer took [s]."""
    delay = Fraction(delay)
    time = f"{float(1000 * delay):.3f}".rstrip("0").rstrip(".")
    return f"{at(Fraction(sent) + delay)}64 bytes from {host}: icmp_seq={number % 65536} ttl=64 time={time} ms\n"


def ended(lines, transmitted, header=LINUX, more=""):
    """A run of ping with so many packets, of which those with a line were answered."""
    received = len(re.findall(r" ms$", lines, re.MULTILINE))
    return (
        f"{header}{lines}\n--- host ping statistics ---\n{transmitted} packets transmitted, {received} received{more}, "
        "42.4242% packet loss, time 400ms\nrtt min/avg/max/mdev = 1/2/3/4 ms, pipe 2\n"
    )


def run(answers, transmitted, **keywords):
    return ended("".join(reply(*each) for each in answers), transmitted, **keywords)


KINDS = {
    "table with packets between the steps": Kind(
        "sent,received\n0,0.01\n0.1,0.12\n0.2,\n6.33,6.34\n6.43,6.44\n6.53,6.54\n",
        [("0", ".01"), (".1", ".12"), (".2", None), ("6.33", "6.34"), ("6.43", "6.44"), ("6.53", "6.54")],
        "0.1",
    ),
    "table of a spreadsheet with columns in another order": Kind(
        codecs.BOM_UTF8 + b'"received","sent"\r\n0.012,0\r\n,0.02\r\n,0.04\r\n0.099,0.06\r\n0.095,8E-2\r\n',
        times("0.02", ["0.012", None, None, "0.039", "0.015"]),
        "0.02",
    ),
    "table with several packets in a step, and a clock before 0": Kind(
        "sent,received\n-0.007,0.023\n0,0.001\n0.007,\n0.014,\n0.021,0.022\n0.042,0.053\n0.049,0.05\n0.07,0.071\n",
        [
            *(("-0.007", "0.023"), ("0", "0.001"), ("0.007", None), ("0.014", None), ("0.021", "0.022")),
            *(("0.042", "0.053"), ("0.049", "0.05"), ("0.07", "0.071")),
        ],
        "0.02",
    ),
    "ping with a late answer, duplicates, and lines of what was not answered": Kind(
        ended(
            reply(1, 0, "0.012")
            + reply(1, "0.001", "0.012").replace("ms\n", "ms (DUP!)\n")
            + f"{at('0.1')}no answer yet for icmp_seq=2\n"
            + reply(4, "0.6", "0.012")
            + reply(2, "0.2", "0.5")
            + f"{at('0.75')}From 192.0.2.9 icmp_seq=3 Destination Host Unreachable\nping: sendmsg: No route to host\n"
            + f"{at('0.76')}From router (192.0.2.9) icmp_seq=3 Time to live exceeded\n"
            + reply(6, 1, "0.012"),
            6,
            more=", +1 duplicates, +2 errors",
        ),
        times("0.2", ["0.012", "0.5", None, "0.012", None, "0.012"]),
        "0.1",
    ),
    "ping of a host with a name over IPv6, stopped on a terminal": Kind(
        run(
            [(1, 0, "0.012", "a.example (2001:db8::1)"), (2, 1, "0.150", "a.example (2001:db8::1)")],
            2,
            header="PING a.example(a.example (2001:db8::1)) 56 data bytes\n",
        )
        .replace("\n\n---", "\n^C\n---")
        .replace("\n", "\r\n"),
        times("1", ["0.012", "0.15"]),
        "0.05",
    ),
}


@pytest.fixture
def written(tmp_path):
    def write(content):
        (tmp_path / "record").write_bytes(content if isinstance(content, bytes) else content.encode())
        return tmp_path / "record"

    return write


@pytest.mark.parametrize("name", KINDS)
def test_ages_are_those_of_the_times_in_the_file(name, written):
    kind = KINDS[name]
    log = PacketLog.load(written(kind.text))
    expected = ages_by_clock(kind.packets, kind.dt)
    assert log.ages(float(kind.dt)).tolist() == expected
    assert len(log.sent) == len(kind.packets)
    gaps = np.diff(sorted(float(Fraction(sent)) for sent, _ in kind.packets))
    assert log.period == pytest.approx(np.median(gaps[gaps > 0.0]))
    assert np.isnan(log.delays).tolist() == [received is None for _, received in kind.packets]
    assert log.read_as.startswith("Read as the output of ping -D: delays are" if "ping" in name else "Read as a table")
    promised = contract_of(log.channel(float(kind.dt)))
    assert promised is not None
    assert promised.max_age >= max(expected)


def test_parquet_is_read_as_csv_is(written, tmp_path, monkeypatch):
    table, file = pd.DataFrame({"sent": [0, 1, 2, 3], "received": [0.5, np.nan, 3.25, 3.5]}), tmp_path / "table"
    table.to_parquet(file, index=False)
    log, csv = PacketLog.load(file), PacketLog.load(written(table.to_csv(index=False)))
    np.testing.assert_array_equal([log.sent, log.delays], [csv.sent, csv.delays])
    with pytest.raises(ValueError, match="it is no Parquet table"):
        PacketLog.load(written(file.read_bytes()[:-9]))
    for wrong, words in (
        (table.assign(size=60), "are ['sent', 'received', 'size']; a record is a table"),
        (table.assign(sent=pd.to_datetime(table.sent, unit="s")), "not numbers of 64 bits; a record"),
        (table.assign(sent=table.received), "packet 2 has no time of sending"),
    ):
        wrong.to_parquet(file, index=False)
        with pytest.raises(ValueError, match=re.escape(words)):
            PacketLog.load(file)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ValueError, match="is read with pyarrow: install it, or write the table as CSV"):
        PacketLog.load(file)


RUN = [(n, n, "0.01") for n in range(1, 6)]
LINES, PING = "".join(reply(*each) for each in RUN), run(RUN, 5)
WHOLE = "ends with the statistics of one run in English, which say how many"
BACK = [(n, n if n < 18 else n - 2, "0.01") for n in range(1, 40) if not 18 <= n < 22]
# What was once guessed: answers of another host, rows of several senders, dates as stamps, a failure to send.
REFUSED = [
    (PING.replace(f"{HOST}: icmp_seq=3", "10.0.0.99: icmp_seq=3"), "line 4 is an answer of another host, '10.0.0.99'"),
    ("sent,received,can_id\n0,0.1,1\n1,1.1,2\n2,2.1,1\n", "are ['sent', 'received', 'can_id']"),
    ("sent,received\n0,0.01\n1,0.01\n", "packet 2 arrived before it was sent: the clocks"),
    (PING.replace(at("2.01"), "[2024-05-27 12:04:44.268336] "), "line 3 is none of Linux ping -D in English, '[2024-"),
    (ended(LINES + "PING: transmit failed. General failure.\n", 6), "line 7 is none of Linux ping -D in English"),
    # Other runs, other programs, and lines that are missing.
    (run(RUN, 5, header="PING host (192.0.2.1): 56 data bytes\n"), "line 1 is not what Linux ping begins with"),
    (2 * PING, WHOLE),
    (run(RUN, 5, more=", +1 corrupted"), WHOLE),
    (run([*RUN, (6, 30_000, "0.01")], 99_999), "its numbers do not count packets: a pause is too long, or it has"),
    (PING.replace(reply(*RUN[2]), ""), "its statistics have 5 packets and 5 answers, its lines 5 and 4: lines"),
    (run(RUN[:1], 5), "at least two packets that were answered"),
    (run([(n, 0, "0.01") for n in range(1, 5)], 4), "its packets were not sent one after the other"),
    # Clocks that were set back.
    (ended("ping: Warning: time of day goes back (-2us), taking countermeasures\n" + LINES, 5), "line 2 is none of"),
    (run([*RUN, (6, 3, "0.01")], 6), "line 7: the clock was set back by 2000000 us: record anew"),
    (run(BACK, 39), "between the packets 17 and 22 its stamps leave too little time for the lost ones"),
    ("sent,received\n0,1\n5,\n3,4\n", "packet 3 was sent before the one above: sort the rows by sent"),
    # Tables.
    (codecs.BOM_UTF16_LE + "sent,received\n0,1\n".encode("utf-16-le"), "it is no text in UTF-8"),
    ("sent,received\n0,02,0,03\n", "line 2 has not 2 cells"),
    ("sent,received\n0,nan\n1,2\n", "line 2: 'nan' is no number"),
    ('sent,received\n0,"1\n', "line 2 is not of a CSV file"),
    ("sent,received\n0,1\n,2\n", "packet 2 has no time of sending"),
    ("sent,received\n0,1\n1,1e999\n", "packet 2 has times that are too large for seconds"),
    ("sent,received\n0,1\n", "at least two packets"),
    ("sent,received\n0,1\n0,2\n", "one after the other"),
]


@pytest.mark.parametrize(("content", "words"), REFUSED)
def test_file_that_is_not_certain_is_refused_in_one_sentence(content, words, written):
    with pytest.raises(ValueError, match=re.escape(words)) as refusal:
        PacketLog.load(written(content))
    assert "\n" not in str(refusal.value)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    name=st.sampled_from(sorted(KINDS)),
    edits=st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=4)), min_size=1, max_size=6),
)
def test_damaged_file_is_read_or_refused_in_one_sentence(name, edits, written):
    content = KINDS[name].text
    content = bytearray(content if isinstance(content, bytes) else content.encode())
    for place, new in edits:
        place %= len(content)
        content[place : place + max(len(new), 1)] = new
    try:
        assert PacketLog.load(written(bytes(content))).read_as
    except ValueError as error:
        assert "\n" not in str(error)  # noqa: PT017


PLANT = truck_trailer(dt=1.0)
RECORDS = st.lists(
    st.tuples(st.integers(0, 9), st.one_of(st.none(), st.integers(0, 20))), min_size=2, max_size=9
).filter(lambda record: any(gap for gap, _ in record[1:]))


@settings(max_examples=10, deadline=None)
@given(record=RECORDS)
def test_replay_in_an_environment_has_the_ages_of_the_record(record):
    sent = np.cumsum([0, *(gap for gap, _ in record[1:])]) / 4  # in quarters of a step
    received = [None if delay is None else start + delay / 4 for start, (_, delay) in zip(sent, record, strict=True)]
    log = PacketLog(sent, np.array([np.nan if r is None else r - s for s, r in zip(sent, received, strict=True)]))
    ages = log.ages(1.0)
    assert ages.tolist() == ages_by_clock(list(zip(sent, received, strict=True)), "1")
    promised = contract_of(log.channel(1.0))
    assert promised is None or ages.max() <= promised.max_age
    env, replayed = loop_env(PLANT, channel=log.channel(1.0), terminate_on_violation=False), ()
    seeds = iter(range(200))  # the replay begins with a random sample
    while replayed != tuple(ages[1:].tolist()):
        env.reset(seed=next(seeds))
        replayed = tuple(env.step(np.zeros(1))[4]["measurement_age"] for _ in range(len(ages) - 1))


@pytest.mark.parametrize(
    "answered",
    [
        [*range(1, 9), *range(32000, 32009), *range(65000, 65535), 65536, 65535, *range(65537, 65600)],  # a late answer
        [*range(1, 9), 65544, 65545],  # the same number again
    ],
)
def test_numbers_of_ping_go_on_after_16_bits(answered, written):
    # The second of two that were overtaken was answered after the other.
    delays = [
        "1.5" if after < number else "0.009" for number, after in zip(answered, [*answered[1:], 10**6], strict=True)
    ]
    lines = sorted((Fraction(n) + Fraction(d), n, d) for n, d in zip(answered, delays, strict=True))
    log = PacketLog.load(written(run([(n, n, d) for _, n, d in lines], answered[-1] + 2)))
    assert np.flatnonzero(np.isfinite(log.delays)).tolist() == sorted(n - 1 for n in answered)
    assert len(log.sent) == answered[-1] + 2
    assert np.allclose(np.diff(log.sent), 1.0)


def test_stamp_that_was_printed_late_makes_no_packet_fresher(written):
    lines = [("0.1", "0.1"), ("1.1", "0.1"), ("3.15", "0.1"), ("3.2", "0.2"), ("4.1", "0.1")]  # the third was late
    answers = [(n, Fraction(moment) - Fraction(delay), delay) for n, (moment, delay) in enumerate(lines, 1)]
    log = PacketLog.load(written(run(answers, 5)))
    assert log.sent[2] == log.sent[3]
    assert np.allclose(log.sent + log.delays, [float(moment) for moment, _ in lines])


def test_sample_that_is_later_than_any_channel_allows_counts_as_lost():
    log = PacketLog(np.arange(1500.0), np.array([*2 * [np.nan], 1000.0, 1001.0, *1496 * [np.nan]]))
    assert log.trace(1.0)[:4] == (-1, -1, 1000, -1)
    assert log.ages(1.0)[[1001, 1002, 1499]].tolist() == [1001, 1000, 1497]


def test_span_and_number_of_packets_that_disagree_are_named(written):
    rows = "".join(
        f"{sent},{sent + 0.01}\n" for sent in [0.1 * i for i in range(100)] + [75.0 + 0.1 * i for i in range(9)]
    )
    log = PacketLog.load(written("sent,received\n" + rows))
    assert "would be 759 packets, the record has 109" in log.disagreement
    assert "in one pause, 65.1 s at the longest" in log.disagreement
    assert log.ages(0.1).max() == 651  # one sent at 9.9 s is the newest until 75.1 s
    promised = contract_of(log.channel(0.1))
    assert promised is not None
    assert promised.max_age == 651


class Bag:
    """What a recipe needs of `AnyReader`: messages of two topics, of which those of one have a stamp 10 ms old."""

    def messages(self):
        for topic, at in (("/imu", 1), ("/odom", 2), ("/imu", 3), ("/imu", 5)):
            yield SimpleNamespace(topic=topic, msgtype="Imu"), at * 10**9 + 10**7, at

    def deserialize(self, raw, msgtype):
        return SimpleNamespace(header=SimpleNamespace(stamp=SimpleNamespace(sec=raw, nanosec=0)))


EPOCH = 1_700_000_000
RECIPES = {
    "a column of delays, all in milliseconds": {"delays.csv": "sent,delay,size\n0,1000,60\n2000,,60\n3000,500,60\n"},
    "dates": {
        "dates.csv": "sent,received\n2026-01-01T00:00:00.5Z,2026-01-01T00:00:01.5Z\n2026-01-01T00:00:02.5Z,\n"
        "2026-01-01T01:00:03.5+01:00,2026-01-01T00:00:04Z\n"
    },
    "tcpdump at both ends": {
        "sent.txt": f"{EPOCH}.000000000\t01ff\n{EPOCH + 2}.000000000\t02ff\n{EPOCH + 3}.000000000\t03ff\n",
        "received.txt": f"{EPOCH + 1}.000000000\t01ff\n{EPOCH + 3}.500000000\t03ff\n{EPOCH + 4}.0\t03ff\n",
    },
    "a bag of ROS 2": {},
}


@pytest.mark.parametrize("name", RECIPES)
def test_recipe_of_the_page_makes_a_record(name, tmp_path, monkeypatch):
    recipes = PAGE.read_text().partition("makes a table `t`")[2]
    head, *parts = re.split(r"^    # ", recipes.partition(":\n")[2], flags=re.MULTILINE)
    (recipe,) = (part for part in parts if part.startswith(name))
    for file, text in RECIPES[name].items():
        (tmp_path / file).write_text(text)
    monkeypatch.chdir(tmp_path)
    values = {"bag": Bag()}
    exec(textwrap.dedent(head + "    # " + recipe), values)
    values["t"].to_csv("packets.csv", index=False)
    log = PacketLog.load("packets.csv")
    if name == "a bag of ROS 2":
        assert (log.sent.tolist(), log.delays.round(9).tolist()) == ([1.0, 3.0, 5.0], 3 * [0.01])
        return
    assert np.allclose(log.delays[[0, -1]], [1.0, 0.5])
    assert np.isnan(log.delays[1])
    assert np.allclose(log.sent - log.sent[0], [0.0, 2.0, 3.0])
