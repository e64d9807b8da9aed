"""Files with recorded packets: each kind gives the ages that follow from the times in it, and says how it was read."""

from __future__ import annotations

import codecs
import copy
import datetime
import json
import math
import pickle
import re
import time
from decimal import Decimal
from fractions import Fraction
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ncs_gym import NCSEnv, PacketLog, contract_of, truck_trailer


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
    said: str  # words of how it was read
    period: float | None = None


def times(every, delays, begins="0"):
    """Packets sent at equal distances, by their delays."""
    sent = [Fraction(begins) + i * Fraction(every) for i in range(len(delays))]
    return [(s, None if d is None else s + Fraction(d)) for s, d in zip(sent, delays, strict=True)]


def ping(answers):
    return "".join(f"64 bytes from 192.0.2.1: icmp_seq={i} ttl=64 time={time} ms\n" for i, time in answers)


def stamped(answers):
    """Output of ping -D; the numbers of packets, and when each was answered."""
    return "".join(f"[{1700000000 + at}.012] {ping([(n, 9)])}" for n, at in answers)


def rows(names, *runs, in_order=False):
    """A table of packets, each 10 ms on its way, by their times or their numbers and times."""
    packets = [each if isinstance(each, tuple) else (i, each) for run in runs for i, each in enumerate(run)]
    packets = sorted(packets, key=lambda each: each[1]) if in_order else packets
    number, until = "{0}," * names.startswith("seq"), "0.01" if names.endswith("rtt") else "{2:.2f}"
    return f"{names}\n" + "".join(f"{number}{{1}},{until}\n".format(n, at, at + 0.01) for n, at in packets)


def irtt_sent(*moments):
    """JSON of irtt, by when each was sent [ms]."""
    return json.dumps(
        {
            "round_trips": [
                {"lost": "false", "timestamps": {"client": {"send": {"wall": 10**6 * ms}}}, "delay": {"rtt": 10**6}}
                for ms in moments
            ]
        }
    )


LINUX = "PING host (192.0.2.1) 56(84) bytes of data.\n"
MACOS = "PING host (192.0.2.1): 56 data bytes\n"
STAMPED = {1: "0.00", 2: "0.05", 3: "0.10", 4: "7.40", 5: "7.45", 7: "7.55"}
IRTT = [(0, 0.017), (20, None), (40, 0.05), (95, 0.001), (100, 0.001), (120, 0.002)]

