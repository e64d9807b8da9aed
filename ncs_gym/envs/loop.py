"""One control loop, or N side by side: what it is made of, and how it moves."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ncs_gym.disturbances import Disturbance, as_disturbance, as_noise
from ncs_gym.ellipsoid import Ellipsoid
from ncs_gym.envs.episode_channels import covering, downlinks, uplinks
from ncs_gym.envs.loop_settings import expect, loop_contracts, starting_set
from ncs_gym.envs.spaces import nearest_action
from ncs_gym.estimation.arrival_histories import ArrivalHistories, arrival_histories
from ncs_gym.estimation.error_bound import ErrorSet
from ncs_gym.estimation.estimator import Belief, Estimator, VectorEstimator
from ncs_gym.network.channel import Channel, ChannelContract, UnusedPacketsWarning, largest_age
from ncs_gym.network.downlink import DownlinkProtocol, DownlinkState, Inputs, VectorDownlinkState, no_inputs
from ncs_gym.network.packet_loss_and_delay import ChannelState, VectorChannelState
from ncs_gym.network.requests import Requests
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes.plant_step import PlantSimulation
from ncs_gym.processes.process import LinearProcess, Process, as_process, own_process
from ncs_gym.validation import CopiedWhole, as_flag, frozen, warn_caller

# Keeps the rounding of a sampled start inside the initial set.
SAMPLE_ROUNDING = 1e-9
# What is a number in the info of one environment, and of many an array that the environments go on using.
_SHARED = (
    *("measurement_age", "assumption_violated", "packets", "episode_steps", "episode_violations", "packet_arrived"),
    *("downlink_broken", "requested", "request_forced"),
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Loop:
    """What a control loop is made of: a plant, what acts on it and moves, and the networks of both directions.

    The fields are those of `NCSEnv`.

    Attributes:
        protocol: How commands are sent over the downlink, with its `input_delay`: 0 for an ideal one.
        certificate_contract: Contract that a certificate for this loop rests on: `contract` with c steps added.
        error_set: Certified error set, or sets by age.
        limits_the_way: Whether there are limits beyond those of states at samples: at all times, or of states and
            inputs.
        oldest: The largest age of the newest sample that the contract allows [steps]; infinite without one.

    Raises:
        UnstablePlantError: If the plant is not Schur stable and there is no contract.
        ErrorSetError: If it is too ill-conditioned.
        ValueError: If a setting is of the wrong kind or does not fit the plant.
    """

    plant: LinearPlant
    channel: Any = None
    disturbance: Any = "ball"
    initial_set: Any = None
    allow_assumption_violation: bool = False
    contract: ChannelContract | None = None
    noise: str = "truncated"
    process: Any = None
    downlink: Channel | None = None
    downlink_contract: ChannelContract | None = None
    protocol: DownlinkProtocol = field(init=False)
    certificate_contract: ChannelContract | None = field(init=False)
    error_set: ErrorSet = field(init=False)
    limits_the_way: bool = field(init=False)
    oldest: float = field(init=False)

    def __post_init__(self) -> None:
        plant = expect(self.plant, LinearPlant, "plant")
        channel = Channel() if self.channel is None else expect(self.channel, Channel, "channel")
        allowed = as_flag(self.allow_assumption_violation, "allow_assumption_violation")
        disturbance: Disturbance = as_disturbance(self.disturbance, plant, allowed)
        initial_set: Ellipsoid = starting_set(self.initial_set, plant)
        process: Process = own_process(plant) if self.process is None else as_process(self.process)
        if plant.between_samples is not None and not isinstance(process, LinearProcess):
            raise ValueError(
                "between_samples is about the plant's own equations: beside another process= give a plant with "
                "between_samples=1"
            )
        made = loop_contracts(plant, channel, self.contract, self.downlink, self.downlink_contract)
        contract, protocol, certificate_contract = made
        own, downlink_contract = vars(self), None if self.downlink is None else protocol.contract
        own.update(channel=channel, disturbance=disturbance, initial_set=initial_set, process=process)
        own.update(contract=contract, certificate_contract=certificate_contract, oldest=largest_age(contract))
        own.update(protocol=protocol, downlink_contract=downlink_contract, noise=as_noise(self.noise, plant))
        own.update(limits_the_way=len(plant.step_rows) > 0)
        histories = self.histories(channel)
        own.update(error_set=histories.recursion.error_set)
        if not histories.uses_samples:
            step = channel.quantization_step
            rounded = f", rounded to {step:g}" if step else ""
            warn_caller(
                f"no packet is of use: with this sensor noise{rounded}, samples move the estimate by less than 1 % of "
                "what they differ by, so that it is a prediction",
                UnusedPacketsWarning,
            )

    def histories(self, channel: Channel) -> ArrivalHistories:
        """Returns the graph of arrival histories that loops over a channel with these delays share."""
        return arrival_histories(self.plant, channel, self.certificate_contract)


class LoopState(CopiedWhole, ABC):
    """Where a loop is, or where N are; the last axis of every array is then the loop.

    Args:
        loop: What it is made of.
        size: N; None for one loop, whose values are numbers in place of arrays.

    Attributes:
        state: x, shape (n,) or (n, N).
        worst: `worst_constraint_values` of the last step, shape (k + q,) or (k + q, N).
        inputs, arrived: Those of the last step, and whether a packet arrived then, a bool or shape (N,).
        steps, episodes: Steps taken in the episode, and episodes begun, ints or shape (N,).
        moves: Steps and resets since the loop was made, an int or shape (N,).
        start: What the start of the episode is known to lie in, for one loop; for N, states that episodes were started
            at by an option or outside the initial set, NaN elsewhere, shape (N, n).
        channels, downlinks: Those of the present episodes.
        links: Both, by the name of their option of `reset`, and None for the key that channels of several parts have.
    """

    def __init__(self, loop: Loop, size: int | None = None) -> None:
        plant, count = loop.plant, size or 1
        self.loop, self._size = loop, size
        allowed = loop.allow_assumption_violation
        self.process = PlantSimulation(plant, loop.disturbance, allowed, size, noise=loop.noise, process=loop.process)
        self.channels = uplinks(loop.channel, plant.dt, count)
        self.downlinks = downlinks(loop.downlink, loop.protocol, plant.dt, count)
        self.links = {("channel", None): self.channels, ("downlink", None): self.downlinks}
        self.requests = None
        if loop.channel.on_request:
            self.requests = Requests(loop.channel, loop.contract, loop.protocol.input_delay, size)
        self._others: dict[str, Any] = {}
        self._no_inputs = self.inputs = no_inputs(plant.m, size)
        self.arrived: Any = self._no_inputs.missing

    def read(self, options: dict[str, Any] | None) -> tuple[list[Any], np.ndarray | None]:
        """Returns what options of `reset` say of channels and of parameters; raises ValueError if one is wrong."""
        given = options or {}
        sources = [links.read(given.get(name), name) for (name, _), links in self.links.items()]
        return sources, self.process.read_parameters(given.get("parameters"))

    def choose(self, sources: list[Any], rng: np.random.Generator, rows: Sequence[int] = (0,)) -> list[dict[int, Any]]:
        """Returns the channels of the next episodes of some loops, up and down, as `begin` takes them."""
        return [links.choose(each, rng, rows) for links, each in zip(self.links.values(), sources, strict=True)]

    def _channel_infos(self) -> dict[str, Any]:
        many = self._size is not None
        return self.channels.infos("channel", many=many) | self.downlinks.infos("downlink", many=many)

    def move(self, rng: np.random.Generator, u: np.ndarray) -> None:
        """Moves one step on; what is decided now is `u`, shape (m,) or (m, N) [physical units]."""
        self.moves = self.moves + 1
        self.inputs = inputs = self.downlink.exchange(rng, self.steps, u)
        before, requested = self.state, None
        if self.requests is not None:
            self.requests.decide(self.estimator.age)
            # A sensor that has not heard whether a sample is requested takes it.
            requested = self.requests.decided[0] | inputs.missing
        self.state = self.process.advance(rng, before, inputs.applied, self.steps, self.memory).view()
        self.state.flags.writeable = False  # tasks, which read it, are code of others
        self.worst = self.loop.plant.worst_constraint_values(before, inputs.applied, self.state)
        self.steps = self.steps + 1
        self.arrived = self._receive(rng, inputs.applied, requested)

    def report(
        self, read: tuple[np.ndarray, np.ndarray] | None = None, counted: Any = 1.0
    ) -> tuple[Belief, dict[str, Any]]:
        """Returns what a controller can know, and `info`, which says what is true besides.

        Every array is a fresh copy that nobody writes into, or that is the caller's; the loop is the last axis of the
        former and the first one of what `info` holds for many. Keys of a feature are there where the loop has it.

        Args:
            read: What `read_action` returned of the action that asked for the inputs.
            counted: A mask, shape (N,): the costs of other loops do not count once more.
        """
        loop, plant, estimator, worst = self.loop, self.loop.plant, self.estimator, self.worst
        state, (applied, committed, missing), table = self.state, self.inputs, estimator.histories.table
        values = plant.constraint_values(state) if loop.limits_the_way else worst
        estimate, number = estimator.numbered(self.downlink.committed.pending)
        age, damaged, outside = estimator.age, estimator.damaged, self.process.alarm
        alarm = estimator.alarm | outside
        if self._size is None:
            cost, alarm = 1.0 if max(worst.tolist()) > 0.0 else 0.0, bool(alarm)
        else:
            cost = (np.maximum.reduce(worst) > 0.0).astype(np.float64)
            values = values.copy() if values is worst else values
            age, damaged, outside = (frozen(each.copy()) for each in (age, damaged, outside))
            for array in (estimate, number, alarm, self.moves):
                frozen(array)
        self.violations = self.violations + cost * counted
        belief = Belief(estimate, number, table, age, alarm, damaged, outside, applied, committed, self.moves)
        actions = _actions_of(self.inputs, plant, read)
        info = {
            "state": state.copy().T,
            "estimate": estimate.copy().T,
            "estimation_error": (estimator.mean - state).T,
            "error_shape": belief.error_shape.copy(),
            "input": applied.copy().T,
            "action_applied": actions[0],
            "action_committed": actions[1],
            "constraint_values": values.T,
            "cost": cost,
            "episode_steps": self.steps,
            "measurement_age": age,
            "packet_arrived": self.arrived,
            "assumption_violated": alarm,
            "episode_violations": self.violations,
            "is_success": (self.violations == 0.0) * 1.0,
            "contract_broken": age > loop.oldest,
            "packets": self.packets,
            **self._others,
        }
        if (parameters := self.process.process.parameters) is not None:
            info["parameters"] = parameters
        if loop.limits_the_way:
            info["worst_constraint_values"] = worst.copy().T
        if loop.downlink is not None:
            info["input_committed"], info["downlink_broken"] = committed.copy().T, missing
        if self.requests is not None:
            info["requested"], info["request_forced"] = self.requests.requested, self.requests.forced
        if self._size is not None:
            for key in (*_SHARED, *self._others):
                if key in info:
                    info[key] = info[key].copy()
        return belief, info

    @property
    def pending(self) -> tuple[np.ndarray, ...]:
        """The inputs until the next decision takes effect, shape (m,) or (m, N) each."""
        return self.downlink.committed.pending

    def beginning(self, *chosen: np.ndarray) -> tuple[Any, list[tuple[np.ndarray, Any]], Sequence[Channel]]:
        """Returns what a guard is told where episodes begin, of N loops those with these indices.

        That is what the start is known to lie in, an ellipsoid or the state itself, of N loops a list of these;
        estimate and number of the error set of every step before the first decision takes effect; the channels.
        """
        starts, initial = self.start, self.loop.initial_set
        if chosen:
            drawn = np.isnan(starts[chosen[0], 0]).tolist()
            starts = [initial if each else start for start, each in zip(starts[chosen[0]], drawn, strict=True)]
        earlier = [self.estimator.numbered(self.pending[:steps], *chosen) for steps in range(len(self.pending))]
        return starts, earlier, self.channels.now

    # Of one loop or of many: those of the classes below.
    state: np.ndarray
    worst: np.ndarray
    memory: Any
    steps: Any
    episodes: Any
    moves: Any
    packets: Any
    violations: Any
    start: Any
    estimator: Any
    downlink: Any
    network: Any

    @abstractmethod
    def _receive(self, rng: np.random.Generator, u: np.ndarray, requested: Any) -> Any:
        """Samples, sends and estimates, given the inputs applied; returns whether a packet arrived."""


class OneLoop(LoopState):
    """Where one loop is; `received` are the packets that arrived at the last step."""

    def __init__(self, loop: Loop) -> None:
        super().__init__(loop)
        self.estimator = Estimator(loop.plant, loop.channel, histories=loop.histories(loop.channel))
        self.downlink = DownlinkState(loop.protocol, loop.plant.m)
        self.steps = self.episodes = self.moves = 0
        self.start = loop.initial_set
        self.received: list[Any] = []

    def begin(
        self,
        rng: np.random.Generator,
        start: np.ndarray | None,
        fixed: np.ndarray | None,
        chosen: list[dict[int, Any]],
    ) -> None:
        """Begins an episode at a state, (n,), or a drawn one; for the others see `read` and `choose`."""
        loop, self.moves = self.loop, self.moves + 1
        self.inputs, self.arrived = self._no_inputs, self._no_inputs.missing
        initial = loop.initial_set if start is None else None
        first = (1.0 - SAMPLE_ROUNDING) * loop.initial_set.sample(rng) if start is None else start
        self.state, self.start = self.process.start(rng, first, initial, fixed)
        self.memory = self.process.begin(rng)
        self.channels.begin(chosen[0])
        self.downlinks.begin(chosen[1])
        self._others = self._channel_infos()
        channel = self.channels.now[0]
        self.network, self.packets = ChannelState(channel, rng), 0
        if self.requests is not None:
            self.requests.begin(channels=[channel])
        if (channel.delay, channel.jitter) != (self.estimator.channel.delay, self.estimator.channel.jitter):
            known = covering([channel], loop.channel)
            self.estimator = Estimator(loop.plant, known, histories=loop.histories(known), after=self.estimator)
        self.estimator.reset(self.state + self.process.first_error(rng))
        self.downlink.begin(rng, self.estimator.episode, self.downlinks.now[0])
        self.steps, self.violations, self.received = 0, 0.0, []
        self.episodes += 1
        self.worst = loop.plant.values_at_start(self.state)

    def _receive(self, rng: np.random.Generator, u: np.ndarray, requested: Any) -> bool:
        if requested is not None:
            self.network.requested = bool(requested)
        sends = self.network.sends_at(self.steps)
        sample = self.process.measure(rng, self.state) if sends else None
        self.received = self.network.exchange(rng, self.steps, sample, self.estimator.episode)
        self.packets += sends
        self.estimator.advance(u, self.received)
        return bool(self.received)


class ManyLoops(LoopState):
    """Where N loops are, each in an episode of its own."""

    def __init__(self, loop: Loop, size: int) -> None:
        super().__init__(loop, size)
        plant, self.size = loop.plant, size
        self.estimator = VectorEstimator(plant, loop.histories(loop.channel), size)
        self.downlink = VectorDownlinkState(loop.protocol, plant.m, size)
        self.packets, self.violations = np.zeros(size, np.int64), np.zeros(size)
        self.steps, self.episodes, self.moves = np.zeros((3, size), np.int64)
        self.state, self.start = np.zeros((plant.n, size)), np.full((size, plant.n), np.nan)
        self.worst = plant.values_at_start(self.state)

    def begin(
        self,
        rng: np.random.Generator,
        mask: np.ndarray,
        starts: np.ndarray | None,
        fixed: np.ndarray | None,
        chosen: list[dict[int, Any]] | None = None,
    ) -> None:
        """Begins episodes where a mask, (N,), says so, at states, (N, n), or drawn ones, else as one loop does."""
        loop, rows, self.moves = self.loop, np.flatnonzero(mask), self.moves + mask
        self.inputs, self.arrived = self._no_inputs, self._no_inputs.missing
        count = len(rows)
        first_states = ((1.0 - SAMPLE_ROUNDING) * loop.initial_set.sample(rng, count)).T
        first_errors = self.process.first_error(rng, count)
        initial, states = (loop.initial_set, first_states) if starts is None else (None, starts[mask].T)
        states, known = self.process.start_many(rng, states, initial, mask, fixed)
        memory = self.process.begin(rng, count)
        up, down = self.choose([None, None], rng, rows.tolist()) if chosen is None else chosen
        channels, commands = self.channels.begin(up), self.downlinks.begin(down)
        if count == self.size or channels or commands:
            self._others = self._channel_infos()
        if count == self.size:
            self.memory = np.array(memory)
            self.network = VectorChannelState(channels or loop.channel, rng, count)
        else:
            self.memory = with_columns(self.memory, mask, memory)
            self.network.begin(rng, rows, channels)
        self._prepare_estimator(channels or [loop.channel], all_begin=count == self.size)
        self.state = with_columns(self.state, mask, states)
        self.estimator.begin(mask, states + first_errors)
        self.downlink.begin(rng, mask, commands)
        if self.requests is not None:
            self.requests.begin(mask, channels)
        self.packets, self.steps = np.where(mask, 0, self.packets), np.where(mask, 0, self.steps)
        self.violations, self.episodes = np.where(mask, 0.0, self.violations), self.episodes + mask
        self.worst = np.where(mask, loop.plant.values_at_start(self.state), self.worst)
        self.start[mask] = known

    def _prepare_estimator(self, used: Sequence[Channel], *, all_begin: bool) -> None:
        """Makes the estimator one for the delays of these channels; it forgets nothing unless all begin."""
        known = self.estimator.histories.channel
        used = [*used, *([] if all_begin else [known])]
        if (wanted := covering(used, self.loop.channel)) != known:
            histories = self.loop.histories(wanted)
            if all_begin:
                self.estimator = VectorEstimator(self.loop.plant, histories, self.size)
            else:
                self.estimator.follow(histories)

    def _receive(self, rng: np.random.Generator, u: np.ndarray, requested: Any) -> np.ndarray:
        estimator = self.estimator
        sends, samples = self.network.send(rng, self.steps, requested), None
        self.packets = self.packets + sends
        if np.count_nonzero(sends):
            samples = self.network.channel.quantize(self.process.measure(rng, self.state))
            if not np.isfinite(samples.sum()):  # no sensor within the assumptions sends this
                damaged = np.asarray(~np.isfinite(samples).all(axis=0))
                self.network.discard(damaged)
                estimator.damaged |= sends & damaged
                estimator.alarm |= estimator.damaged
                samples[:, damaged] = 0.0  # times a gain of zero it is to be nothing
        arrivals = self.network.arrivals()
        estimator.advance(u, samples, arrivals)
        arrived = np.zeros(self.size, np.bool_)
        for _, arrives in arrivals:
            arrived |= arrives
        return arrived


def with_columns(values: np.ndarray, mask: np.ndarray, new: Any) -> np.ndarray:
    """Returns an array (..., N) with others where `mask` (N,) says so, of a type that holds both."""
    found = values.astype(np.result_type(values, new))
    found[..., mask] = new
    return found


def _actions_of(
    inputs: Inputs, plant: LinearPlant, read: tuple[np.ndarray, np.ndarray] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the float32 actions that stand for the inputs applied and committed, shape (m,) or (N, m) each.

    If what `read_action` returned was decided, the action is the one that was given.
    """
    if read is not None and inputs.committed is inputs.applied is read[1] and read[0].dtype.char == "f":
        return read[0], read[0].copy()
    applied = nearest_action(inputs.applied.T, plant)
    if inputs.committed is inputs.applied:  # as without a downlink
        return applied, applied.copy()
    return applied, nearest_action(inputs.committed.T, plant)
