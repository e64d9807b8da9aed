"""Sensor, actuator and controller of a control loop, each a node of its own that talks in datagrams.

A node acts at its steps only: it takes what arrived since the last one, moves, and sends. What comes too late for a
step is used at a later one or not at all, exactly as if the network had delayed or lost it (docs/network_loop.md).
"""

from __future__ import annotations

import asyncio
import secrets
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from queue import SimpleQueue
from typing import Any

import numpy as np

from ncs_gym import Actuator, Command, Echo, Packet
from ncs_gym.network.contract import largest_age
from ncs_gym.network.wire import Kind, Message, Wire, WireError
from ncs_gym.validation import counted
from shields.nodes.step_clock import SETTLED, StepClock
from shields.nodes.transport import Datagram, Transport
from shields.runtime.decisions import Decision
from shields.runtime.safe_loop import SafeLoop

# Steps beyond its longest delay for which a message shows that its sender is there.
PATIENCE = 10
# Steps by which samples and echoes may be early; beyond it their stamps are not plausible.
EARLIEST = 16
# Steps that a controller makes up for at once after it was held up; more of them end the episode.
MOST_SKIPPED = 1000
NO_EPISODE = 0
# Steps that an answer of a sensor or an actuator may take, beside the c + 1 of the message that it answers.
LONGEST_ANSWER = 20
# Steps for which all nodes hear of an episode before it starts, and 2 c more: `_prelude`.
PRELUDE = PATIENCE + 2 + SETTLED + LONGEST_ANSWER
# Senders of greetings that are answered at a step, the newest, and addresses to which messages go, the quickest.
MOST_SENDERS = 32
# The newest step of a peer of which nothing was heard.
NEVER = -(2**62)
# What begins within this part of a step begins now.
EARLY = 0.1


class _PlantNode:
    """What sensor and actuator have in common: they join the episodes of a controller, and follow its clock.

    A node that belongs to no episode says so at every step, with a challenge that it draws when it is made and whenever
    it joins or leaves. It joins the episode of the message that answers this challenge, so that what was recorded in
    earlier episodes moves nothing. It leaves an episode when it has heard nothing that was sent in the last
    c + `PATIENCE` steps of its clock, whatever is repeated, or when the clock of the controller jumps.

    Attributes:
        episode: Number of the episode, drawn by the controller; 0 for none.
        refused: How many datagrams were refused, by reason.
    """

    _hears: tuple[Kind, ...]

    def __init__(self, wire: Wire, transport: Transport, clock: StepClock) -> None:
        self.wire, self.transport, self.clock = wire, transport, clock
        self.episode, self._challenge, self._newest = NO_EPISODE, _drawn(), NEVER
        self._prelude, self._patience = _prelude(wire.input_delay), PATIENCE + wire.input_delay
        self.refused: Counter[str] = Counter()

    def listen(self, now: float) -> None:
        """Takes in what arrived since the last step."""
        for time, data, _ in self.transport.received():
            message = _decoded(self.wire, data, self._hears, self.refused)
            if message is None:
                continue
            if message.episode != self.episode:
                if self.episode != NO_EPISODE or message.challenge != self._challenge:
                    self.refused["episode"] += 1
                    continue
                self._join(message, time)
            step = message.stamp - self._prelude
            self._newest = max(self._newest, step)
            if self.clock.follow(step, time):
                self._use(message)
            else:
                self._leave()
        is_silent = self.clock.step_at(now) - self._newest > self._patience
        if self.episode != NO_EPISODE and (is_silent or self.clock.episode != self.episode):
            self._leave()

    def _join(self, message: Message, time: float) -> None:
        self.episode, self._challenge, self._newest = message.episode, _drawn(), NEVER
        self.clock.join(message.episode, time, message.stamp - self._prelude)

    def _leave(self) -> None:
        """Belongs to no episode any more; what was recorded answers an earlier challenge."""
        self.episode, self._challenge = NO_EPISODE, _drawn()
        self.clock.give_up()

    def _use(self, message: Message) -> None:
        """Uses a message of the episode."""

    def _send(self, kind: Kind, step: int, **fields: Any) -> None:
        stamp = step + self._prelude if self.episode != NO_EPISODE else 0
        common = {"kind": kind, "episode": self.episode, "stamp": stamp, "challenge": self._challenge}
        self.transport.send(self.wire.encode(Message(**common, **fields)))