KINDS = {
    "ping with packets that are lost after the last answer": Kind(
        f"{LINUX}{ping([(1, 12.3), (2, 80), (4, 12)])}\n--- host ping statistics ---\n"
        "9 packets transmitted, 3 received, 66.6667% packet loss, time 400ms\nrtt min/avg/max/mdev = 1/2/3/4 ms\n",
        times("0.05", ["0.0123", "0.08", None, "0.012", *5 * [None]]),
        "0.05",
        "sent every 50 ms by the duration in its summary",
    ),
    "ping with an answer after no answer yet": Kind(
        f"{LINUX}{ping([(1, 12)])}no answer yet for icmp_seq=2\n{ping([(3, 11), (2, 1015), (3, 9)])}"
        f"From 192.0.2.9 icmp_seq=4 Destination Host Unreachable\n{ping([(5, 11)])}",
        times("1", ["0.012", "1.015", "0.011", None, "0.011"]),
        "0.5",
        "sent every second",
    ),
    "ping -D with a pause, and no packet on a multiple of the step": Kind(
        "".join(f"[{Decimal('1700000010.012') + Decimal(sent)}] " + ping([(i, "12.0")]) for i, sent in STAMPED.items()),
        [(sent, Fraction(sent) + Fraction("0.012")) for sent in STAMPED.values()] + [("7.50", None)],
        "0.07",
        "sent when its stamps say",
    ),
    "ping in another language": Kind(
        f"{LINUX}{ping([(1, '12,3'), (3, '70,1')]).replace('time', 'Zeit')}\n--- host ping-Statistik ---\n"
        "4 Pakete übertragen, 2 empfangen, 50% Paketverlust, Zeit 300ms\n",
        times("0.1", ["0.0123", None, "0.0701", None]),
        "0.05",
        "sent every 100 ms",
    ),
    "ping of BusyBox": Kind(
        f"{MACOS}{ping([(1, 1.234), (3, 2.1)]).replace('icmp_', '')}\n--- host ping statistics ---\n"
        "6 packets transmitted, 2 packets received, 66% packet loss\nround-trip min/avg/max = 1/2/3 ms\n",
        times("0.2", [None, "0.001234", None, "0.0021", None, None]),
        "0.1",
        "sent every 200 ms as asked for",
        0.2,
    ),
    "ping of macOS": Kind(
        f"{MACOS}Request timeout for icmp_seq 0\n{ping([(1, 11)])}Request timeout for icmp_seq 2\n{ping([(2, 1203)])}"
        "Request timeout for icmp_seq 3\n\n--- host ping statistics ---\n"
        "6 packets transmitted, 2 packets received, 66.7% packet loss\n",
        times("1", [None, "0.011", "1.203", None, None, None]),
        "0.5",
        "sent every second",
    ),
    "ping of Windows in UTF-16": Kind(
        codecs.BOM_UTF16_LE
        + (
            "\r\nPinging 192.0.2.1 with 32 bytes of data:\r\nReply from 192.0.2.1: bytes=32 time=12ms TTL=57\r\n"
            "Request timed out.\r\nReply from 192.0.2.1: bytes=32 time<1ms TTL=57\r\n"
            "Reply from 192.0.2.9: Destination host unreachable.\r\n\r\nPing statistics for 192.0.2.1:\r\n"
            "    Packets: Sent = 5, Received = 2, Lost = 3 (60% loss),\r\n"
        ).encode("utf-16-le"),
        [("0", "0.012"), ("1", None), ("5", "5.001"), ("6", None), ("7", None)],
        "0.5",
        "4 s after one that timed out",
    ),
    "fping with stamps": Kind(
        "[1700000000.10000] h : [0], 64 bytes, 100 ms (100 avg, 0% loss)\n"
        "[1700000001.50000] h : [1], timed out (100 avg, 50% loss)\n"
        "[1700000002.05000] h : [2], 64 bytes, 50.0 ms (75 avg, 33% loss)\n\nh : xmt/rcv/%loss = 4/2/50%, min/avg/max"
        " = 50.0/75.0/100\n",
        times("1", ["0.1", None, "0.05", None]),
        "0.04",
        "output of fping",
    ),
    "table in milliseconds since 1970 with missing numbers": Kind(
        "\ufeffseq,size,send_time_ms,recv_time_ms\r\n7,60,1700000000000,1700000000012\r\n8,60,1700000000020,\r\n"
        "11,60,1700000000080,1700000000095\r\n10,60,1700000000060,1700000000099\r\n",
        times("0.02", ["0.012", None, None, "0.039", "0.015"]),
        "0.02",
        "times since 1970. A number without a line stands for a lost packet (1 number). Not used: 'size'",
    ),
    "table with semicolons, quotes and decimal commas": Kind(
        '"sent";"received"\n"0,00";"0,011"\n"0,02";"NA"\n"0,04";"0,09"\n"0,06";"0,065"\n',
        times("0.02", ["0.011", None, "0.05", "0.005"]),
        "0.02",
        "'sent' in s, 'received' in s",
    ),
    "table in microseconds with several packets in a step": Kind(
        "tx_us\trx_us\n0\t30000\n7000\t8000\n14000\tnan\n21000\t\n28000\t29000\n49000\t60000\n56000\t57000\n"
        "77000\t78000\n98000\t99000\n",
        [
            ("0", "0.03"),
            ("0.007", "0.008"),
            ("0.014", None),
            ("0.021", None),
            ("0.028", "0.029"),
            ("0.049", "0.06"),
            ("0.056", "0.057"),
            ("0.077", "0.078"),
            ("0.098", "0.099"),
        ],
        "0.02",
        "'tx_us' in us",
    ),
    "table with a hole and packets between the steps": Kind(
        "sent,received\n0,.01\n.1,.12\n.2,.21\n6.33,6.34\n6.43,6.44\n6.53,6.54\n",
        [("0", ".01"), (".1", ".12"), (".2", ".21"), ("6.33", "6.34"), ("6.43", "6.44"), ("6.53", "6.54")],
        "0.1",
        "'sent' in s",
    ),
    "table in nanoseconds since 1970 whose lost packets have 0": Kind(
        "sent,received\n1700000000000000000,0\n1700000000020000000,0\n1700000000040000000,1700000000059999000\n"
        "1700000000060000000,1700000000061000000\n1700000000080000000,0\n1700000000100000000,0\n",
        times("0.02", [None, None, "0.019999", "0.001", None, None]),
        "0.02",
        "in ns, times since 1970. A 'received' of 0 or -1 stands for a lost packet (4 lines)",
    ),
    "table with white space, a comment and delays": Kind(
        "# recorded today\n# seq   sent[s]   rtt[ms]\n"
        "  1   0      1.1\n  2   0.02   -\n\n  3   0.04   55\n  4   0.06   2\n",
        times("0.02", ["0.0011", None, "0.055", "0.002"]),
        "0.02",
        "'rtt[ms]' in ms",
    ),
    "table with a comment above its names, and infinity for what never arrived": Kind(
        "# recorded with my script\nsent,received\n0,0.001\n0.02,inf\n0.04,0.1\n",
        times("0.02", ["0.001", None, "0.06"]),
        "0.02",
        "'sent' in s",
    ),
    "table with times of day and a flag": Kind(
        "sent,received,lost\n2026-01-02T23:59:59.990Z,2026-01-03T00:00:00.001Z,false\n"
        "2026-01-03T00:00:00.010Z,2026-01-03T00:00:00.011Z,true\n2026-01-03T00:00:00.030Z,2026-01-03T00:00:00.031Z,0\n",
        [("0", "0.011"), ("0.02", None), ("0.04", "0.041")],
        "0.02",
        "times since 1970",
    ),
    "list of round trips": Kind(
        "12.3\n\n0\n15\ntimeout\n55\n7\n8\n",
        times("0.05", ["0.0123", None, None, "0.015", None, "0.055", "0.007", "0.008"]),
        "0.05",
        "one number per line, in ms, packets sent every 50 ms",
        0.05,
    ),
    "list of round trips with empty lines at both ends": Kind(
        "\n\n12\n\n15\n\n\n",
        times("1", [None, None, "0.012", None, "0.015", None, None]),
        "0.5",
        "an empty line stands for a lost packet (5 lines)",
    ),
    "named list with a flag and empty lines at both ends": Kind(
        "# today\n# rtt_ms,lost\n\n12,no\n,\n15,no\n14,yes\n\n",
        times("1", [None, "0.012", None, "0.015", None, None]),
        "0.5",
        "an empty line stands for a lost packet (3 lines)",
    ),
    "ping -D with duplicates": Kind(
        "".join(f"[{1700000000 + i}.012] " + 2 * ping([(i, "12.0")]) for i in range(1, 4))
        + "[1700000009.5] 64 bytes from 192.0.2.1: icmp_seq=3 ttl=64 time=12.0 ms (DUP!)\n",
        times("1", 3 * ["0.012"]),
        "0.5",
        "sent when its stamps say",
    ),
    "ping -D with a late answer": Kind(
        f"[1700000000.012] {ping([(1, 12)])}[1700000000.212] {ping([(2, 12)])}[1700000000.612] {ping([(4, 12)])}"
        f"[1700000000.700] {ping([(3, 300)])}[1700000000.812] {ping([(5, 12)])}",
        times("0.2", ["0.012", "0.012", "0.3", "0.012", "0.012"]),
        "0.1",
        "sent when its stamps say",
    ),
    "table with rows and columns in any order": Kind(
        "received,size,sent\n0.011,60,0.00\n,60,0.02\n0.065,60,0.06\n0.09,60,0.04\n",
        times("0.02", ["0.011", None, "0.05", "0.005"]),
        "0.01",
        "Not used: 'size'",
    ),
    "table of whole numbers of seconds": Kind(
        "sent_s,received_s\n0,15\n20,\n40,61\n60,71\n", times("20", ["15", None, "21", "11"]), "20", "'sent_s' in s"
    ),
    "table with decimal commas of three digits": Kind(
        "sent\treceived\n0,980\t0,985\n1,000\t1,005\n1,020\t1,025\n",
        times("0.02", ["0.005", "0.005", "0.005"]),
        "0.02",
        "'sent' in s",
    ),
    "named list of round trips": Kind(
        "RTT (µs)\n12300\n-1\n15000\n",
        times("1", ["0.0123", None, "0.015"]),
        "0.5",
        "in us, packets sent every 1000 ms (the file does not say)",
    ),
    "irtt": Kind(
        json.dumps(
            {
                "round_trips": [
                    {
                        "seqno": i,
                        "lost": "true_down" if rtt is None else "false",
                        "timestamps": {"client": {"send": {"wall": 17 * 10**17, "monotonic": 10**6 * ms + 22211105}}},
                        "delay": {} if rtt is None else {"rtt": round(rtt * 1e9)},
                    }
                    for i, (ms, rtt) in enumerate(IRTT)
                ]
            }
        ),
        [(Fraction(ms, 1000), rtt and Fraction(ms, 1000) + Fraction(str(rtt))) for ms, rtt in IRTT],
        "0.02",
        "JSON of irtt",
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
    log = PacketLog.load(written(kind.text), kind.period)
    expected = ages_by_clock(kind.packets, kind.dt)
    assert log.ages(float(kind.dt)).tolist() == expected
    assert len(log.sent) == len(kind.packets)
    gaps = np.diff(sorted(float(Fraction(sent)) for sent, _ in kind.packets))
    assert log.period == pytest.approx(np.median(gaps[gaps > 0.0]))
    assert np.isnan(log.delays).sum() == sum(received is None for _, received in kind.packets)
    assert kind.said in log.read_as
    promised = contract_of(log.channel(float(kind.dt)))
    assert promised is not None
    assert promised.max_age >= max(expected)


def test_first_packet_that_both_times_say_0_is_lost_where_zeros_mark_what_is_lost(written):
    assert np.isnan(PacketLog.load(written("sent,received\n0,0\n1,0\n2,2.1\n")).delays[:2]).all()
    assert PacketLog.load(written("sent,received\n0,0\n1,1.1\n2,2.1\n")).delays[0] == 0.0


@pytest.mark.parametrize("name", ["lost", "Loss", "is_lost", "dropped", "timeout", "missing"])
@pytest.mark.parametrize("table", ["sent_ms,delay_ms,{}\n0,5,0\n20,3,1\n40,5,0\n", "rtt_ms,{}\n5,no\n3,yes\n5,no\n"])
def test_column_marks_what_is_lost(table, name, written):
    assert np.isnan(PacketLog.load(written(table.format(name))).delays).tolist() == [False, True, False]


@pytest.mark.parametrize("name", ["ok", "Success", "acked", "received", "arrived"])
def test_column_marks_what_arrived(name, written):
    log = PacketLog.load(written(f"sent_ms,delay_ms,{name}\n0,5,1\n20,3,0\n40,5,1\n"))
    assert np.isnan(log.delays).tolist() == [False, True, False]
    assert name not in log.read_as


def test_columns_of_other_things_are_left_out(written):
    rows = "0,5,64,1,a\n20,3,60,1,b\n40,5,90,1,c\n"
    log = PacketLog.load(written("sent_ms,delay_ms,size,version,lossless\n" + rows))
    assert "Not used: 'size', 'version', 'lossless'" in log.read_as


@pytest.mark.parametrize("mark", ["-1", "", "timeout", "0"])
def test_delay_beside_the_time_of_arrival_may_mark_what_is_lost(mark, written):
    log = PacketLog.load(written(f"sent_ms,received_ms,delay_ms\n0,5,5\n20,24,{mark}\n40,45,5\n"))
    assert np.isnan(log.delays).tolist() == [False, True, False]
    assert "Of 'delay_ms' only what it marks as lost is used" in log.read_as


@pytest.mark.parametrize(
    "cells", [("good", "bad", "good"), ("64", "0", "64"), ("a", "", "b"), ("1.5", "nan", "1.7"), ("1", "4", "1")]
)
def test_column_that_divides_packets_into_two_kinds_is_refused(cells, written):
    rows = "".join(f"{20 * n},{20 * n + 5},{cell}\n" for n, cell in enumerate(cells))
    with pytest.raises(ValueError, match="'x' may say which packets were lost"):
        PacketLog.load(written("sent_ms,received_ms,x\n" + rows))


def test_dates_say_what_is_lost_as_numbers_do(written):
    start = datetime.datetime(2026, 1, 1)
    ends = ["{}", "NaT", "0", "", "inf", "-1", "{}"]
    times = [((start + datetime.timedelta(seconds=k)).isoformat(), end) for k, end in enumerate(ends)]
    log = PacketLog.load(written("sent,received\n" + "".join(f"{sent},{end.format(sent)}\n" for sent, end in times)))
    assert np.isnan(log.delays).tolist() == [False, *5 * [True], False]
    assert log.sent.tolist() == list(range(7))


def test_duplicates_are_not_taken_off_the_number_of_lost_packets(written):
    log = PacketLog.load(written("seq,sent_ms,delay_ms\n1,0,5\n1,0,6\n2,20,5\n2,20,7\n5,80,5\n"))
    assert "stands for a lost packet (2 numbers)" in log.read_as
    assert np.isnan(log.delays).tolist() == [False, False, True, True, False]


def test_summary_of_windows_adds_no_packet_that_has_a_line(written):
    lines = "".join(f"Reply from 192.0.2.1: bytes=32 time={ms}ms TTL=57\n" for ms in (12, 14, 13))
    text = "Pinging 192.0.2.1 with 32 bytes of data:\n" + lines + "    Packets: Sent = {}, Received = 3, Lost = 0,\n"
    assert len(PacketLog.load(written(text.partition("    Packets")[0])).sent) == 3
    assert len(PacketLog.load(written(text.format(3))).sent) == 3
    assert len(PacketLog.load(written(text.format(5))).sent) == 5


def test_numbers_of_a_list_of_delays_ascend(written):
    log = PacketLog.load(written("seq,rtt_ms\n1,5\n2,6\n4,7\n"), period=0.1)
    assert np.isnan(log.delays).tolist() == [False, False, True, False]
    assert np.allclose(log.sent, [0.0, 0.1, 0.2, 0.3])
    for numbers in ((1, 1, 2), (2, 1, 3)):
        with pytest.raises(ValueError, match="do not ascend"):
            PacketLog.load(written("seq,rtt_ms\n" + "".join(f"{number},5\n" for number in numbers)))


def test_numbers_of_pandas_and_separators_of_spreadsheets_are_read(written):
    log = PacketLog.load(written("sep=;\nseq;sent_ms;delay_ms\n1.0;0;5\n3.0;40;5\n4;60;6\n"))
    assert np.isnan(log.delays).tolist() == [False, True, False, False]


def test_numbers_before_the_first_answer_of_ping_are_named(written):
    log = PacketLog.load(written(LINUX + ping([(4, 12), (5, 13)])))
    assert "Its first answer has the number 4: 3 before it count as lost" in log.read_as
    assert np.isnan(log.delays).tolist() == [True, True, True, False, False]


def test_list_with_three_decimals_may_mark_what_is_lost_by_a_number(written):
    assert np.isnan(PacketLog.load(written("rtt_ms\n18.124\n5.188\n-1\n")).delays).tolist() == [False, False, True]


def test_sample_that_is_later_than_any_channel_allows_counts_as_lost():
    log = PacketLog(np.arange(1500.0), np.array([*2 * [np.nan], 1000.0, 1001.0, *1496 * [np.nan]]))
    assert log.trace(1.0)[:4] == (-1, -1, 1000, -1)
    assert log.ages(1.0)[[1001, 1002, 1499]].tolist() == [1001, 1000, 1497]


def test_share_of_lost_packets_counts_those_of_the_summary(written):
    text = f"{LINUX}{ping([(i, 12) for i in range(1, 701)])}\n1000 packets transmitted, 700 received, 30% packet loss\n"
    log = PacketLog.load(written(text))
    assert (len(log.sent), np.isnan(log.delays).sum()) == (1000, 300)


def test_summary_that_disagrees_is_named(written):
    text = f"{LINUX}{ping([(1, 12), (2, 12)])}\n4 packets transmitted, 3 received, 25% packet loss, time 3000ms\n"
    log = PacketLog.load(written(text), period=0.1)
    assert "although by its summary every 1000 ms" in log.read_as
    assert "4 packets and 3 answers, its lines 4 and 2" in log.read_as


def test_losses_that_a_record_cannot_tell_are_told_as_unknown(written):
    """A receiver's log of a sender with so much jitter, and the same with numbers or with a mark."""
    rng = np.random.default_rng(7)
    sent = 0.02 * np.arange(2000) + rng.uniform(-0.004, 0.004, 2000)
    came = np.flatnonzero(np.append(rng.random(1999) >= 0.02, True))
    lost = 2000 - len(came) - came[0]
    log = PacketLog.load(written("sent,received\n" + "".join(f"{sent[k]},{sent[k] + 0.006}\n" for k in came)))
    assert not log.tells_losses
    assert "It does not say which packets were lost" in log.read_as
    assert "as if samples were lost" in log.disagreement
    numbered = PacketLog.load(
        written("seq,sent,received\n" + "".join(f"{k},{sent[k]},{sent[k] + 0.006}\n" for k in came))
    )
    assert numbered.tells_losses
    assert np.isnan(numbered.delays).sum() == lost
    marks = ["" if k not in set(came) else f"{sent[k] + 0.006}" for k in range(2000)]
    marked = PacketLog.load(written("sent,received\n" + "".join(f"{sent[k]},{marks[k]}\n" for k in range(2000))))
    assert marked.tells_losses
    assert np.isnan(marked.delays).sum() == 2000 - len(came)


def test_columns_that_say_something_else_are_ignored(written):
    rows = "".join(f"{k / 50},{k / 50 + 0.01},{64 * (1 + k % 2)},{k}\n" for k in range(60))
    record = written("sent,received,size,received_ms\n" + rows)
    for ignore, words in (((), "may both be what was received"), (["received_ms"], "'size' may say which packets")):
        with pytest.raises(ValueError, match=words):
            PacketLog.load(record, ignore=ignore)
    log = PacketLog.load(record, ignore=["size", "received_ms"])
    np.testing.assert_allclose(log.delays, 0.01)
    with pytest.raises(ValueError, match="there is no column 'sizes' to ignore"):
        PacketLog.load(record, ignore=["sizes"])
    with pytest.raises(ValueError, match="ignore must be a list"):
        PacketLog.load(record, ignore="size")


def test_times_with_and_without_their_zone_are_not_compared(written):
    rows = "".join(f"2025-06-15T17:06:{k}+02:00,2025-06-15T17:06:{k}.0078\n" for k in range(10, 40))
    with pytest.raises(ValueError, match="line 2: some times name their time zone and others"):
        PacketLog.load(written("sent,received\n" + rows))


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


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("0.0,0.1\n0.2,0.3\n", "no names"),
        ("1 2\n3 4\n", "no names"),
        (",\n0,1\n1,2\n", "no names"),
        ('"#sent";"received"\n0;1\n1;2\n', "no names"),
        ("time,value\n0,1\n1,2\n", "columns 'time', 'value'; a log needs sent and received"),
        ("sent,arrives\n0,1\n1,2\n", "columns 'sent', 'arrives'"),
        ("sent,tx_time,received\n0,0,1\n", "both be what was sent"),
        ("sent,received\n0,02,0,03\n", "line 2 has more columns"),
        ("sent received size\n0 60\n1 2 60\n", "line 2 has 2 columns instead of 3"),
        ("sent,received,lost\n0,1,perhaps\n1,2,no\n", "line 2"),
        ("rtt\n1\n2\n", "'rtt' has no unit"),
        ("sent_ms,delay\n0,5\n20,6\n", "'sent_ms' is in ms and 'delay' has no unit: name it delay_ms or delay_s"),
        ("sent,delay_ms\n0,5\n20,6\n", "'delay_ms' is in ms and 'sent' has no unit: name it sent_ms or sent_s"),
        ("sent,delay\n1700000000000,5\n1700000000020,6\n", "'sent' is in ms and 'delay' has no unit"),
        ("sent_s,latency\n0,5.5\n0.02,6\n", "packets would take 5.5 s as a rule"),
        ("sent,received\n0,15\n20,\n40,61\n60,71\n", "would take 13 s as a rule: name it, as in sent_ms"),
        ("sent,received\n0.0,0.1\n0.0,0.2\n", "one after the other"),
        ("episode,sent,received\n77,1,\n", "line 2 is not an episode"),
        *(
            (f"sent_ms,delay_ms,{name}\n0,5,0\n20,6,{cell}\n", f"'{name}' may say which packets were lost")
            for name, cell in {
                "err": 11,
                "errno": 110,
                "rc": -1,
                "type": "L",
                "retries": 3,
                "flag": 1,
                "X": "lost",
                "loss_pct": 33,
                "status": "failed",
                "acked?x": 2,
            }.items()
        ),
        *(
            (f"{names}\n2026-01-01T10:00:00,{end}\n2026-01-01T10:00:01,{end}\n", f"'{wrong}' has the unit")
            for names, end, wrong in (
                ("sent_ms,delay_ms", 7, "sent_ms"),
                ("sent,received_ms", "2026-01-01T10:00:02", "received_ms"),
                ("sent_us,received", "2026-01-01T10:00:02", "sent_us"),
            )
        ),
        (
            "sent,received\n2026-01-01T10:00:00,1\n2026-01-01T10:00:01,2\n",
            "line 2 is not a time sent and a time received",
        ),
        ("sent,received\n1,2\n2026-01-01T10:00:01,2\n", "line 3 is not a time sent and a time received"),
        ("sent,delay_s\n0,2026-01-01T10:00:01\n", "line 2 is not a time sent and a delay"),
        *(
            (f"episode,sent{unit},received,{name}\n0,1,1,0\n0,2,2,1\n", f"has no '{wrong}': put the times of each")
            for unit, name, wrong in (("", "lost", "lost"), ("", "status", "status"), ("_s", "ok", "sent_s"))
        ),
        ("seq,sent,delay\n1,0,0.1\n2,1,0.1\n2,2,0.1\n", "packet 2 was sent at two times"),
        ("sent_ms,received\n0,0.07\n500,0.569\n", "('received' was read in ms)"),
        ("sent_ms,delay\n120000000,5\n120000020,6\n", "'delay' has no unit: name it delay_ms or delay_s"),
        ("sent,delay_ms\n120000000,5\n120000020,6\n", "'sent' has no unit: name it sent_ms or sent_s"),
        ("sent,rtt_s\n1,5\n2,6\n", "'sent' has no unit: name it sent_s or sent_ms"),
        ("sent_ms,delay_ms,lost\n0,5,0\n20,6,3\n", "line 3: 'lost' has to be 0 or 1, yes or no, got '3'"),
        ("time,rtt_ms\n0,10\n0.1,11\n60,12\n", "'time' may say when packets were sent or when they came back"),
        ("Time_s;latency\n0;10\n0.1;11\n", "name it sent_s or received_s, and 'latency' by its unit"),
        ("0.3\n0.4\n", "seconds or milliseconds"),
        ("rtt_ms\n12\nslow\n", "line 3 is not a delay"),
        (f"{LINUX}{ping([(1, 2)])}{LINUX}{ping([(1, 2)])}", "several runs"),
        ("a : [0], 64 bytes, 1 ms (1 avg, 0% loss)\nb : [0], 64 bytes, 1 ms (1 avg, 0% loss)\n", "several hosts"),
        ("Antwort von 192.0.2.1: Bytes=32 Zeit=12ms TTL=57\nZeitüberschreitung.\n", "only the English output"),
        (f"{LINUX}\n3 packets transmitted, 0 received, 100% packet loss, time 3ms\n", "no packet of ping"),
        ('{"start": {}, "intervals": []}', "iperf3 counts packets per interval and records no times"),
        ('{"pings": []}', "JSON with 'pings'"),
        ('{"round_trips": [{}]}', "round trip 0 of irtt"),
        ("{", "no JSON"),
        (b"\x1f\x8b\x08", "it is no text; export a capture as CSV"),
        ("sent,received\n0,1\n" + 70 * "1" + ",2\n", "line 3"),
        (f"{LINUX}{2000 * 'x'} icmp_seq=1\n", "line 2 is longer"),
        *((text, "at least two packets") for text in ("", "\n\n", "sent,received\n0.0,0.1\n")),
        *((f"sent,received\n0.0,0.1\n{row}\n", "line 3") for row in ("late,0.2", "1.0,1e999")),
        (stamped([(1, 0), (2, 1), (3, -1), (4, 0)]), "line 3: the clock was set back by 2.000 s"),
        (
            stamped([(n, n if n <= 20 else n - 2) for n in range(1, 40) if not 18 <= n < 22]),
            "between the packets 17 and 22 its stamps leave too little time",
        ),
        (
            f"{LINUX}Warning: time of day goes back (-2us), taking countermeasures\n{ping([(1, 2)])}",
            "the clock was set",
        ),
        (f"{LINUX}{ping((n, 9) for n in [*range(1, 40001), 24465])}", "line 40002: number 24465 may be a late answer"),
        (ping((n, 9) for n in [*range(500), *range(500)]), "line 517: number 16 may be a late answer"),
        (f"{LINUX}{ping([(1, 9), (65530, 9)])}", "line 3: number 65530 may be a late answer"),
        ("".join(f"h : [{n % 500}], 64 bytes, 1 ms (1 avg, 0% loss)\n" for n in range(1000)), "number 16 may be"),
        (
            rows("sent,received", (t if t < 5 else t - 2.5 for t in range(9))),
            "line 7: the time of sending goes back by 1.5",
        ),
        (rows("seq,sent,received", (t if t < 5 else t - 2.5 for t in range(9))), "line 7: the time of sending"),
        (rows("sent,rtt", (t if t < 5 else t - 2.5 for t in range(9))), "line 7: the time of sending"),
        ("sent,received\n0,0.1\n1,\n5,\n3,3.1\n4,4.1\n", "line 5: the time of sending goes back by 2 s"),
        ("sent,received\n0,0.1\n1,\n5,\n3,\n4,4.1\n", "line 5: the time of sending goes back by 2 s"),
        (
            "sent,received\n" + "".join(f"{n % 60},{n + 0.01}\n" for n in range(120)),  # the sender alone begins anew
            "line 62: the time of sending goes back by 59 s",
        ),
        (
            "sent,received\n"
            + "".join(f"2026-10-25T02:{m:02}:00,2026-10-25T02:{m:02}:01\n" for m in (0, 20, 54, 1, 20)),
            "line 5: the time of sending goes back by 3180 s: if a clock was set back or began anew, or an hour comes",
        ),
        (
            rows("seq,sent,received", ((n, n) for n in range(9)), ((n + 9, n + 0.5) for n in range(9)), in_order=True),
            "by its time packet 1 was sent after packet 9",
        ),
        ("sent,received\n20261126100000.020,20261126100000.025\n20261126100000.040,\n", "no time since 1970"),
        ("sent,received\n20261126100000020,20261126100000025\n20261126100000040,\n", "no time since 1970"),
        ("sent,received\n20261126100000020000,20261126100000025000\n20261126100000040000,\n", "no time since 1970"),
        ("sent,received\n261126100000,261126100000\n261126100001,\n", "no time since 1970"),
        ("sent_ms,received_ms\n20261126100000020,20261126100000025\n20261126100000040,\n", "no time since 1970"),
        ("sent_ms\treceived_ms\n980\t985\n1,000\t1,005\n1,020\t1,025\n", "line 3: the comma in '1,000' may be"),
        ("rtt_ms\n980\n1.020\n1.040\n", "line 3: the point in '1.020' may be that of decimals or of thousands"),
        ("980\n1.020\n1.040\n", "line 2: the point in '1.020' may be"),
        ("sent_ms,rtt_ms\n1000,980\n2000,1.020\n3000,990\n", "line 3: the point in '1.020' may be"),
        (
            rows("seq,sent,received", [(n, n if n < 20 else n - 6) for n in range(60) if not 20 <= n < 30]),
            "between the packets 19 and 30 its stamps leave too little time",
        ),
        *(
            (
                rows(
                    "seq,sent,received",
                    [(n, 0.02 * (n if n < 20 else n - k)) for n in range(60) if not 20 <= n < 20 + k],
                ),
                f"between the packets 19 and {20 + k} its stamps leave too little time",
            )
            for k in (1, 5)
        ),
        (rows("seq,sent,received", [(37 * n % 300, n) for n in range(300)]), "the numbers of its packets do not count"),
        (rows("seq,sent,received", [(30 - n, n) for n in range(30)]), "the numbers of its packets do not count"),
        (rows("seq,sent,received", [(160 * n, n) for n in range(30)]), "the numbers of its packets do not count"),
        (
            "sent,received\n" + "".join(f"{0.1 * n:.2f},{0.1 * n + (0.5 if n < 40 else 0.2):.2f}\n" for n in range(80)),
            "line 42: from here on packets take 0.3 s less or more, and this one overtakes the one before",
        ),
        ("rtt_ms\n1,020\n1,040\n", "line 2: the comma in '1,020' may be"),
        (
            "sent,received\n46352.4000000000,46352.4000000579\n46352.4000002315,46352.4000002894\n",
            "days of a spreadsheet",
        ),
        (irtt_sent(0, 20, 10), "round trip 2 of irtt: the clock was set back by 0.01 s"),
        (irtt_sent(0, 10**400), "round trip 1 of irtt has no time sent"),
        *(
            (irtt_sent(0, 9).replace("1000000", delay, 1), "round trip 0 of irtt has no time sent")
            for delay in ("NaN", "Infinity", "-Infinity", "-1")
        ),
        (ping([(1, 2), (2, 900 * "9")]), "line 2 has a number that is too large"),
        (ping([(1, 2), (900 * "9", 2)]), "line 2 has a number that is too large"),
        (f"[{900 * '1'}.0] {ping([(1, 2)])}[{900 * '9'}.5] {ping([(2, 2)])}", "line 1 has a number that is too large"),
        (f"{ping([(1, 2)])}{900 * '9'} packets transmitted, 1 received, 0% packet loss", "line 2 has a number that"),
        (f"Reply from 192.0.2.1: bytes=32 time={900 * '9'}ms TTL=1\n", "line 1 has a number that is too large"),
        (f"h : [{900 * '9'}], 64 bytes, 1 ms (1 avg, 0% loss)\n", "line 1 has a number that is too large"),
        ("sent,received\n0,0.1\n1,\n2,1.9\n", "line 4: the packet arrived before it was sent: the clocks of sender"),
        ("sent,delay\n0,0.1\n1,-0.5\n", "line 3: the packet arrived before it was sent"),
        ("episode,sent,received\n0,1,2\n0,4,3\n", "line 3: the packet arrived before it was sent"),
        ("episode,sent,received\n0,-5,2\n0,4,4\n", "line 2: the packet arrived before it was sent"),
        ("episode,sent,received\n7,1,2\n7,4,5\n7,1,2\n7,4,5\n", "line 4: episode '7' begins twice"),
        ("episode,sent,received\n7,1,2\n8,1,2\n7,4,5\n", "line 4: episode '7' begins twice"),
    ],
)
def test_file_that_is_not_understood_is_refused_in_one_sentence(content, words, written):
    with pytest.raises(ValueError, match=re.escape(words)) as refusal:
        PacketLog.load(written(content))
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < 500


