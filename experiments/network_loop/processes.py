"""The processes of `ncs loop`: a simulated plant with sensor and actuator, a bad network, and a controller."""

from __future__ import annotations

import asyncio
import gc
import hmac
import signal
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.network_loop.impairment import Impairment, open_line
from experiments.network_loop.log import StepLog
from experiments.runs.loops import changed_channel, registered_env
from experiments.runs.policies import policy_by_name
from experiments.settings import LoopSettings
from experiments.terminal import say
from ncs_gym import Actuator, AdversarialDisturbance, Channel, NCSEnv
from ncs_gym.network import DownlinkProtocol, downlink_protocol
from ncs_gym.network.contract import ChannelContract, contract_of
from ncs_gym.network.wire import Wire
from ncs_gym.processes.plant_step import PlantSimulation
from shields import Certificate, SafeLoop
from shields.nodes import (
    ActuatorNode,
    ControllerNode,
    SensorNode,
    StepClock,
    UdpTransport,
    run_controller,
    run_plant_side,
)

# Steps by which an echo may be older than the oldest sample; what is allowed where nothing is promised.
ECHO_MARGIN, ECHO_AGE = 5, 50
# Steps in a row that are not proved after which the controller begins another episode.
RENEWED = 250
# Seconds after which a controller that waits says so.
SILENCE = 5.0
# Steps between two changes of direction of the controller "push".
PUSH = 100
HERE = "127.0.0.1"
# Policies that other commands have not.
OWN_POLICIES = ("push",)
# Why datagrams are refused: the words that nodes count them by, and what they say of a datagram.
REFUSED = {
    "length": "of the wrong length",
    "format": "of another format",
    "tag": "with a wrong tag",
    "plant": "of another plant",
    "value": "with an impossible value",
    "kind": "for another node",
    "episode": "of another episode",
    "ahead": "stamped ahead",
    "late": "too late",
}


@dataclass(frozen=True, kw_only=True)
class NetworkLoop:
    """A control loop over a network, in a form that every process of it understands.

    Attributes:
        settings: Those of the command.
        uplink: What the network does to samples and echoes.
        downlink: What it does to commands.
        secret: What both machines share.
        max_age: Largest age of a sample in use when an input takes effect, where samples are on request.
    """

    settings: LoopSettings
    uplink: Channel
    downlink: Channel
    secret: bytes
    max_age: int

    @property
    def certificate(self) -> Path:
        """File of the certificate."""
        return self.settings.out / "certificate.json"

    @property
    def controller(self) -> tuple[str, int]:
        """Address at which the controller hears."""
        return self.settings.host, self.settings.port

    @property
    def sensor(self) -> tuple[str, int]:
        """Address at which the network hears the sensor."""
        return HERE, self.settings.port + 1

    @property
    def actuator(self) -> tuple[str, int]:
        """Address at which the network hears the actuator."""
        return HERE, self.settings.port + 2

    @property
    def promised(self) -> tuple[Channel, Channel]:
        """Uplink and downlink, both later by what the processes may be late: what is promised counts that."""
        late = self.settings.room
        up, down = (replace(each, jitter=each.jitter + late) for each in (self.uplink, self.downlink))
        return up, down

    @property
    def protocol(self) -> DownlinkProtocol:
        """How commands are sent, and how many steps after the decision they take effect."""
        return downlink_protocol(self.promised[1], None)

    @property
    def contract(self) -> ChannelContract | None:
        """What is promised of samples and commands together; None if nothing is.

        Samples on request may be left out as long as none in use is older than `max_age`.
        """
        needed = self.protocol.behind(contract_of(self.promised[0]))
        if needed is None or not self.uplink.on_request:
            return needed
        return replace(needed, max_age=max(needed.max_age, self.max_age))

    @property
    def key(self) -> bytes:
        """Key of the messages: machines that were told other things refuse each other's."""
        told = self.settings.env, self.settings.speed, self.settings.room, self.uplink, self.downlink
        return hmac.digest(self.secret, repr(told).encode(), "sha256")

    def dt(self, env: NCSEnv) -> float:
        """Returns the duration of a step in real time [s]."""
        return env.plant.dt / self.settings.speed