class SensorNode(_PlantNode):
    """Samples the plant at every step and sends what it measures; where samples are on request, those requested.

    Args:
        wire: Encodes and decodes.
        transport: Leads to the controller.
        clock: Its clock; an actuator on the same board may have the same one.
    """

    _hears = (Kind.BEACON,)
    _requests: dict[int, bool]

    def is_requested(self, step: int) -> bool:
        """Returns whether the sample of a step is to be sent: if the controller has not said that it is not."""
        return self.episode == NO_EPISODE or self._requests.get(step, True)

    def send(self, step: int, measurement: np.ndarray) -> None:
        """Sends the sample of a step, shape (p,), taken before the input of that step acts, if it is requested.

        Steps before the start of the episode are below 0; samples of theirs say that the sensor is there.
        """
        if self.is_requested(step):
            self._send(Kind.SAMPLE, step, values=measurement)
        if self.episode != NO_EPISODE:
            self._requests = {ahead: each for ahead, each in self._requests.items() if ahead > step}

    def _join(self, message: Message, time: float) -> None:
        super()._join(message, time)
        self._requests = {}

    def _use(self, message: Message) -> None:
        for ahead, requested in enumerate(message.requests, message.stamp - self._prelude + 1):
            self._requests.setdefault(ahead, requested)


class ActuatorNode(_PlantNode):
    """Applies what is committed for each step, zero if nothing is, and sends an echo of what it applied.

    Args:
        wire: Encodes and decodes.
        transport: Leads to the controller.
        clock: Its clock.
        actuator: Holds what is committed; give it the limits of the inputs.
    """

    _hears = (Kind.COMMAND, Kind.BEACON)

    def __init__(self, wire: Wire, transport: Transport, clock: StepClock, actuator: Actuator) -> None:
        super().__init__(wire, transport, clock)
        self.actuator = actuator

    def apply(self, step: int) -> np.ndarray:
        """Returns the input to apply from the beginning of a step until the next one, shape (m,): zero below step 0.

        Steps that were left out since the last call were not applied: the echo says so.
        """
        idle = self.episode == NO_EPISODE or step < 0
        u = np.zeros(self.actuator.inputs) if idle else self.actuator.apply(step)
        steps, missing, digest, _ = self.actuator.echo
        self._send(Kind.ECHO, min(step, 0) or steps, missing=missing, digest=digest)
        return u

    def _join(self, message: Message, time: float) -> None:
        super()._join(message, time)
        self.actuator.start()

    def _use(self, message: Message) -> None:
        if message.kind is Kind.COMMAND and message.values is not None:
            self.actuator.receive([Command(message.stamp - self._prelude, message.values)])


class _Peer:
    """What a controller knows of a sensor or an actuator: what carries the number of the episode, and who greets.

    Who sends is authenticated, from where is not: somebody may have copied the message. So all addresses are answered
    from which a greeting came, until somebody answers with the number of the episode, and then all from which messages
    of the episode came, as long as newer ones do. No address takes the place of another one.
    """

    def __init__(self, patience: int) -> None:
        self.newest, self._patience = NEVER, patience
        # Newest step and challenge by address, the newest first and of one step the quickest first.
        self._heard: dict[Any, tuple[int, int]] = {}
        # Challenges and addresses, the newest last.
        self._greetings: dict[tuple[int, Any], None] = {}

    def is_silent(self, step: int) -> bool:
        """Returns whether nothing was heard that was sent in the last steps."""
        return step - self.newest > self._patience

    def greet(self, challenge: int, address: Any) -> None:
        """Takes in a greeting."""
        self._greetings.pop((challenge, address), None)
        self._greetings[challenge, address] = None
        if len(self._greetings) > MOST_SENDERS:
            del self._greetings[next(iter(self._greetings))]

    def hear(self, step: int, challenge: int, address: Any) -> None:
        """Takes in a message of the episode."""
        if step > self.newest:
            self.newest, self._greetings = step, {}
        if step > self._heard.get(address, (NEVER, 0))[0]:
            self._heard.pop(address, None)
            self._heard[address] = step, challenge
            newest_first = sorted(self._heard.items(), key=lambda each: -each[1][0])[:MOST_SENDERS]
            self._heard = {sender: sent for sender, sent in newest_first if sent[0] >= self.newest - self._patience}

    @property
    def addressees(self) -> list[tuple[int, Any]]:
        """Challenges and addresses to which messages go."""
        return [(challenge, address) for address, (_, challenge) in self._heard.items()] + [*self._greetings]


