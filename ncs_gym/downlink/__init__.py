"""The network between controller and actuator: inputs are committed ahead, so that lost commands change nothing.

`protocol` says which channels there can be and how far ahead inputs are decided, `actuator` is the buffer that knows
which committed inputs have arrived, `committed_inputs` the controller's queue of them. `prediction` moves the error
statistics to the time at which an input takes effect; `loop` and `vector_loop` put it together for one control loop and
for many (docs/contracts.md, "Both directions").
"""

from ncs_gym.downlink.actuator import Actuator, Command
from ncs_gym.downlink.committed_inputs import CommittedInputs
from ncs_gym.downlink.loop import CommittedDownlink, IdealDownlink
from ncs_gym.downlink.protocol import DownlinkProtocol, downlink_protocol
from ncs_gym.downlink.vector_loop import VectorCommittedDownlink, VectorIdealDownlink

__all__ = [
    "Actuator",
    "Command",
    "CommittedDownlink",
    "CommittedInputs",
    "DownlinkProtocol",
    "IdealDownlink",
    "VectorCommittedDownlink",
    "VectorIdealDownlink",
    "downlink_protocol",
]
