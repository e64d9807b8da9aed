"""Settings of a channel in words, and periods that `ncs channel` cannot read a record by."""

import pytest

from ncs_gym import Channel


@pytest.mark.parametrize(
    ("channel", "sentence"),
    [
        (
            Channel(),
            "sent every step, not quantized. A packet is lost with probability 0. What is not lost arrives at once.",
        ),
        (Channel(send_period=3, quantization_step=0.5), "sent every 3 steps, quantized with step 0.5."),
        (Channel(delay=1, jitter=2), "arrives 1 to 3 steps late."),
        (Channel(delay=1), "arrives 1 step late."),
        (Channel(loss=0.5, max_consecutive_losses=4), "probability 0.5, never more than 4 in a row."),
        (Channel(loss={"p_good_to_bad": 0.1, "p_bad_to_good": 0.2}), "Losses come in bursts"),
    ],
)
def test_channel_is_said_in_words(channel, sentence):
    assert sentence in channel.description