class ControllerNode:
    """Runs a `SafeLoop` behind a downlink at every step, and numbers the steps of all.

    It waits until sensor and actuator greet, draws the number of an episode, tells it to both for `PRELUDE` + 2 c
    steps, and then starts the loop at step 0, if messages of both carry the number, the newest at most `PATIENCE` steps
    beyond its delay old. Otherwise it waits again: greetings are recordings, or somebody has left. That is decided
    while there is time for the others to leave before step 0. A sensor or an actuator that is restarted joins the
    episode again: samples that are missing meanwhile are lost, inputs that are missing end the guarantee, because
    echoes tell. A controller that is restarted begins another episode. Where samples are on request, beacons say which.

    Args:
        loop: With a downlink, and with `echo_age`.
        wire: Encodes and decodes.
        transport: Where sensor and actuator are heard.
        clock: Its clock, which the others follow.
        x_hat0: First estimate, shape (n,).
        known: Whether its error is known to lie in `plant.initial_error` at step 0; after a restart it is not
            (`SafeLoop.start`).

    Attributes:
        episode: Number drawn for this episode; 0 while it waits.
        skipped: How many steps of this episode were decided too late, by the certified fallback.
        arrived: Stamps of the samples that were taken in at this step.
        missing: How many inputs of this episode the actuator says were missing.
        refused: How many datagrams were refused, by reason.
        decision: The last one.

    Raises:
        ValueError: If the loop has no downlink or no echoes, or samples may be too late for the prelude.
    """

    def __init__(
        self, loop: SafeLoop, wire: Wire, transport: Transport, clock: StepClock, x_hat0: Any, *, known: bool
    ) -> None:
        if loop.input_delay == 0 or loop.echo_age is None:
            raise ValueError("commands that go over a network need SafeLoop(..., downlink=Channel(...), echo_age=...)")
        if loop.channel.longest_delay > LONGEST_ANSWER:
            raise ValueError(
                f"samples may be {counted(loop.channel.longest_delay, 'step')} late, and nodes hear of each other "
                f"within {LONGEST_ANSWER}: sample less often"
            )
        self.loop, self.wire, self.transport, self.clock = loop, wire, transport, clock
        self.refused: Counter[str] = Counter()
        self.decision: Decision
        # A sensor that is not asked may be silent for as long as the contract lets it.
        contract = loop.contract if loop.channel.on_request else None
        self._patience = PATIENCE + loop.channel.longest_delay + largest_age(contract, 0)
        self._prelude = _prelude(wire.input_delay)
        # Who was told nothing from this step on leaves before step 0.
        self._joined_by = -(wire.input_delay + PATIENCE + 2)
        self.begin(x_hat0, known=known)

    def begin(self, x_hat0: Any, *, known: bool) -> None:
        """Ends the episode; the next one begins when the others have noticed, after c + `PATIENCE` steps of silence."""
        self.episode, self._first = NO_EPISODE, (x_hat0, known)
        self._peers = {Kind.SAMPLE: _Peer(self._patience), Kind.ECHO: _Peer(self._patience)}
        self._waiting: list[Packet | Echo] = []
        self.arrived: list[int] = []
        self.skipped, self.missing, self._is_started = 0, 0, False
        self.step = -self._prelude

    def receive(self, now: float) -> np.ndarray | None:
        """Returns the estimate at the step that begins now, shape (n,), or None while it waits for the others.

        Steps that were left out are made up for by the certified fallback: it is too late for anything else.
        """
        for datagram in self.transport.received():
            message = _decoded(self.wire, datagram.data, tuple(self._peers), self.refused)
            if message is not None:
                self._hear(message, datagram)
        if self.episode == NO_EPISODE:
            if not all(peer.addressees for peer in self._peers.values()):
                return None
            self.episode = _drawn()
            self.clock.start(now, -self._prelude)
        step = self.clock.step_at(now + EARLY * self.clock.dt)
        x_hat0, known = self._first
        is_beginning = not self._is_started and step >= self._joined_by
        if is_beginning and any(peer.is_silent(step) for peer in self._peers.values()):
            self.begin(x_hat0, known=known and self.step <= self._joined_by)
            return None
        if step < 0:
            for heard in self._peers:  # the first c samples are requested by agreement
                self._answer(heard, Kind.BEACON, step, requests=(True,) * (self.loop.input_delay + 1))
            self.step = step + 1
            return None
        if not self._is_started:
            self.loop.start(x_hat0, known=known)
            self.step, self._is_started = 0, True
        late = step - self.step
        if late > MOST_SKIPPED:
            self.begin(self.loop.estimate, known=False)
            return None
        for _ in range(late):
            self.loop.step(None)
            self.step += 1
            self.skipped += 1
        due = [each for each in self._waiting if _stamp(each) <= self.step]
        self._waiting = [each for each in self._waiting if _stamp(each) > self.step]
        oldest = self.step - self.loop.channel.longest_delay
        packets = [each for each in due if isinstance(each, Packet) and each.stamp >= oldest]
        self.refused["late"] += sum(isinstance(each, Packet) and each.stamp < oldest for each in due)
        echoes = [each for each in due if isinstance(each, Echo)]
        self.arrived = [packet.stamp for packet in packets]
        self.missing = max([self.missing, *(echo.missing for echo in echoes)])
        return self.loop.receive(packets, echoes=echoes)

    def decide(self, proposed: Any, *, ask: bool = False) -> Decision:
        """Decides at this step, whatever is proposed, and sends command and beacon; see `SafeLoop.decide`."""
        self.decision = self.loop.decide(proposed, ask=ask)
        command = self.loop.command()
        self._answer(Kind.ECHO, Kind.COMMAND, self.step, values=command.inputs)
        requests = command.requests or (True,) * len(command.inputs)
        self._answer(Kind.SAMPLE, Kind.BEACON, self.step, requests=requests)
        self.step += 1
        return self.decision

    def _answer(self, heard: Kind, kind: Kind, step: int, **fields: Any) -> None:
        common = {"kind": kind, "episode": self.episode, "stamp": step + self._prelude}
        for challenge, address in self._peers[heard].addressees:
            self.transport.send(self.wire.encode(Message(**common, challenge=challenge, **fields)), address)

    def _hear(self, message: Message, datagram: Datagram) -> None:
        """Takes in a message, and where its sender is."""
        peer = self._peers[message.kind]
        if message.episode == NO_EPISODE:  # a node that waits or was restarted, or a recording
            if peer.is_silent(self.step):
                peer.greet(message.challenge, datagram.sender)
            return
        if message.episode != self.episode:
            self.refused["episode"] += 1
            return
        step = message.stamp - self._prelude
        if step > self.step + EARLIEST:
            self.refused["ahead"] += 1
            return
        peer.hear(step, message.challenge, datagram.sender)
        if step < 0:
            return
        if message.kind is Kind.SAMPLE:
            assert message.values is not None
            self._waiting.append(Packet(step, message.values, self.loop.episode))
        else:
            self._waiting.append(Echo(step, message.missing, message.digest, self.loop.episode))


