import numpy as np
import pytest

from ncs_gym import Channel, GilbertElliott, TraceChannel
from ncs_gym.network import packet_loss_and_delay
from ncs_gym.network.packet_loss_and_delay import ChannelState, VectorChannelState

BURSTS = GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.2)


def transmit(channel: Channel, steps: int, seed: int = 0, value: float = 0.0) -> dict[int, list[int]]:
    """Sends a value at every step; returns the stamps that arrive at each step."""
    rng = np.random.default_rng(seed)
    link = ChannelState(channel, rng)
    arrivals = {}
    for step in range(1, steps + 1):
        sample = np.array([value]) if link.sends_at(step) else None
        arrivals[step] = [packet.stamp for packet in link.exchange(rng, step, sample)]
    return arrivals


@pytest.mark.parametrize("delay", [0, 3])
@pytest.mark.parametrize("period", [1, 4])
def test_without_losses_every_sample_arrives_after_its_delay(delay, period):
    arrivals = transmit(Channel(delay=delay, send_period=period), 20)
    sent = range(period, 21, period)
    assert arrivals == {step: [step - delay] if step - delay in sent else [] for step in range(1, 21)}


def test_jitter_delays_within_its_range_and_lets_packets_overtake():
    channel = Channel(delay=1, jitter=3)
    arrivals = transmit(channel, 4000)
    delays = [step - stamp for step, stamps in arrivals.items() for stamp in stamps]
    assert {1, 2, 3, 4} == set(delays)
    assert np.bincount(delays)[1:] == pytest.approx(1000, abs=120)
    order = [stamp for stamps in arrivals.values() for stamp in stamps]
    assert order != sorted(order)
    assert len(order) == len(set(order))


def test_loss_alone_may_be_given_without_its_name():
    """So that loss and delay are not read as loss and step of the quantizer."""
    assert Channel(0.3) == Channel(loss=0.3)
    for positional in ((0.3, 2), (0.3, 0.05, 2)):
        with pytest.raises(TypeError, match="positional argument"):
            Channel(*positional)


def test_gilbert_elliott_loses_in_bursts_at_its_stationary_rate():
    loss = GilbertElliott(p_good_to_bad=0.05, p_bad_to_good=0.2)
    arrivals = transmit(Channel(loss=loss), 40_000)
    lost = np.array([not stamps for stamps in arrivals.values()])
    assert lost.mean() == pytest.approx(0.2, abs=0.015)
    ends = np.flatnonzero(np.diff(lost.astype(int)) == -1)
    starts = np.flatnonzero(np.diff(lost.astype(int)) == 1)
    bursts = ends[-len(starts) :][: len(starts)] - starts[: len(ends)] if ends[0] > starts[0] else ends[1:] - starts
    assert np.mean(bursts) == pytest.approx(5.0, rel=0.1)  # 1 / p_bad_to_good


@pytest.mark.cases(5)
@pytest.mark.parametrize("most", [None, 1, 40])
@pytest.mark.parametrize(
    ("loss", "period"),
    [
        *((1.0, 1), (0.9, 2), (BURSTS, 3)),
        (GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.0), 1),
        (GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.3, loss_good=0.2, loss_bad=0.7), 1),
    ],
)
def test_mean_loss_is_the_share_that_is_lost_in_the_long_run(loss, period, most):
    channel, rng = Channel(loss=loss, send_period=period, max_consecutive_losses=most), np.random.default_rng(0)
    size, steps = 1000, 400
    state, sent, lost = packet_loss_and_delay.first_loss_state(channel, rng, size), 0, 0
    for k in range(steps):
        state, delays = packet_loss_and_delay.transmit(channel, rng, state, np.full(size, k % period == 0))
        if k % period == 0 and k >= steps // 2:
            sent, lost = sent + size, lost + np.count_nonzero(delays < 0)
    assert channel.mean_loss == pytest.approx(lost / sent, abs=0.01)


def test_gilbert_elliott_starts_from_its_stationary_distribution():
    loss = GilbertElliott(p_good_to_bad=1e-9, p_bad_to_good=1e-9)
    first = [bool(transmit(Channel(loss=loss), 1, seed)[1]) for seed in range(400)]
    assert np.mean(first) == pytest.approx(0.5, abs=0.1)


def test_quantizer_rounds_to_multiples_within_half_a_step():
    channel = Channel(quantization_step=0.05)
    values = np.random.default_rng(0).uniform(-3, 3, 1000)
    rounded = channel.quantize(values)
    assert np.abs(rounded - values).max() <= 0.025 * (1 + 1e-12)
    np.testing.assert_allclose(rounded / 0.05, np.round(rounded / 0.05), atol=1e-9)
    assert len(np.unique(rounded)) < 125


def test_random_draws_do_not_depend_on_the_measurement():
    # Paired arms rely on it: the same seed gives the same arrivals whatever the plant does.
    channel = Channel(loss=0.5, jitter=2, send_period=2)
    assert transmit(channel, 200) == transmit(channel, 200, value=1e6)


class Starting:
    """Draws the same number always."""

    def __init__(self, number):
        self.number = number

    def integers(self, high, size=None):
        return self.number


def sent_and_arrived(trace, start, steps):
    """Pairs (step, age) at which a replay from a sample on delivers samples."""
    link, found = ChannelState(trace, Starting(start)), []
    for step in range(steps):
        packet = step if link.sends_at(step) else None
        found += [(step, step - stamp) for stamp in link.carry(None, step, packet)]
    return sorted(found)


def test_records_are_replayed_beside_each_other_and_beside_channels_that_lose_by_chance():
    traces = [TraceChannel(trace=(0, -1, 0, 2, -1)), TraceChannel(trace=(1, 1, -1, 0), send_period=2)]
    chance = Channel(loss=GilbertElliott(p_good_to_bad=0.2, p_bad_to_good=0.4)), Channel(loss=0.5, jitter=1)
    rng, steps = np.random.default_rng(0), 400
    links = VectorChannelState([*chance, *chance], rng, 4)
    for step in range(7):
        links.send(rng, np.full(4, step))
    links.begin(rng, np.array([0, 1]), [*traces, *chance])
    found = [[] for _ in range(4)]
    for step in range(steps):
        links.send(rng, np.full(4, step))
        for age, arrives in links.arrivals():
            for e in np.flatnonzero(arrives):
                found[e].append((step, age))
    for trace, of_row in zip(traces, found, strict=False):
        assert sorted(of_row) in [sent_and_arrived(trace, k, steps) for k in range(len(trace.trace))]
    assert len(found[2]) == pytest.approx(steps * (1.0 - chance[0].mean_loss), rel=0.15)
    assert len(found[3]) == pytest.approx(steps * 0.5, rel=0.15)
