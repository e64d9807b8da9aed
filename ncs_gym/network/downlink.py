"""The network between controller and actuator: inputs are committed ahead, so that lost commands change nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ncs_gym.network.actuator import NEVER, Actuator, Command, CommittedInputs
from ncs_gym.network.channel import Channel
from ncs_gym.network.contract import MAX_AGE, ChannelContract, contract_of, largest_age
from ncs_gym.network.packet_loss_and_delay import ChannelState, VectorChannelState
from ncs_gym.validation import counted, frozen, read_only, shown


@dataclass(frozen=True)
class DownlinkProtocol:
    """At step k the controller decides the input of step k + c, and sends the inputs of k .. k + c (docs/contracts.md).

    Under the downlink contract c, for every step t some command sent in [t-c, t] has arrived by t: the actuator then
    applies exactly what was decided for t, and no acknowledgement is needed.

    Attributes:
        channel: What happens to the commands; None for an ideal downlink, on which decisions are applied at once.
        input_delay: c, the number of steps from a decision to its effect.
        contract: What the channel guarantees, or what is assumed of it; None for nothing.
    """

    channel: Channel | None
    input_delay: int
    contract: ChannelContract | None

    def behind(self, contract: ChannelContract | None) -> ChannelContract | None:
        """Returns the contract that a certificate for this protocol rests on, given that of the uplink; None for None.

        When an input takes effect, the newest sample that it was decided with is up to c steps older.

        Raises:
            ValueError: If that is older than contracts can be.
        """
        if contract is None or self.input_delay == 0:
            return contract
        age = contract.max_age + self.input_delay
        if age > MAX_AGE:
            raise ValueError(f"contracts of uplink and downlink add up to {age} steps, more than {MAX_AGE}")
        return ChannelContract(age, contract.quantization_step)


IDEAL_DOWNLINK = DownlinkProtocol(None, 0, ChannelContract(0))


def downlink_protocol(downlink: Channel | None, contract: ChannelContract | None) -> DownlinkProtocol:
    """Returns the protocol for a downlink.

    Without a contract, given or by the channel's own settings, inputs are committed ahead for the longest delay only,
    and nothing is guaranteed.

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
        return IDEAL_DOWNLINK
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
    if downlink.on_request:
        raise ValueError("a downlink sends a command at every step: on_request is for the channel of the samples")
    if contract is None:
        contract = contract_of(downlink)
    elif not isinstance(contract, ChannelContract):
        raise ValueError(f"downlink_contract must be of type ChannelContract, got {shown(contract)}")
    elif contract.max_age < downlink.longest_delay:
        raise ValueError(
            f"the downlink delays commands by up to {counted(downlink.longest_delay, 'step')}, which a contract of "
            f"max_age = {contract.max_age} never allows"
        )
    return DownlinkProtocol(downlink, largest_age(contract, downlink.longest_delay), contract)


def require_fitting_downlink(protocol: DownlinkProtocol, downlink: Channel) -> None:
    """Raises ValueError unless a downlink may take the place of that of a protocol, whose c stays."""
    if protocol.channel is None:
        raise ValueError(
            "the environment has an ideal downlink, and commits no inputs ahead: make it with downlink=Channel(...)"
        )
    downlink_protocol(downlink, ChannelContract(protocol.input_delay))


class Inputs(NamedTuple):
    """The inputs of one step, read-only; of many environments, arrays whose last axis is the environment.

    Attributes:
        applied: What the actuator applies now, shape (m,) or (m, N) [physical units].
        committed: What was decided now, for c steps later, of the same shape.
        missing: Whether zero is applied because the input committed for now has not arrived, a bool or shape (N,).
    """

    applied: np.ndarray
    committed: np.ndarray
    missing: np.ndarray | bool


def no_inputs(inputs: int, size: int | None = None) -> Inputs:
    """Returns the inputs at a reset: zeros, shape (m,), or (m, N) for a size."""
    nothing = read_only(np.zeros(inputs if size is None else (inputs, size)))
    return Inputs(nothing, nothing, False if size is None else np.zeros(size, np.bool_))


class DownlinkState:
    """The commands of one control loop on their way, and the actuator's buffer.

    Args:
        protocol: The channel, and how far ahead inputs are committed.
        inputs: m.

    Attributes:
        committed: The inputs decided and not yet applied.
    """

    def __init__(self, protocol: DownlinkProtocol, inputs: int) -> None:
        self._channel, input_delay = protocol.channel, protocol.input_delay
        self._actuator, self.committed = Actuator(input_delay, inputs), CommittedInputs(input_delay, inputs)
        self.in_flight: ChannelState

    def begin(self, rng: np.random.Generator, episode: int = 0, channel: Channel | None = None) -> None:
        """Starts an episode, over another channel than that of the protocol if one is given."""
        self._channel = channel or self._channel
        if self._channel is not None:
            self.in_flight, self._episode = ChannelState(self._channel, rng), episode
            self._actuator.start(episode)
            self.committed.start()

    def exchange(self, rng: np.random.Generator, step: int, u: np.ndarray) -> Inputs:
        """Takes the input decided at a step, shape (m,), which nobody writes to then, and returns what is applied."""
        u.flags.writeable = False
        if self._channel is None:
            return Inputs(u, u, False)
        self.committed.commit(u)
        arrived: list[Command] = self.in_flight.carry(rng, step, self.committed.command(step, self._episode))
        self._actuator.receive(arrived)
        self.committed.pop()
        return Inputs(frozen(self._actuator.apply(step)), u, self._actuator.missing)


class VectorDownlinkState:
    """What `DownlinkState` is, for N environments, the last axis of every array.

    Every command holds the committed inputs of its c steps unchanged: which one is the newest is all that matters.
    """

    def __init__(self, protocol: DownlinkProtocol, inputs: int, size: int) -> None:
        self._channel, self._input_delay, self._size = protocol.channel, protocol.input_delay, size
        self.committed = CommittedInputs(self._input_delay, (inputs, size))
        self._newest, self._on_time = np.full(size, NEVER, np.int64), np.zeros(size, np.bool_)
        self._channel_state: VectorChannelState

    def begin(self, rng: np.random.Generator, chosen: np.ndarray, channels: Sequence[Channel] | None = None) -> None:
        """Starts episodes where a mask (N,) says so; `channels` are those of all N, None for all as before."""
        if self._channel is None:
            return
        if chosen.all():
            self._channel_state = VectorChannelState(channels or self._channel, rng, self._size)
        else:
            self._channel_state.begin(rng, np.flatnonzero(chosen), channels)
        self._newest[chosen] = NEVER
        self.committed.start(chosen)

    def exchange(self, rng: np.random.Generator, steps: np.ndarray, u: np.ndarray) -> Inputs:
        """Does what `DownlinkState` does, at steps (N,) of the episodes, with inputs of shape (m, N)."""
        frozen(u)
        if self._channel is None:
            return Inputs(u, u, self._on_time)
        scheduled = self.committed.due(u)
        self._channel_state.send(rng, steps)
        for age, arrives in self._channel_state.arrivals():
            self._newest = np.where(arrives, np.maximum(self._newest, steps - age), self._newest)
        missing = (self._newest < steps - self._input_delay) & (steps >= self._input_delay)
        return Inputs(frozen(np.where(missing, 0.0, scheduled)), u, missing)
