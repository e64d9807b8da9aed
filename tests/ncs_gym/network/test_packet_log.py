"""Recorded packets: what is read, which contract they kept, and their replay."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from experiments.commands.channel import broken_contracts
from ncs_gym import ChannelContract, PacketLog, TraceChannel, contract_of
from ncs_gym.network.packet_loss_and_delay import ChannelState

PING = """PING host (192.0.2.1) 56(84) bytes of data.
64 bytes from 192.0.2.1: icmp_seq=1 ttl=64 time=12.3 ms
64 bytes from 192.0.2.1: icmp_seq=2 ttl=64 time=25.0 ms
no answer yet for icmp_seq=3
64 bytes from 192.0.2.1: icmp_seq=4 ttl=64 time=9.99 ms
64 bytes from 192.0.2.1: icmp_seq=4 ttl=64 time=30.0 ms (DUP!)
64 bytes from 192.0.2.1: icmp_seq=6 ttl=64 time=10.1 ms

--- host ping statistics ---
6 packets transmitted, 4 received, 33% packet loss, time 5012ms
"""


def test_csv_is_read_with_losses_and_any_order(tmp_path):
    file = tmp_path / "packets.csv"
    file.write_text("sent,received\n0.00,0.011\n0.02,\n0.06,0.065\n0.04,0.09\n")
    log = PacketLog.load(file)
    assert log.trace(0.02) == (1, -1, 3, 1)
    assert log.period == pytest.approx(0.02)
    assert log.send_period(0.01) == 2


def test_columns_are_found_by_their_names(tmp_path):
    file = tmp_path / "packets.csv"
    file.write_text("size,received,sent\n60,0.011,0.00\n60,,0.02\n60,0.09,0.04\n")
    assert PacketLog.load(file).trace(0.02) == (1, -1, 3)


def test_log_of_a_loop_is_read_in_steps_with_the_packets_that_are_missing(tmp_path):
    file = tmp_path / "packets-000.csv"
    file.write_text("episode,sent,received\n77,1,2\n77,4,5\n77,3,5\n77,3,6\n12,2,3\n")
    log = PacketLog.load(file, step=0.05)
    assert log.trace(0.05) == (1, -1, 2, 1, -1, 1)
    assert log.period == pytest.approx(0.05)


def test_times_that_look_like_milliseconds_are_warned_of(tmp_path):
    file = tmp_path / "packets.csv"
    file.write_text("sent,received\n0,15\n20,\n40,61\n60,71\n")
    with pytest.warns(UserWarning, match="look like milliseconds"):
        PacketLog.load(file)


def test_ping_is_read_with_missing_numbers_and_duplicates(tmp_path):
    file = tmp_path / "ping.txt"
    file.write_text(PING)
    log = PacketLog.load(file, period=0.02)
    assert log.trace(0.01) == (2, 3, -1, 1, -1, 2)
    assert log.period == pytest.approx(0.02)


def test_stamps_of_ping_give_the_time_between_packets(tmp_path):
    file = tmp_path / "ping.txt"
    lines = [f"[{100.0 + 0.2 * i + 0.01:.6f}] 64 bytes: icmp_seq={i} ttl=64 time=10.0 ms" for i in (1, 2, 4, 5)]
    file.write_text("\n".join(lines))
    log = PacketLog.load(file)
    assert log.period == pytest.approx(0.2)
    assert log.trace(0.2) == (1, 1, -1, 1, 1)


def ages_by_hand(trace, period, steps):
    """Looks at every packet at every step."""
    ages = []
    for step in range(steps):
        stamps = [i * period for i, d in enumerate(trace) if d >= 0 and i * period + d <= step]
        if stamps:
            ages.append(step - max(stamps))
    return ages


@pytest.mark.parametrize("seed", range(4))
def test_ages_are_those_of_the_newest_sample_and_within_the_contract_of_the_replay(seed):
    rng = np.random.default_rng(seed)
    trace = tuple(np.where(rng.random(60) < 0.3, -1, rng.integers(0, 4, 60)).tolist())
    period = int(rng.integers(1, 4))
    delays = np.where(np.array(trace) < 0, np.nan, np.array(trace, float))
    log = PacketLog(period * np.arange(60.0), delays)
    ages = log.ages(1.0)
    assert ages.tolist() == ages_by_hand(trace, period, 60 * period)
    promised = contract_of(log.channel(1.0))
    assert promised is not None
    assert ages.max() <= promised.max_age


def test_replay_is_the_record_from_a_random_packet_on():
    trace = (0, -1, 2, -1, -1, 1)
    channel = TraceChannel(trace=trace)
    assert (channel.delay, channel.jitter, channel.max_consecutive_losses) == (0, 2, 2)
    seen = set()
    for seed in range(60):
        rng = np.random.default_rng(seed)
        state, arrivals = ChannelState(channel, rng), {}
        for step in range(1, 13):
            for packet in state.exchange(rng, step, np.zeros(1)):
                arrivals[packet.stamp] = step - packet.stamp
        delays = tuple(arrivals.get(stamp, -1) for stamp in range(1, 7))
        assert delays in {trace[i:] + trace[:i] for i in range(6)}
        seen.add(delays)
    assert len(seen) == 6


def test_longest_run_of_losses_counts_across_the_end():
    assert TraceChannel(trace=(-1, 0, 0, -1, -1)).max_consecutive_losses == 3
    assert contract_of(TraceChannel(trace=(-1, -1))) is None


def test_record_is_replayed_in_an_environment_single_and_vectorized_within_its_contract():
    channel = TraceChannel(trace=(1, -1, 2, 1, -1, -1, 1), quantization_step=1e-4)
    settings = {"contract": ChannelContract(8, 1e-4), "terminate_on_violation": False}
    env = gym.make("ncs_gym/CartPole-v0", channel=channel, **settings)
    promised = contract_of(channel)
    assert promised is not None
    env.reset(seed=0)
    ages = [env.step(np.zeros(1))[4]["measurement_age"] for _ in range(60)]
    assert max(ages) <= promised.max_age
    vector = gym.make_vec("ncs_gym/CartPole-v0", num_envs=5, channel=channel, **settings)
    vector.reset(seed=0)
    ages = np.stack([vector.step(np.zeros((5, 1), np.float32))[4]["measurement_age"] for _ in range(60)])
    assert ages.max() <= promised.max_age
    assert len({tuple(row) for row in ages.T[:, :7]}) > 1  # from different packets on


def test_share_of_broken_steps_and_its_interval():
    ages = np.tile([0, 1, 2, 3], 500)
    rows = {row["max_age"]: row for row in broken_contracts(ages, np.random.default_rng(0))}
    assert rows[3]["broken"] == 0.0
    assert rows[3]["broken_ci95"][0] == 0.0
    assert rows[3]["broken_ci95"][1] == pytest.approx(3.0 / 50)
    assert rows[1]["broken"] == pytest.approx(0.5)
    assert rows[1]["times"] == 500
    assert rows[1]["broken_ci95"][0] <= 0.5 <= rows[1]["broken_ci95"][1]


def test_interval_is_wider_where_losses_come_in_bursts():
    rng = np.random.default_rng(0)
    alone = (rng.random(20_000) < 0.05).astype(int)
    bursts = np.repeat(rng.random(200) < 0.05, 100).astype(int)
    widths = [
        np.diff(broken_contracts(ages, np.random.default_rng(1))[1]["broken_ci95"])[0] for ages in (alone, bursts)
    ]
    assert widths[1] > 2.0 * widths[0]