def network_channels(
    env: NCSEnv, up_changes: Mapping[str, Any], down_changes: Mapping[str, Any]
) -> tuple[Channel, Channel]:
    """Returns uplink and downlink of an environment as a real network has them: what is sent now arrives a step later.

    Without a downlink of its own it has one like its uplink; for changes see `changed_channel`.

    Raises:
        ValueError: If a change is wrong, or is none that a real network can have.
    """
    up = env.channel
    down = env.downlink or Channel(loss=up.loss, jitter=up.jitter, max_consecutive_losses=up.max_consecutive_losses)
    if down.most_consecutive_losses is None:  # nothing can be committed ahead without a promise
        down = Channel(loss=down.loss, delay=down.delay, jitter=down.jitter, max_consecutive_losses=2)

    def late(channel: Channel) -> Channel:
        settings = {name: getattr(channel, name) for name in ("loss", "quantization_step", "jitter", "on_request")}
        return Channel(**settings, delay=max(channel.delay, 1), max_consecutive_losses=channel.max_consecutive_losses)

    def changed(own: Channel, changes: Mapping[str, Any], flag: str) -> Channel:
        channel = changed_channel(own, changes, flag) or own
        if channel.delay < 1 or channel.send_period != 1:
            raise ValueError(
                f"{flag}: what is sent at each step arrives at the next at best: delay >= 1, send_period 1"
            )
        return channel

    return changed(late(up), up_changes, "--channel"), changed(late(down), down_changes, "--downlink")


def run_plant(loop: NetworkLoop) -> None:
    """Simulates the plant in real time, until the process is ended."""
    asyncio.run(_plant(loop, _told_to_stop()))


def run_network(loop: NetworkLoop) -> None:
    """Does to the datagrams what networks do, until the process is ended."""
    asyncio.run(_network(loop, _told_to_stop()))


def run_controller_node(
    loop: NetworkLoop, show: Callable[[dict[str, Any]], None] | None, is_alone: Callable[[], bool]
) -> bool:
    """Runs the controller in real time, until it has made its steps, the process is ended or is left alone.

    Returns whether the process was told to end; `show` is called with each row of the log.
    """
    told = _told_to_stop()
    asyncio.run(_controller(loop, show, lambda: told() or is_alone()))
    return told()


def _told_to_stop() -> Callable[[], bool]:
    """Returns whether SIGTERM or SIGINT has come; a process has no pauses for garbage from now on."""
    told: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda number, frame: told.append(number))
    gc.collect()
    gc.freeze()
    return lambda: bool(told)


async def _plant(loop: NetworkLoop, is_over: Callable[[], bool]) -> None:
    env = registered_env(loop.settings.env)
    plant, rng = env.plant, np.random.default_rng([loop.settings.seed, 1])
    certificate = Certificate.load(loop.certificate)
    linear = plant.remainder is None
    disturbance = AdversarialDisturbance(certificate.M) if linear else env.disturbance
    simulation = PlantSimulation(plant, disturbance, False, process=env.process)
    wire, clock = Wire(plant, loop.protocol.input_delay, loop.key), StepClock(loop.dt(env))
    sensor = SensorNode(wire, await UdpTransport.open(peer=loop.sensor), clock)
    actuator = Actuator(loop.protocol.input_delay, plant.m, plant.largest_input)
    node = ActuatorNode(wire, await UdpTransport.open(peer=loop.actuator), clock, actuator)
    names = [*(f"x_{name}" for name in plant.state_names), *(f"u_{name}" for name in plant.input_names)]
    log = StepLog(
        loop.settings.out, "plant", ["time", "episode", "step", *names, "missing", "outside", "sent", "drift"]
    )
    start, episode, last, released = np.zeros(plant.n), 0, 0, False
    state, memory = start, simulation.begin(rng)

    def act(step: int) -> None:
        nonlocal state, episode, last, memory, released
        if clock.episode != episode:
            episode, last = clock.episode, step - 1
        released |= step >= 0
        controlled, outside = sensor.episode != 0 and step >= 0, bool((plant.constraint_values(state) > 0.0).any())
        if not released or (outside and not controlled):
            # It is held at the start before the first episode, and again where it left the box without a controller.
            state, memory, last = simulation.start(rng, start, None)[0], simulation.begin(rng), step - 1
        for each in range(last + 1, step + 1):  # what is simulated here was not late
            sent = sensor.is_requested(each)
            sensor.send(each, loop.uplink.quantize(simulation.measure(rng, state)))
            u = node.apply(each)
            if released:
                outside = bool((plant.constraint_values(state) > 0.0).any())
                row = [f"{time.time():.6f}", episode, each, *state.tolist(), *u.tolist(), actuator.echo.missing]
                log.write([*row, int(outside), int(sent), f"{clock.drift:.2e}"])
                state = simulation.advance(rng, state, u, each, memory)
        last = step

    await run_plant_side([sensor, node], act, is_over)
    log.close()


