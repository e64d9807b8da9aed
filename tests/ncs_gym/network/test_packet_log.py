"""Recorded packets: what is read, which contract they kept, and their replay."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from experiments.commands.channel import broken_contracts, count_interval, stalls
from ncs_gym import Channel, PacketLog, TraceChannel, contract_of


def test_log_is_laid_over_the_steps_of_a_loop():
    log = PacketLog(0.05 * np.arange(6), 0.05 * np.array([1, np.nan, 2, 1, np.nan, 1]))
    assert log.trace(0.05) == (1, -1, 2, 1, -1, 1)
    assert log.period == pytest.approx(0.05)
    assert [log.send_period(dt) for dt in (0.05, 0.025)] == [1, 2]


@pytest.mark.parametrize("dt", [0.01, 0.02, 0.05])
def test_times_since_1970_are_placed_in_the_steps_they_are_rounded_from(dt):
    sent = 1_764_000_000.0 + dt * np.arange(1000)
    assert PacketLog(sent, np.full(1000, dt)).trace(dt) == (1,) * 1000


def ages_by_hand(trace, period, steps):
    """Looks at every packet at every step; the first estimate is one."""
    ages = []
    for step in range(steps):
        stamps = [i * period for i, d in enumerate(trace) if d >= 0 and i * period + d <= step]
        ages.append(step - max(stamps, default=0))
    return ages


@pytest.mark.parametrize("seed", range(4))
def test_contract_of_a_replay_is_the_oldest_age_of_three_rounds(seed):
    rng = np.random.default_rng(seed)
    trace = tuple(np.where(rng.random(12) < 0.4, -1, rng.integers(0, 30, 12)).tolist())
    channel = TraceChannel(trace=trace, send_period=int(rng.integers(1, 4)))
    promised = contract_of(channel)
    assert promised is not None
    steps = 5 * 12 * channel.send_period
    assert promised.max_age == max(ages_by_hand(5 * trace, channel.send_period, steps))
    losses, delay = channel.max_consecutive_losses, channel.longest_delay
    assert promised.max_age <= (losses + 1) * channel.send_period + delay - 1


def test_longest_run_of_losses_counts_across_the_end():
    assert TraceChannel(trace=(-1, 0, 0, -1, -1)).max_consecutive_losses == 3
    assert contract_of(TraceChannel(trace=(-1, -1))) is None


def test_stalls_are_counted_once_with_their_length_and_rate():
    ages = np.tile([0, 1, 2, 3], 500)
    starts, lengths = stalls(ages, 1)
    assert starts.tolist() == list(range(2, 2000, 4))
    assert set(lengths.tolist()) == {2}
    rows = {row["max_age"]: row for row in broken_contracts(ages, 0.1)}
    assert list(rows) == [3, 2, 1, 0]
    assert (rows[3]["times"], rows[3]["per_hour"], rows[3]["longest"]) == (0, 0.0, 0)
    assert rows[1]["broken"] == pytest.approx(0.5)
    assert rows[1]["times"] == 500
    assert rows[1]["per_hour"] == pytest.approx(500 / (200.0 / 3600.0))
    assert rows[1]["per_hour_ci95"][0] <= rows[1]["per_hour"] <= rows[1]["per_hour_ci95"][1]


def test_table_has_few_rows_and_the_age_that_is_asked_for():
    ages = np.arange(3000)
    assert [row["max_age"] for row in broken_contracts(ages, 0.1, also=(77,))] == [
        *(1000, 500, 200, 100, 77, 50, 20),
        *range(10, -1, -1),
    ]
    assert [row["max_age"] for row in broken_contracts(np.array([0, 1, 1]), 0.1, also=(4,))] == [4, 1, 0]


def test_interval_of_independent_stalls_is_that_of_poisson():
    assert count_interval(np.array([], dtype=int), 10_000) == (0.0, pytest.approx(3.689, abs=1e-3))
    low, high = count_interval(np.arange(50, 10_000, 100), 10_000)
    assert (low, high) == pytest.approx((81.36, 121.63), abs=0.01)  # Garwood's for 100


def test_interval_covers_the_rate_of_stalls_in_clusters():
    rng, steps = np.random.default_rng(0), 500_000

    def record(length):
        clusters = []
        for begin in rng.integers(length, size=rng.poisson(length * 4e-5)):
            size = 1 + rng.poisson(10)
            clusters.append(begin + np.cumsum(rng.exponential(50.0, size)).astype(int))
        starts = np.concatenate(clusters)
        return np.sort(starts[starts < length])

    expected = np.mean([len(record(steps)) for _ in range(400)])
    intervals = np.array([count_interval(record(steps), steps) for _ in range(100)])
    covered = ((intervals[:, 0] <= expected) & (expected <= intervals[:, 1])).mean()
    assert covered > 0.88  # of independent stalls it would be below a half


def test_a_record_cut_for_one_duration_of_steps_is_for_that_alone(tmp_path):
    file = tmp_path / "packets.csv"
    file.write_text("sent,received\n0,0.01\n0.1,\n0.2,0.25\n0.3,0.31\n")
    log, cruise = PacketLog.load(file), "ncs_gym/TruckTrailerCruise-v0"
    assert gym.make(cruise, channel=log.channel(0.5)).unwrapped.channel.dt == 0.5
    words = r"steps of 0.1 s, and steps take 0.5 s here: make another one with PacketLog.channel\(0.5\)"
    with pytest.raises(ValueError, match=words):
        gym.make(cruise, channel=log.channel(0.1))
    env = gym.make(cruise, downlink=Channel(delay=2, max_consecutive_losses=1))
    for name in ("channel", "downlink"):
        with pytest.raises(ValueError, match=words):
            env.reset(options={name: log.channel(0.1)})
