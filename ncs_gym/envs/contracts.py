"""What the estimator and certificates of a control loop may rest on: the contracts of its two channels."""

from __future__ import annotations

from typing import Any

from ncs_gym.downlink.protocol import DownlinkProtocol, downlink_protocol
from ncs_gym.envs.settings import assumed_contract
from ncs_gym.network.channel import Channel
from ncs_gym.network.contract import ChannelContract
from ncs_gym.plants.linear_plant import LinearPlant


def loop_contracts(
    plant: LinearPlant, channel: Channel, contract: Any, downlink: Any, downlink_contract: Any
) -> tuple[ChannelContract | None, DownlinkProtocol | None, ChannelContract | None]:
    """Returns the contract of the uplink, the protocol of the downlink and the contract of a certificate for both.

    The certificate's also counts the steps between a decision and its effect.

    Raises:
        UnstablePlantError: If an unstable plant has neither a contract nor a channel that keeps one.
        ValueError: If the channel rounds more coarsely than the contract allows, or a setting is wrong.
    """
    assumed = assumed_contract(plant, channel, contract)
    protocol = downlink_protocol(downlink, downlink_contract)
    return assumed, protocol, assumed if protocol is None else protocol.behind(assumed)