async def run_plant_side(
    nodes: Sequence[_PlantNode], act: Callable[[int], Any], is_over: Callable[[], bool] = lambda: False
) -> None:
    """Runs a sensor, an actuator, or both on one board, in real time.

    Args:
        nodes: Nodes with a common clock.
        act: Called at the beginning of every step with its number: reads the sensor, applies the input. Numbers begin
            anew with each episode, below 0 before it starts, and are below 0 until the first episode has started: only
            then may a simulated plant move. Steps that were missed are left out.
        is_over: Asked after each step.
    """
    loop, clock = asyncio.get_running_loop(), nodes[0].clock
    clock.start(loop.time())
    episode, last, has_started = NO_EPISODE, 0, False  # without an episode it only counts
    while not is_over():
        await asyncio.sleep(max(clock.time_of(last + 1) - loop.time(), 0.0))
        now = loop.time()
        for node in nodes:
            node.listen(now)
        step = clock.step_at(now + EARLY * clock.dt)
        if clock.episode != episode:  # in the middle of a step of another count
            episode, last = clock.episode, step
        elif step > last:
            last = step
            has_started |= step >= 0 and any(node.episode != NO_EPISODE for node in nodes)
            if clock.is_settled:
                act(step if has_started or step < 0 else step + NEVER)


