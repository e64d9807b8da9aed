"""The network between sensor and controller, and between controller and actuator.

`channel` has the settings (packet loss, quantization, transmission period, delay and jitter), `packet_loss_and_delay`
what happens to packets during an episode, `contract` what a channel guarantees about the age of samples,
`packet_reception` which packets a receiver can use, and `gaussian_bound` says how likely Gaussian noise is to leave its
bounds, given how many samples a channel takes. `packet_log` is a record of packets, whose ages a `TraceChannel`
replays, and `log_files` reads it from files.
`downlink` is the way of the commands during an episode, `actuator` what commands and echoes hold, and what is applied.
"""

from ncs_gym.network.actuator import Actuator, AppliedInputs, Command, CommittedInputs, Echo
from ncs_gym.network.channel import Channel, GilbertElliott, Packet, TraceChannel
from ncs_gym.network.contract import BrokenContractWarning, ChannelContract, contract_of
from ncs_gym.network.downlink import DownlinkProtocol, downlink_protocol
from ncs_gym.network.gaussian_bound import bound_violation_probability
from ncs_gym.network.packet_log import PacketLog
from ncs_gym.network.packet_loss_and_delay import ChannelState
from ncs_gym.network.packet_reception import DiscardedPackets, UnusedPacketsWarning

__all__ = [
    "Actuator",
    "AppliedInputs",
    "BrokenContractWarning",
    "Channel",
    "ChannelContract",
    "ChannelState",
    "Command",
    "CommittedInputs",
    "DiscardedPackets",
    "DownlinkProtocol",
    "Echo",
    "GilbertElliott",
    "Packet",
    "PacketLog",
    "TraceChannel",
    "UnusedPacketsWarning",
    "bound_violation_probability",
    "contract_of",
    "downlink_protocol",
]
