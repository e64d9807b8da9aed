"""The network between sensor and controller.

`channel` has the settings (packet loss, quantization, transmission period, delay and jitter), `channel_state` what
happens to packets during an episode, and `contract` what a channel guarantees about the age of samples.
"""

from ncs_gym.network.channel import Channel, GilbertElliott, Packet
from ncs_gym.network.channel_state import ChannelState
from ncs_gym.network.contract import ChannelContract, contract_of

__all__ = ["Channel", "ChannelContract", "ChannelState", "GilbertElliott", "Packet", "contract_of"]