def test_long_lines_of_ping_take_no_longer_than_their_length(written):
    lines = "".join(f"icmp_seq={n} {980 * 'a'}\n" for n in range(2, 300))
    began = time.process_time()
    PacketLog.load(written(f"icmp_seq=1 time=2 ms\n{lines}icmp_seq=300 time=1 ms"))
    assert time.process_time() - began < 1.0  # of a quadratic search: 5 s


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    name=st.sampled_from(sorted(KINDS)),
    edits=st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=4)), min_size=1, max_size=6),
)
@pytest.mark.filterwarnings("ignore:the times in")
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


@settings(max_examples=25, deadline=None)
@given(record=RECORDS)
def test_replay_in_an_environment_has_the_ages_of_the_record(record):
    sent = np.cumsum([0, *(gap for gap, _ in record[1:])]) / 4  # in quarters of a step
    received = [None if delay is None else start + delay / 4 for start, (_, delay) in zip(sent, record, strict=True)]
    log = PacketLog(sent, np.array([np.nan if r is None else r - s for s, r in zip(sent, received, strict=True)]))
    ages, trace = log.ages(1.0), log.trace(1.0)
    assert ages.tolist() == ages_by_clock(list(zip(sent, received, strict=True)), "1")
    promised = contract_of(log.channel(1.0))
    assert promised is None or ages.max() <= promised.max_age
    env = NCSEnv(PLANT, channel=log.channel(1.0), terminate_on_violation=False)
    replayed = set()
    for seed in range(200):  # the replay begins with a random sample
        env.reset(seed=seed)
        replayed.add(tuple(env.step(np.zeros(1))[4]["measurement_age"] for _ in range(len(ages) - 1)))
        if tuple(ages[1:].tolist()) in replayed:
            break
    assert tuple(ages[1:].tolist()) in replayed
    assert len(replayed) <= len(trace)


