"""The network between controller and actuator: inputs are committed ahead, so that lost commands change nothing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from operator import index
from typing import Any, NamedTuple

import numpy as np

from ncs_gym.network.channel import MAX_AGE, Channel, ChannelContract, contract_of, largest_age
from ncs_gym.network.packet_loss_and_delay import ChannelState, VectorChannelState
from ncs_gym.validation import (
    CopiedWhole,
    as_count,
    as_flag,
    as_numbers,
    counted,
    frozen,
    read_only,
    shown,
    warn_caller,
)

# Stamp of the newest command where none has arrived.
NEVER = -(2**31)
# Digest of the inputs before the first step.
NO_INPUTS = bytes(16)


class Command(NamedTuple):
    """What is sent to the actuator at one step.

    Attributes:
        stamp: Step k at which it was sent, counted from the start of its episode.
        inputs: The committed inputs of steps k .. k + c, shape (c+1, m) [physical units].
        episode: Number of that episode.
        requests: Whether the samples of steps k + 1 .. k + c + 1 are requested; empty where they are not on request.
    """

    stamp: int
    inputs: np.ndarray
    episode: int = 0
    requests: tuple[bool, ...] = ()


class Echo(NamedTuple):
    """What an actuator says that it has applied since the start of an episode.

    Attributes:
        steps: k: it is about the inputs of steps 0 .. k-1.
        missing: In how many of them the committed input had not arrived, or no input was applied at all.
        digest: `digest_of_inputs` of what was applied; the same number of steps with other inputs has another one.
        episode: Number of that episode.
    """

    steps: int
    missing: int
    digest: bytes
    episode: int = 0


def digest_of_inputs(before: bytes, u: np.ndarray | None) -> bytes:
    """Returns 16 bytes that stand for all inputs of an episode so far, (m,) each.

    Args:
        before: The digest before this step; `NO_INPUTS` at the start.
        u: What was applied; None for a step at which nothing was.
    """
    return blake2b(before + (b"" if u is None else (u + 0.0).astype("<f8").tobytes()), digest_size=16).digest()


class Actuator(CopiedWhole):
    """Applies at each step the input that was committed for it, or zero if no command with it has arrived.

    Commands may be lost, late, early, duplicated or overtake each other: what is committed for a step is the same in
    each command that holds it. The first c inputs of an episode are zero by agreement. A command stamped far ahead of
    the step that comes next, or with an input beyond the limits, is refused.

    Args:
        input_delay: c, the number of steps from a decision to its effect.
        inputs: m, the number of inputs.
        u_max: Largest size of each input, a number or shape (m,) [physical units], of a plant `plant.largest_input`;
            None where the plant limits them.

    Attributes:
        input_delay: c.
        missing: Whether the input applied last was zero because the committed one had not arrived.
        requested: After `apply`, whether a sensor beside the actuator takes the sample of the next step, where samples
            are on request: not if a command said so, and always where none has arrived.
        refused: How many commands were refused in this episode, those of a later one included.
        echo: What was applied since the start of the episode, for `SafeLoop.receive(echoes=...)`.

    Raises:
        ValueError: If an argument is no whole number of its range, or the limits are no sizes of m inputs.
    """

    def __init__(self, input_delay: int, inputs: int, u_max: Any = None) -> None:
        self.input_delay = as_count(input_delay, "input_delay", low=0)
        self._nothing = np.zeros(as_count(inputs, "inputs", low=1))
        self._limits = np.full_like(self._nothing, np.inf)
        if u_max is not None:
            limits = as_numbers(u_max)
            if limits is None or limits.shape not in ((), self._nothing.shape) or not (limits >= 0.0).all():
                raise ValueError(
                    f"u_max must be a size, or one of each of the {counted(inputs, 'input')}, got {shown(u_max)}"
                )
            self._limits = self._limits.clip(max=limits)
        self.start()

    def start(self, episode: int = 0) -> None:
        """Starts an episode at step 0: commands of any other are discarded from now on."""
        self.echo = Echo(0, 0, NO_INPUTS, as_count(episode, "episode", low=0))
        self._committed: dict[int, np.ndarray] = {}
        self._requested: dict[int, bool] = {}
        self.missing, self.requested, self.refused = False, True, 0

    def receive(self, commands: Iterable[Command]) -> None:
        """Takes in what arrived, in any order.

        Raises:
            ValueError: If what is given are no commands for this actuator; nothing has changed then.
        """
        if isinstance(commands, Command) or not isinstance(commands, Iterable):
            raise ValueError(
                f"commands must be a list of Command(stamp, inputs), empty if nothing arrived, got {shown(commands)}"
            )
        now = self.echo.steps
        for command in [_as_command(each, (self.input_delay + 1, len(self._nothing))) for each in commands]:
            if command.episode > self.echo.episode:
                self._refuse_later(command.episode)
            if command.episode != self.echo.episode:
                continue
            if command.stamp > now + self.input_delay + 1 or (np.abs(command.inputs) > self._limits).any():
                self.refused += 1
                continue
            for ahead, u in enumerate(command.inputs, command.stamp):
                if ahead >= now:
                    self._committed.setdefault(ahead, u)
            for ahead, requested in enumerate(command.requests, command.stamp):
                if ahead >= now:
                    self._requested.setdefault(ahead, requested)

    def _refuse_later(self, episode: int) -> None:
        self.refused += 1
        if self.refused == 1:
            warn_caller(
                f"a command of episode {episode} was refused in episode {self.echo.episode}, and no input of it is "
                f"applied: start({episode}) begins it",
                UserWarning,
            )

    def apply(self, step: int) -> np.ndarray:
        """Returns the input to apply at a step, shape (m,) [physical units], as a new array.

        Steps that were left out since the last call count as missing, but for the first c, which are zero by agreement.

        Raises:
            ValueError: If the step is no whole number from 0 on.
        """
        step = as_count(step, "step", low=0)
        committed = self._committed.get(step) if step >= self.input_delay else self._nothing
        self.missing = committed is None
        self.requested = self._requested.get(step, True)
        u = (self._nothing if committed is None else committed).copy()
        steps, missing, digest, episode = self.echo
        if step >= steps:
            for _ in range(steps, min(step, self.input_delay)):
                digest = digest_of_inputs(digest, self._nothing)
            left_out = step - max(steps, min(step, self.input_delay))
            if left_out > 0:
                missing, digest = missing + left_out, digest_of_inputs(digest, None)
            self.echo = Echo(step + 1, missing + self.missing, digest_of_inputs(digest, u), episode)
            self._committed = {ahead: each for ahead, each in self._committed.items() if ahead >= step}
            self._requested = {ahead: each for ahead, each in self._requested.items() if ahead >= step}
        elif step < steps - 1:  # a clock that went back: what is applied now is none of the inputs that were decided
            self.echo = Echo(steps, missing + 1, digest_of_inputs(digest, None), episode)
        return u


def _as_command(value: Any, shape: tuple[int, int]) -> Command:
    stamp = episode = 0
    requests: tuple[bool, ...] = ()
    try:
        stamp, inputs, episode, requests = value if isinstance(value, Command) else Command(*value)
        stamp, episode, numbers = index(stamp), index(episode), as_numbers(inputs)
        requests = tuple(as_flag(each, "a request") for each in requests)
    except (TypeError, ValueError):
        numbers = None
    complete = len(requests) in (0, shape[0])
    if numbers is None or numbers.shape != shape or not np.isfinite(numbers).all() or not complete:
        raise ValueError(
            "a command is Command(stamp, inputs) or Command(stamp, inputs, episode) with whole numbers and finite "
            f"inputs of shape {shape}, and as many requests or none, got {shown(value)}"
        )
    return Command(stamp, np.array(numbers), episode, requests)


def as_echo(value: Any) -> Echo:
    """Returns an echo; raises ValueError for what is none."""
    try:
        steps, missing, digest, episode = value
        if isinstance(digest, bytes):
            return Echo(index(steps), index(missing), digest, index(episode))
    except (TypeError, ValueError):
        pass
    raise ValueError(f"an echo is what Actuator.echo says, got {shown(value)}")


class CommittedInputs:
    """The inputs decided for the next c steps, `pending`, the earliest first; none of them is ever changed.

    Args:
        input_delay: c, the number of steps from a decision to its effect.
        shape: Of an input: m, or (m, N) for N environments.
    """

    def __init__(self, input_delay: int, shape: int | tuple[int, int]) -> None:
        self._input_delay, self._nothing = input_delay, read_only(np.zeros(shape))
        self.start()

    def start(self, chosen: np.ndarray | None = None) -> None:
        """Starts an episode, in all environments or in those of a mask (N,); its first c inputs are zero."""
        if chosen is None or chosen.all():
            self.pending: tuple[np.ndarray, ...] = (self._nothing,) * self._input_delay
        else:
            self.pending = tuple(np.where(chosen, 0.0, u) for u in self.pending)

    def commit(self, u: Any) -> None:
        """Adds the input decided now."""
        self.pending = (*self.pending, np.array(u, dtype=np.float64))

    def command(self, step: int, episode: int, requests: tuple[bool, ...] = ()) -> Command:
        """Returns the command to send at a step, after the commitment of that step."""
        return Command(step, np.array(self.pending), episode, requests)

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


class AppliedInputs:
    """Compares what an actuator says it applied with what was decided, in one control loop.

    Args:
        oldest: How many steps an echo may be old to count; None if no echoes are expected.

    Attributes:
        is_other: Whether an echo of this episode contradicts what was decided.
    """

    def __init__(self, oldest: int | None) -> None:
        self._oldest = oldest
        self.start()

    def start(self) -> None:
        """Starts an episode."""
        self.is_other, self._confirmed, self._strange = False, 0, -np.inf
        self._digests: tuple[bytes, ...] = (
            NO_INPUTS,
        )  # after the newest number of steps, then one step less, and so on

    def add(self, u: np.ndarray) -> None:
        """Takes in the input that was due in the step that has gone by, shape (m,)."""
        if self._oldest is not None:
            self._digests = (digest_of_inputs(self._digests[0], u), *self._digests[: self._oldest])

    def compare(self, echoes: Iterable[Echo], step: int, episode: int) -> None:
        """Takes in what arrived by a step; echoes from ahead of it, too old or of another episode say nothing."""
        for echo in echoes:
            age = step - echo.steps
            if echo.episode != episode:
                self._strange = step
            if echo.episode != episode or self._oldest is None or not 0 <= age < len(self._digests):
                continue
            if echo.missing or echo.digest != self._digests[age]:
                self.is_other = True
            self._confirmed = max(self._confirmed, echo.steps)

    def is_confirmed(self, step: int) -> bool:
        """Returns whether what was applied is known to be what was decided, up to the largest age of an echo."""
        return self._oldest is None or step - self._confirmed <= self._oldest

    def hears_of_others(self, step: int) -> bool:
        """Returns whether echoes of another episode arrived no longer ago than the largest age of an echo."""
        return self._oldest is not None and step - self._strange <= self._oldest


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
