import numpy as np
import pytest

from ncs_gym import Channel, GilbertElliott
from ncs_gym.network.packet_loss_and_delay import ChannelState


def transmit(channel: Channel, steps: int, seed: int = 0) -> dict[int, list[int]]:
    """Sends the step number at every step; returns the stamps that arrive at each step."""
    rng = np.random.default_rng(seed)
    link = ChannelState(channel, rng)
    arrivals = {}
    for step in range(1, steps + 1):
        sample = np.array([float(step)]) if link.sends_at(step) else None
        arrivals[step] = [packet.stamp for packet in link.exchange(rng, step, sample)]
    return arrivals


def test_perfect_channel_delivers_every_sample_at_once():
    assert transmit(Channel(), 20) == {step: [step] for step in range(1, 21)}


def test_fixed_delay_shifts_every_packet():
    arrivals = transmit(Channel(delay=3), 20)
    assert arrivals == {step: [step - 3] if step > 3 else [] for step in range(1, 21)}


def test_send_period_rations_samples():
    arrivals = transmit(Channel(send_period=4), 20)
    assert [step for step, stamps in arrivals.items() if stamps] == [4, 8, 12, 16, 20]


def test_loss_has_the_asked_rate():
    delivered = sum(len(stamps) for stamps in transmit(Channel(loss=0.3), 20_000).values())
    assert delivered / 20_000 == pytest.approx(0.7, abs=0.015)


def test_blackout_delivers_nothing():
    assert not any(transmit(Channel(loss=1.0), 500).values())


def test_jitter_delays_within_its_range_and_lets_packets_overtake():
    channel = Channel(delay=1, jitter=3)
    arrivals = transmit(channel, 4000)
    delays = [step - stamp for step, stamps in arrivals.items() for stamp in stamps]
    assert {1, 2, 3, 4} == set(delays)
    assert np.bincount(delays)[1:] == pytest.approx(1000, abs=120)
    order = [stamp for stamps in arrivals.values() for stamp in stamps]
    assert order != sorted(order)
    assert len(order) == len(set(order))


def test_gilbert_elliott_loses_in_bursts_at_its_stationary_rate():
    loss = GilbertElliott(p_good_to_bad=0.05, p_bad_to_good=0.2)
    arrivals = transmit(Channel(loss=loss), 60_000)
    lost = np.array([not stamps for stamps in arrivals.values()])
    assert lost.mean() == pytest.approx(0.2, abs=0.015)
    ends = np.flatnonzero(np.diff(lost.astype(int)) == -1)
    starts = np.flatnonzero(np.diff(lost.astype(int)) == 1)
    bursts = ends[-len(starts) :][: len(starts)] - starts[: len(ends)] if ends[0] > starts[0] else ends[1:] - starts
    assert np.mean(bursts) == pytest.approx(5.0, rel=0.1)  # 1 / p_bad_to_good


def test_gilbert_elliott_starts_from_its_stationary_distribution():
    loss = GilbertElliott(p_good_to_bad=1e-9, p_bad_to_good=1e-9)
    first = [bool(transmit(Channel(loss=loss), 1, seed)[1]) for seed in range(400)]
    assert np.mean(first) == pytest.approx(0.5, abs=0.1)


def test_gilbert_elliott_with_equal_losses_is_bernoulli():
    loss = GilbertElliott(p_good_to_bad=0.3, p_bad_to_good=0.3, loss_good=0.4, loss_bad=0.4)
    delivered = sum(len(stamps) for stamps in transmit(Channel(loss=loss), 20_000).values())
    assert delivered / 20_000 == pytest.approx(0.6, abs=0.015)


def test_quantizer_rounds_to_multiples_within_half_a_step():
    channel = Channel(quantization_step=0.05)
    values = np.random.default_rng(0).uniform(-3, 3, 1000)
    rounded = channel.quantize(values)
    assert np.abs(rounded - values).max() <= 0.025 * (1 + 1e-12)
    np.testing.assert_allclose(rounded / 0.05, np.round(rounded / 0.05), atol=1e-9)
    assert len(np.unique(rounded)) < 125


def test_all_impairments_work_together():
    channel = Channel(loss=0.3, quantization_step=0.05, send_period=2, delay=2, jitter=2)
    arrivals = transmit(channel, 6000)
    pairs = [(step, stamp) for step, stamps in arrivals.items() for stamp in stamps]
    assert all(stamp % 2 == 0 and 2 <= step - stamp <= 4 for step, stamp in pairs)
    assert len(pairs) / 3000 == pytest.approx(0.7, abs=0.04)


def test_random_draws_do_not_depend_on_the_measurement():
    # Paired arms rely on it: the same seed gives the same arrivals whatever the plant does.
    channel = Channel(loss=0.5, jitter=2, send_period=2)
    patterns = []
    for value in (0.0, 1e6):
        rng = np.random.default_rng(7)
        link = ChannelState(channel, rng)
        patterns.append(
            [
                [packet.stamp for packet in link.exchange(rng, k, np.array([value]) if link.sends_at(k) else None)]
                for k in range(1, 200)
            ]
        )
    assert patterns[0] == patterns[1]