WRAPS = {
    "a late answer": (
        LINUX + ping((n % 65536, 9) for n in [*range(1, 65535), 65536, 65535, *range(65537, 65600)]),
        [1] * 65599,
    ),
    "numbers of macOS that do not wrap without an answer": (
        f"{MACOS}{ping((n, 9) for n in range(65536))}Request timeout for icmp_seq 65536\n{ping([(1, 9)])}",
        [*65536 * [1], 0, 1],
    ),
    "a gap with stamps": (
        "".join(
            f"[{1700000000 + n}.009] {ping([(n % 65536, 9)])}"
            for n in (*range(1, 9), *range(60000, 60009), *range(110000, 110009))
        ),
        [*8 * [1], *59991 * [0], *9 * [1], *49991 * [0], *9 * [1]],
    ),
    "the same number with a later stamp": (
        "".join(f"[{1700000000 + n}.009] {ping([(n % 65536, 9)])}" for n in (*range(1, 9), 65544, 65545)),
        [*8 * [1], *65535 * [0], 1, 1],
    ),
}


@pytest.mark.parametrize("name", WRAPS)
def test_numbers_of_ping_wrap(name, written):
    text, arrived = WRAPS[name]
    log = PacketLog.load(written(text))
    assert np.isfinite(log.delays).tolist() == [bool(each) for each in arrived]
    assert np.allclose(np.diff(log.sent), 1.0)


