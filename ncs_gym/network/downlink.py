"""The network between controller and actuator: inputs are committed ahead, so that lost commands change nothing.

At step k the controller decides the input of step k + c, and sends those of k .. k + c (docs/contracts.md, "Both
directions").
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from operator import index
from typing import Any, NamedTuple

import numpy as np

from ncs_gym.network.channel import Channel
from ncs_gym.network.contract import MAX_AGE, ChannelContract, contract_of
from ncs_gym.network.packet_transmission import ChannelState, VectorChannelState
from ncs_gym.validation import as_count, as_numbers, read_only, shown

# Stamp of the newest command where none has arrived.
NEVER = -(2**31)


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


def require_fitting_downlink(protocol: DownlinkProtocol | None, downlink: Channel) -> None:
    """Returns if a downlink may take the place of a protocol's, whose c and contract stay; it may break the contract.

    Raises:
        ValueError: If there is no downlink to take the place of, or what is given is none, or delays commands by more
            than c steps.
    """
    if protocol is None:
        raise ValueError(
            "the environment has an ideal downlink, and commits no inputs ahead: make it with downlink=Channel(...)"
        )
    downlink_protocol(downlink, ChannelContract(protocol.lead))


class Command(NamedTuple):
    """What is sent to the actuator at one step.

    Attributes:
        stamp: Step k at which it was sent, counted from the start of its episode.
        inputs: The committed inputs of steps k .. k + c, shape (c+1, m) [physical units].
        episode: Number of that episode.
    """

    stamp: int
    inputs: np.ndarray
    episode: int = 0


class Actuator:
    """Applies at each step the input that was committed for it, or zero if no command with it has arrived.

    Commands may be lost, late, duplicated or overtake each other: what is committed for a step is the same in each
    command that holds it, so that the newest is enough. The first c inputs of an episode are zero by agreement.

    Args:
        lead: c, the number of steps from a decision to its effect.
        inputs: m, the number of inputs.

    Attributes:
        missing: Whether the input applied last was zero because the committed one had not arrived.

    Raises:
        ValueError: If an argument is no whole number of its range.
    """

    def __init__(self, lead: int, inputs: int) -> None:
        self._lead = as_count(lead, "lead", low=0)
        self._nothing = np.zeros(as_count(inputs, "inputs", low=1))
        self.start()

    def start(self, episode: int = 0) -> None:
        """Starts an episode at step 0: commands of any other are discarded from now on.

        Raises:
            ValueError: If the number of the episode is no whole number from 0 on.
        """
        self._episode, self._newest = as_count(episode, "episode", low=0), None
        self.missing = False

    def receive(self, commands: Iterable[Command]) -> None:
        """Takes in what arrived, in any order; commands that are not newer than the newest are of no use.

        Raises:
            ValueError: If what is given are no commands for this actuator; nothing has changed then.
        """
        if isinstance(commands, Command) or not isinstance(commands, Iterable):
            raise ValueError(
                f"commands must be a list of Command(stamp, inputs), empty if nothing arrived, got {shown(commands)}"
            )
        for command in [_as_command(each, (self._lead + 1, len(self._nothing))) for each in commands]:
            if command.episode == self._episode and (self._newest is None or command.stamp > self._newest.stamp):
                self._newest = command

    def apply(self, step: int) -> np.ndarray:
        """Returns the input to apply at a step, shape (m,) [physical units], as a new array.

        Raises:
            ValueError: If the step is no whole number from 0 on.
        """
        step = as_count(step, "step", low=0)
        ahead = self._lead + 1 if self._newest is None else step - self._newest.stamp
        self.missing = not 0 <= ahead <= self._lead and step >= self._lead
        if self._newest is None or self.missing or step < self._lead:
            return self._nothing.copy()
        return self._newest.inputs[ahead].copy()


def _as_command(value: Any, shape: tuple[int, int]) -> Command:
    """Returns a command whose inputs have a shape, (c+1, m).

    Raises:
        ValueError: If stamp or episode is no whole number, or the inputs are not finite numbers of that shape.
    """
    stamp = episode = 0
    try:
        stamp, inputs, episode = value if isinstance(value, Command) else Command(*value)
        stamp, episode, numbers = index(stamp), index(episode), as_numbers(inputs)
    except (TypeError, ValueError):
        numbers = None
    if numbers is None or numbers.shape != shape or not np.isfinite(numbers).all():
        raise ValueError(
            "a command is Command(stamp, inputs) or Command(stamp, inputs, episode) with whole numbers and finite "
            f"inputs of shape {shape}, got {shown(value)}"
        )
    return Command(stamp, np.array(numbers), episode)


class CommittedInputs:
    """The inputs decided for the next c steps, the earliest first; once an input is among them, it is never changed.

    Args:
        lead: c, the number of steps from a decision to its effect.
        shape: Of an input: m, or (m, N) for N environments.

    Attributes:
        pending: These inputs.
    """

    def __init__(self, lead: int, shape: int | tuple[int, int]) -> None:
        self._lead, self._nothing = lead, read_only(np.zeros(shape))
        self.start()

    def start(self, chosen: np.ndarray | None = None) -> None:
        """Starts an episode, in all environments or in those of a mask (N,): the inputs of its first c steps are zero.

        In all of them, whatever interrupted the last step leaves nothing behind.
        """
        if chosen is None or chosen.all():
            self.pending: tuple[np.ndarray, ...] = (self._nothing,) * self._lead
        else:
            self.pending = tuple(np.where(chosen, 0.0, u) for u in self.pending)

    def saved(self) -> dict[str, Any]:
        """Returns all that changes, as attributes to be put back."""
        return {"pending": self.pending}

    def commit(self, u: Any) -> None:
        """Adds the input decided now."""
        self.pending = (*self.pending, np.array(u, dtype=np.float64))

    def command(self, step: int, episode: int) -> Command:
        """Returns the command to send at a step, after the commitment of that step."""
        return Command(step, np.array(self.pending), episode)

    def pop(self) -> np.ndarray:
        """Removes and returns the input whose step has come."""
        due, *rest = self.pending
        self.pending = tuple(rest)
        return due

    def due(self, u: Any) -> np.ndarray:
        """Adds the input decided now, and removes and returns the one whose step has come: both, or neither."""
        due, *rest = *self.pending, np.array(u, dtype=np.float64)
        self.pending = tuple(rest)
        return due


class Inputs(NamedTuple):
    """The inputs of one step; of many environments, arrays whose last axis is the environment.

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
    if size is None:
        return Inputs(np.zeros(inputs), np.zeros(inputs), False)
    return Inputs(np.zeros((inputs, size)), np.zeros((inputs, size)), np.zeros(size, np.bool_))