async def _network(loop: NetworkLoop, is_over: Callable[[], bool]) -> None:
    env = registered_env(loop.settings.env)

    def one_way(channel: Channel, number: int) -> Impairment:
        rng = np.random.default_rng([loop.settings.seed, 2, number])
        return Impairment(channel, loop.dt(env), rng, loop.settings.mischief, loop.settings.worst)

    ways = [one_way(channel, i) for i, channel in enumerate((loop.uplink, loop.downlink, loop.uplink, loop.downlink))]
    await open_line(loop.sensor, loop.controller, *ways[:2])
    await open_line(loop.actuator, loop.controller, *ways[2:])
    while not is_over():
        await asyncio.sleep(0.05)


async def _controller(
    loop: NetworkLoop, show: Callable[[dict[str, Any]], None] | None, is_over: Callable[[], bool]
) -> None:
    settings, env = loop.settings, registered_env(loop.settings.env)
    plant, wire = env.plant, Wire(env.plant, loop.protocol.input_delay, loop.key)
    uplink, downlink = loop.promised
    contract = contract_of(uplink)  # echoes are sent at every step, whatever samples are
    age = ECHO_AGE if contract is None else contract.max_age + ECHO_MARGIN
    safe_loop = SafeLoop(
        Certificate.load(loop.certificate),
        plant,
        uplink,
        settings.shield,
        settings.horizon,
        downlink=downlink,
        echo_age=age,
        on_unproved="ignore",
    )
    transport = await UdpTransport.open(local=(HERE if settings.role == "all" else "0.0.0.0", settings.port))
    start, known = np.zeros(plant.n), not settings.restarted
    node = ControllerNode(safe_loop, wire, transport, StepClock(loop.dt(env)), start, known=known)
    inputs = plant.input_names
    columns = ["time", "episode", "step", "guaranteed", "reason"]
    columns += [f"x_hat_{name}" for name in plant.state_names]
    columns += [*(f"proposed_{name}" for name in inputs), *(f"u_{name}" for name in inputs)]
    columns += ["intervened", "margin", "age", "arrived", "missing", "skipped", "refused", "refused_why"]
    columns += ["microseconds"]
    log = StepLog(settings.out, "controller", columns)
    packets = StepLog(settings.out, "packets", ["episode", "sent", "received"])
    propose = controller_named(settings.policy, settings.env, env, settings.seed, settings.vec_normalize)
    steps = unproved = 0

    def on_step(node: ControllerNode, proposed: Any) -> None:
        nonlocal steps, unproved
        safe, decision = node.loop, node.decision
        estimate = safe.estimate.tolist()
        values = [None] * plant.m if proposed is None else np.asarray(proposed, dtype=np.float64).tolist()
        row = [f"{time.time():.6f}", node.episode, safe.steps, int(safe.guaranteed), safe.reason]
        row += [*estimate, *values]
        row += [*decision.input.tolist(), int(decision.intervened), float(decision.margin), safe.measurement_age]
        took = node.clock.time_of(safe.steps), asyncio.get_running_loop().time()
        row += [" ".join(map(str, node.arrived)), node.missing, node.skipped, node.refused.total()]
        row += [" ".join(f"{reason}:{count}" for reason, count in node.refused.items())]
        log.write([*row, round(1e6 * (took[1] - took[0]))])
        for stamp in node.arrived:
            packets.write([node.episode, stamp, safe.steps])
        if show is not None:
            show(dict(zip(columns, row, strict=False)))
        steps, unproved = steps + 1, 0 if safe.guaranteed else unproved + 1
        if unproved == RENEWED:
            node.begin(safe.estimate, known=False)
            unproved = 0

    began, is_told = time.monotonic(), False

    def has_ended() -> bool:
        nonlocal is_told
        if node.episode == 0 and not is_told and time.monotonic() - began > SILENCE:
            is_told = True
            say(waiting_text(node.refused, settings))
        return is_over() or steps >= settings.steps

    def asks(safe: SafeLoop) -> bool:
        return settings.ask_age is not None and safe.measurement_age >= settings.ask_age

    await run_controller(node, propose, on_step, has_ended, asks=asks)
    log.close()
    packets.close()


