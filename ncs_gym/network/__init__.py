"""The network between sensor and controller.

`channel` has the settings (packet loss, quantization, transmission period, delay and jitter), `transmission` what
happens to packets during an episode, `contract` what a channel guarantees about the age of samples, and
`escape_probability` how likely Gaussian noise is to leave its bounds, given how many samples a channel takes.
"""

from ncs_gym.network.channel import Channel, GilbertElliott, Packet
from ncs_gym.network.contract import ChannelContract, contract_of
from ncs_gym.network.escape_probability import escape_probability
from ncs_gym.network.packet_transmission import ChannelState

__all__ = [
    "Channel",
    "ChannelContract",
    "ChannelState",
    "GilbertElliott",
    "Packet",
    "contract_of",
    "escape_probability",
]
