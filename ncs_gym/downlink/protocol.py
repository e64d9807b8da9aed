"""What a downlink is: a channel for commands, and how far ahead inputs are committed because of it."""

from __future__ import annotations

from dataclasses import dataclass

from ncs_gym.network.channel import Channel
from ncs_gym.network.contract import MAX_AGE, ChannelContract, contract_of
from ncs_gym.validation import shown


@dataclass(frozen=True)
class DownlinkProtocol:
    """At step k the controller decides the input of step k + c, and sends the inputs of k .. k + c (docs/contracts.md).

    Under the downlink contract c, for every step t some command sent in [t-c, t] has arrived by t: the actuator then
    applies exactly what was decided for t, and no acknowledgement is needed.

    Attributes:
        channel: What happens to the commands.
        lead: c, the number of steps from a decision to its effect.
        contract: What the channel guarantees, or what is assumed of it; None for nothing.
    """

    channel: Channel
    lead: int
    contract: ChannelContract | None

    def behind(self, contract: ChannelContract | None) -> ChannelContract | None:
        """Returns the contract that a certificate for this protocol rests on, given that of the uplink.

        When an input takes effect, the newest sample that it was decided with is up to c steps older. None for None.

        Raises:
            ValueError: If that is older than contracts can be.
        """
        if contract is None or self.lead == 0:
            return contract
        age = contract.max_age + self.lead
        if age > MAX_AGE:
            raise ValueError(f"contracts of uplink and downlink add up to {age} steps, more than {MAX_AGE}")
        return ChannelContract(age, contract.quantization_step)


def downlink_protocol(downlink: Channel | None, contract: ChannelContract | None) -> DownlinkProtocol | None:
    """Returns the protocol for a downlink; None for an ideal one.

    Without a contract, given or by the channel's own settings, inputs are committed ahead for the longest delay only:
    that can be simulated, but nothing is guaranteed.

    Args:
        downlink: The channel for the commands; None for an ideal downlink.
        contract: What is assumed of it, which it may then break; None for what it guarantees by its settings.

    Raises:
        ValueError: If a setting is of the wrong kind, makes no sense on a downlink, or the contract is shorter than the
            delay.
    """
    if downlink is None:
        if contract is not None:
            raise ValueError("downlink_contract is about a downlink: give downlink=Channel(...), too")
        return None
    if not isinstance(downlink, Channel):
        raise ValueError(f"downlink must be of type Channel, got {shown(downlink)}")
    if downlink.quantization_step != 0.0:
        raise ValueError(
            "a downlink carries inputs as they are, without quantization: leave out quantization_step, which is "
            f"{downlink.quantization_step}"
        )
    if downlink.send_period != 1:
        raise ValueError(
            f"a downlink sends a command at every step: leave out send_period, which is {downlink.send_period}"
        )
    if contract is None:
        contract = contract_of(downlink)
    elif not isinstance(contract, ChannelContract):
        raise ValueError(f"downlink_contract must be of type ChannelContract, got {shown(contract)}")
    elif contract.max_age < downlink.longest_delay:
        raise ValueError(
            f"the downlink delays commands by up to {downlink.longest_delay} steps, which a contract of max_age = "
            f"{contract.max_age} never allows"
        )
    lead = downlink.longest_delay if contract is None else contract.max_age
    return DownlinkProtocol(downlink, lead, contract)