class DownlinkState:
    """The commands of one control loop on their way, and the actuator's buffer.

    Args:
        protocol: The channel, and how far ahead inputs are committed; None applies at once what is decided.
        inputs: m.

    Attributes:
        committed: The inputs decided and not yet applied.
        in_flight: The channel and the commands on their way.
    """

    def __init__(self, protocol: DownlinkProtocol | None, inputs: int) -> None:
        lead = 0 if protocol is None else protocol.lead
        self._channel = None if protocol is None else protocol.channel
        self._actuator, self.committed = Actuator(lead, inputs), CommittedInputs(lead, inputs)
        self.in_flight: ChannelState

    def begin(self, rng: np.random.Generator, episode: int = 0, channel: Channel | None = None) -> None:
        """Starts an episode, over another channel than that of the protocol if one is given."""
        self._channel = channel or self._channel
        if self._channel is not None:
            self.in_flight, self._episode = ChannelState(self._channel, rng), episode
            self._actuator.start(episode)
            self.committed.start()

    def exchange(self, rng: np.random.Generator, step: int, u: np.ndarray) -> Inputs:
        """Takes the input decided at a step, shape (m,), and returns what is applied then."""
        if self._channel is None:
            return Inputs(u, u, False)
        self.committed.commit(u)
        arrived: list[Command] = self.in_flight.carry(rng, step, self.committed.command(step, self._episode))
        self._actuator.receive(arrived)
        self.committed.pop()
        return Inputs(self._actuator.apply(step), u, self._actuator.missing)


class VectorDownlinkState:
    """What `DownlinkState` is, for N environments, the last axis of every array.

    Every command holds the committed inputs of its c steps unchanged: which one is the newest is all that matters.

    Args:
        protocol: The channel, and how far ahead inputs are committed; None applies at once what is decided.
        inputs: m.
        size: N.

    Attributes:
        committed: The inputs decided and not yet applied.
    """

    def __init__(self, protocol: DownlinkProtocol | None, inputs: int, size: int) -> None:
        self._lead, self._size = 0 if protocol is None else protocol.lead, size
        self._channel = None if protocol is None else protocol.channel
        self.committed = CommittedInputs(self._lead, (inputs, size))
        self._newest, self._on_time = np.full(size, NEVER, np.int64), np.zeros(size, np.bool_)
        self._channel_state: VectorChannelState

    def begin(self, rng: np.random.Generator, chosen: np.ndarray, channels: Sequence[Channel] | None = None) -> None:
        """Starts episodes in some environments, given by a mask of shape (N,).

        Args:
            rng: Source of randomness.
            chosen: The mask.
            channels: Those of all N environments from now on, the others' being as before; None for all as before.
        """
        if self._channel is None:
            return
        if chosen.all():
            self._channel_state = VectorChannelState(channels or self._channel, rng, self._size)
        else:
            self._channel_state.begin(rng, chosen, channels)
        self._newest[chosen] = NEVER
        self.committed.start(chosen)

    def exchange(self, rng: np.random.Generator, steps: np.ndarray, u: np.ndarray) -> Inputs:
        """Takes the inputs decided at steps (N,) of the episodes, shape (m, N), and returns what is applied then."""
        if self._channel is None:
            return Inputs(u, u, self._on_time)
        scheduled = self.committed.due(u)
        self._channel_state.send(rng, steps)
        for age, arrives in self._channel_state.arrivals():
            self._newest = np.where(arrives, np.maximum(self._newest, steps - age), self._newest)
        missing = (self._newest < steps - self._lead) & (steps >= self._lead)
        return Inputs(np.where(missing, 0.0, scheduled), u, missing)