async def run_controller(
    node: ControllerNode,
    controller: Callable[[np.ndarray], Any],
    on_step: Callable[[ControllerNode, Any], None] = lambda node, proposed: None,
    is_over: Callable[[], bool] = lambda: False,
    budget: float | None = None,
    asks: Callable[[SafeLoop], bool] = lambda loop: False,
) -> None:
    """Runs a controller in real time.

    The controller is called in a thread of its own. What it has not proposed within its budget is not waited for: the
    certified fallback is applied, in time, and the next call comes when it has returned.

    Args:
        node: The node.
        controller: Proposes an input given an estimate, shape (n,).
        on_step: Called after each decision with the node and what was proposed, to write a log.
        is_over: Asked after each step.
        budget: How long the controller may take [s]; half a step by default.
        asks: Says of the loop, after `receive`, whether to ask for a sample, where samples are on request; otherwise
            those are requested that the contract needs.
    """
    loop, clock = asyncio.get_running_loop(), node.clock
    budget = 0.5 * clock.dt if budget is None else budget
    clock.start(loop.time())
    running: asyncio.Future[Any] | None = None
    asked: SimpleQueue[tuple[np.ndarray, Future[Any]] | None] = SimpleQueue()
    # A daemon: no end of this process waits for a controller that does not return.
    threading.Thread(target=_propose, args=(controller, asked), name="controller", daemon=True).start()
    try:
        while not is_over():
            step = node.step if node.episode != NO_EPISODE else clock.step_at(loop.time()) + 1
            await asyncio.sleep(max(clock.time_of(step) - loop.time(), 0.0))
            estimate = node.receive(loop.time())
            if estimate is None:
                continue
            proposed = None
            if running is None or running.done():
                answer: Future[Any] = Future()
                asked.put((estimate, answer))
                running = asyncio.wrap_future(answer)
                await asyncio.wait([running], timeout=budget)
                proposed = running.result() if running.done() and running.exception() is None else None
            node.decide(proposed, ask=asks(node.loop))
            on_step(node, proposed)
    finally:
        asked.put(None)


def _propose(
    controller: Callable[[np.ndarray], Any], asked: SimpleQueue[tuple[np.ndarray, Future[Any]] | None]
) -> None:
    """Calls a controller with one estimate after the other, until there is None in its place."""
    while (given := asked.get()) is not None:
        estimate, answer = given
        if not answer.set_running_or_notify_cancel():
            continue
        try:
            proposed = controller(estimate)
        except BaseException as error:
            answer.set_exception(error)
        else:
            answer.set_result(proposed)


def _decoded(wire: Wire, data: bytes, kinds: Sequence[Kind], refused: Counter[str]) -> Message | None:
    """Returns a message of one of the kinds; None, counted by reason, for anything else."""
    try:
        message = wire.decode(data)
    except WireError as error:
        refused[error.reason] += 1
        return None
    if message.kind in kinds:
        return message
    refused["kind"] += 1
    return None


def _stamp(early: Packet | Echo) -> int:
    return early.stamp if isinstance(early, Packet) else early.steps


def _prelude(input_delay: int) -> int:
    """Returns for how many steps all hear of an episode before it starts; stamps are counted from their beginning."""
    return PRELUDE + 2 * input_delay


def _drawn() -> int:
    """Returns a random number other than 0."""
    return secrets.randbelow(2**63 - 1) + 1