def waiting_text(refused: Mapping[str, int], settings: LoopSettings) -> str:
    """Returns what a controller says that waits, given how many datagrams were refused by reason."""
    waits = "the controller waits for sensor and actuator; "
    if not sum(refused.values()):
        return f"{waits}nothing has arrived yet"
    return f"{waits}{refused_text(refused)}; {suspects_text(refused, settings)}"


def refused_text(refused: Mapping[str, int]) -> str:
    """Returns how many datagrams were refused, and why, given how many by reason."""
    why = [f"{count} {REFUSED[reason]}" for reason, count in refused.items() if count]
    return f"{sum(refused.values())} datagrams were refused: {', '.join(why)}"


def suspects_text(refused: Mapping[str, int], settings: LoopSettings) -> str:
    """Returns what is known of where refused datagrams come from.

    On one machine all processes have the same key and settings; on two only the plant's knows its --mischief.
    """
    share = f"{100.0 * settings.mischief:g} %"
    made = (
        f"beside {share} of the datagrams it sends a copy, beside {share} an old one and noise, and it corrupts "
        f"{share} of the lost ones"
    )
    if settings.role == "all":
        if settings.mischief == 0.0:
            return "--mischief 0 makes none of these"
        return f"--mischief {settings.mischief:g} makes such: {made}"
    plants = "--mischief of the plant's machine (0.05 unless it was told otherwise) makes such"
    if not refused.get("tag"):
        return plants
    other = "another key, or another --env, --speed, --room, --channel or --downlink"
    return f"{plants}, and if all have a wrong tag, that machine has {other}"


def controller_named(
    name: str, env_id: str, env: NCSEnv, seed: int, vec_normalize: Path | None = None
) -> Callable[[np.ndarray], np.ndarray]:
    """Returns a controller, estimate -> input: "push", or a policy of `policy_by_name` with the task's own entries."""
    plant = env.plant
    if name in OWN_POLICIES:
        count = 0

        def push(estimate: np.ndarray) -> np.ndarray:
            nonlocal count
            count += 1
            return plant.input_ends[1 - (count - 1) // PUSH % 2].copy()

        return push
    policy = policy_by_name(name, env_id, env, seed, vec_normalize)
    rng, task = np.random.default_rng([seed, 3]), env.task
    goal = task.begin(rng, plant)
    low, high = env.observation_space.low, env.observation_space.high  # pyright: ignore[reportAttributeAccessIssue]

    def propose(estimate: np.ndarray) -> np.ndarray:
        nonlocal goal
        observation = np.clip(np.concatenate([estimate, task.observe(goal)]), low, high).astype(np.float32)
        action = np.asarray(policy(observation, {"estimate": estimate}), dtype=np.float64)
        u = plant.input_half * action + plant.input_middle
        goal = task.advance(rng, plant, goal, u)
        return u

    return propose
