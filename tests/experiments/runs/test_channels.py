import pytest

from experiments.runs.loops import changed_channel
from ncs_gym import Channel, GilbertElliott

OWN = Channel(loss=0.3, quantization_step=0.05, send_period=2, delay=2)


def test_what_is_asked_for_replaces_the_environments_own():
    changed = changed_channel(OWN, {"loss": 0.1, "delay": 0, "max_consecutive_losses": 4})
    expected = Channel(loss=0.1, quantization_step=0.05, send_period=2, delay=0, max_consecutive_losses=4)
    assert changed == expected


def test_losses_in_bursts_are_given_by_the_fields_of_their_chain():
    changed = changed_channel(OWN, {"loss": {"p_good_to_bad": 0.1, "p_bad_to_good": 0.3}})
    assert changed.loss == GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.3)
    assert changed.mean_loss == pytest.approx(0.25)


def test_a_channel_that_loses_only_so_many_in_a_row_loses_fewer_than_asked_for():
    own = Channel(loss=0.3, max_consecutive_losses=5)
    with pytest.warns(UserWarning, match=r"0.7\d* of the packets are lost in the long run, not 0.8: .* 5 in a row"):
        assert changed_channel(own, {"loss": 0.8}).mean_loss < 0.8
    longer = changed_channel(own, {"loss": 0.8, "max_consecutive_losses": 40})
    assert longer.max_consecutive_losses == 40