def test_stamp_that_was_printed_late_makes_no_packet_fresher(written):
    lines = [("0.1", 100), ("1.1", 100), ("3.15", 100), ("3.2", 200), ("4.1", 100)]  # the third was printed late
    log = PacketLog.load(written("".join(f"[{at}] {ping([(n, rtt)])}" for n, (at, rtt) in enumerate(lines, 1))))
    assert log.sent[2] == log.sent[3]
    assert np.allclose(log.sent + log.delays, [float(at) - 0.1 for at, _ in lines])


def test_equal_channels_of_a_record_stay_equal_and_read_only_when_copied():
    log = PacketLog(np.arange(4.0), np.array([0.5, np.nan, 2.5, 0.0]))
    channel = log.channel(1.0)
    assert channel.oldest_age == 2  # the longest run of losses and the longest delay together would be 4
    for other in (copy.deepcopy(channel), pickle.loads(pickle.dumps(channel))):
        assert other == channel
        assert not other.delays.flags.writeable


@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize("outage", [0, 15, 600])
def test_counters_that_go_on_from_zero_miss_no_loss(bits, outage, tmp_path):
    rng, count = np.random.default_rng(bits + outage), 6000
    first = rng.integers(0, 1 << bits) if bits < 16 else (1 << bits) - 1000
    arrives = rng.random(count) > 0.1
    arrives[[0, -1]] = True
    around = (1 << bits) - first  # where it goes on from zero
    if outage:
        start = min(int(around) - outage // 2, count - outage - 10) % (count - outage - 10)
        arrives[start : start + outage] = False
    lines = [
        f"{(k + first) % (1 << bits)},{0.02 * k + rng.uniform(-0.001, 0.001):.6f},0.005\n"
        for k in np.flatnonzero(arrives).tolist()
    ]
    (tmp_path / "log.csv").write_text("seq,sent_s,delay_s\n" + "".join(lines))
    log = PacketLog.load(tmp_path / "log.csv")
    np.testing.assert_array_equal(np.isnan(log.delays), ~arrives)
    assert "begin anew" not in log.read_as


def test_numbers_that_begin_anew_are_told_of(tmp_path):
    packets = [(k, 0.02 * k) for k in range(1000)] + [(k, 60.0 + 0.02 * k) for k in range(1000)]
    text = "seq,sent_s,delay_s\n" + "".join(f"{number},{at:.3f},0.005\n" for number, at in packets)
    (tmp_path / "log.csv").write_text(text)
    log = PacketLog.load(tmp_path / "log.csv")
    assert not np.isnan(log.delays).any()
    assert "Numbers begin anew 1 time: packets without a line are not counted there." in log.read_as
