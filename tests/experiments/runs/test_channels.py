import itertools

import numpy as np
import pytest

from experiments.runs.loops import changed_channel
from ncs_gym import Channel, GilbertElliott
from ncs_gym.network.packet_loss_and_delay import ChannelState

OWN = Channel(loss=0.3, quantization_step=0.05, send_period=2, delay=2)


def test_nothing_asked_for_changes_nothing():
    assert changed_channel(OWN, {}) is None
    assert changed_channel(OWN, {"loss": 0.3, "delay": None}) is None


def test_what_is_asked_for_replaces_the_environments_own():
    changed = changed_channel(OWN, {"loss": 0.1, "delay": 0, "max_consecutive_losses": 4})
    expected = Channel(loss=0.1, quantization_step=0.05, send_period=2, delay=0, max_consecutive_losses=4)
    assert changed == expected


@pytest.mark.cases(1)
@pytest.mark.parametrize(("loss", "length", "period"), [(0.3, 4.0, 1), (0.1, 1.0, 1), (0.6, 2.5, 3)])
def test_bursts_have_the_loss_rate_and_the_length_asked_for(loss, length, period):
    # What the channel itself does, packet by packet.
    own, rng = Channel(send_period=period), np.random.default_rng(0)
    channel = changed_channel(own, {"loss": loss, "burst_length": length})
    link, states = ChannelState(channel, rng), []
    for step in range(1, 80_000):
        if link.sends_at(step):
            states.append(not link.exchange(rng, step, np.zeros(1)))
        else:
            link.exchange(rng, step, None)
    states = np.array(states)
    runs = int((states[1:] & ~states[:-1]).sum())
    assert states.mean() == pytest.approx(loss, rel=0.05)
    assert states.sum() / runs == pytest.approx(length, rel=0.05)


def test_independent_losses_are_bursts_for_every_period():
    for loss, period in itertools.product((0.5, 0.8, 0.9), (1, 2, 3)):
        channel = changed_channel(Channel(send_period=period), {"loss": loss, "burst_length": 1.0 / (1.0 - loss)})
        assert channel.mean_loss == pytest.approx(loss)


def test_a_channel_that_loses_only_so_many_in_a_row_loses_fewer_than_asked_for():
    own = Channel(loss=0.3, max_consecutive_losses=5)
    with pytest.warns(UserWarning, match=r"0.7\d* of the packets are lost in the long run, not 0.8: .* 5 in a row"):
        channel = changed_channel(own, {"loss": 0.8, "burst_length": 5.0})
    assert channel.mean_loss < 0.8
    with pytest.raises(ValueError, match="at most 5 packets in a row, and no mean is longer"):
        changed_channel(own, {"loss": 0.8, "burst_length": 12.0})
    longer = changed_channel(own, {"loss": 0.8, "burst_length": 12.0, "max_consecutive_losses": 40})
    assert longer.max_consecutive_losses == 40


def test_bursts_need_a_loss_probability():
    own = Channel(loss=GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.5))
    with pytest.raises(ValueError, match="--channel burst_length needs loss"):
        changed_channel(own, {"burst_length": 3.0})
    given = {"burst_length": 3.0, "loss": 0.2}
    assert changed_channel(own, given).loss == changed_channel(Channel(), given).loss
    assert changed_channel(OWN, {"burst_length": 3.0}).loss == changed_channel(OWN, given | {"loss": 0.3}).loss
