"""Sensor, actuator and controller in virtual time: clocks that disagree, networks that do everything, restarts."""

import heapq
import itertools
from dataclasses import replace

import numpy as np
import pytest

from ncs_gym import Actuator, Channel, ChannelContract, cart_pole, truck_trailer
from ncs_gym.network.packet_loss_and_delay import first_loss_state, transmit
from ncs_gym.network.wire import Kind, Message, Wire
from shields import ActuatorNode, ControllerNode, SafeLoop, SensorNode
from shields.nodes import Datagram, StepClock
from shields.nodes.nodes import PATIENCE, PRELUDE
from shields.runtime.guarantee import LATE_INPUT, NOT_CONFIRMED, OLD_SAMPLE, UNKNOWN_START
from tests.certificates import certificate_of

PLANT, KEY = cart_pole(), bytes(range(32))
# At most two losses in a row and one or two steps late, either way: ages up to 4 + 4 steps.
CHANNEL = Channel(loss=0.2, delay=1, jitter=1, max_consecutive_losses=2)
CONTRACT = ChannelContract(8)


class Air:
    """Carries datagrams between sockets in virtual time, and does to them what a network does."""

    def __init__(self, dt, seed, mischief=0.1):
        self.now, self.dt, self.rng, self.mischief = 0.0, dt, np.random.default_rng(seed), mischief
        self.order, self.queue, self.states, self.recorded = itertools.count(), [], {}, []
        self.is_cut, self.until_worst, self.channel = False, False, CHANNEL

    def carry(self, data, sender, receiver):
        rng, line = self.rng, (sender, receiver, data[5])
        before = self.states.setdefault(line, first_loss_state(CHANNEL, rng)).consecutive
        state, steps = transmit(self.channel, rng, self.states[line], sends=True)
        most = self.channel.max_consecutive_losses
        if self.until_worst and 0 < before < most:  # a run of losses that began is carried to its end
            state, steps = state._replace(consecutive=before + 1), -1
        self.states[line] = state
        self.recorded.append((data, sender, receiver))
        if self.is_cut:
            return
        if steps >= 0:
            for copies in range(1 + (rng.random() < self.mischief)):
                self.arrive(steps - 1 + 3 * copies, data, sender, receiver)
        elif rng.random() < self.mischief:
            changed = bytearray(data)
            changed[rng.integers(len(data))] ^= 1
            self.arrive(0, bytes(changed), sender, receiver)
        if rng.random() < self.mischief:
            self.arrive(0, *self.recorded[rng.integers(len(self.recorded))])

    def arrive(self, steps, data, sender, receiver):
        time = self.now + (steps + self.rng.uniform(0.01, 0.7)) * self.dt
        heapq.heappush(self.queue, (time, next(self.order), data, sender, receiver))

    def deliver(self):
        while self.queue and self.queue[0][0] <= self.now:
            time, _, data, sender, receiver = heapq.heappop(self.queue)
            receiver.inbox.append((time, data, sender))


class Socket:
    def __init__(self, air, clock_of, peer=None):
        self.air, self.clock_of, self.peer, self.inbox = air, clock_of, peer, []

    def send(self, data, to=None):
        self.air.carry(data, self, to or self.peer)

    def received(self):
        arrived, self.inbox = self.inbox, []
        return [Datagram(self.clock_of(time), data, sender) for time, data, sender in arrived]

    def close(self):
        pass


class World:
    """A plant with sensor and actuator by one clock, a controller by another one, and the air between them."""

    def __init__(self, plant=PLANT, certificate=None, seed=0, offset=1234.0, drift=0.0, uplink=CHANNEL, **settings):
        self.plant, self.dt, self.uplink = plant, plant.dt, uplink
        self.certificate = certificate_of(plant, CONTRACT) if certificate is None else certificate
        self.air, self.rng = Air(plant.dt, seed, **settings), np.random.default_rng([seed, 1])
        self.offset, self.drift = offset, drift
        self.state, self.history, self.proved, self.missing = np.zeros(plant.n), [], [], []
        self.sent, self.ages, self.ask = [], [], lambda: False
        self.at_controller = Socket(self.air, lambda time: time)
        self.controller = self.new_controller(np.zeros(plant.n), known=True)
        self.clock = StepClock(self.dt)
        self.sensor, self.actuator = self.new_sensor(), self.new_actuator()
        self.clock.start(self.local(0.0))
        self.episode, self.last, self.is_moving, self.held, self.busy_until = 0, 0, False, None, 0.0

    def local(self, time):
        return self.offset + (1.0 + self.drift) * time

    def new_controller(self, x_hat0, known):
        settings = {"downlink": CHANNEL, "echo_age": 10, "on_unproved": "ignore"}
        loop = SafeLoop(self.certificate, self.plant, self.uplink, **settings)
        wire = Wire(self.plant, loop.input_delay, KEY)
        self.at_controller.inbox = []
        self.next_step = None
        return ControllerNode(loop, wire, self.at_controller, StepClock(self.dt), x_hat0, known=known)

    def new_sensor(self):
        wire = Wire(self.plant, self.controller.loop.input_delay, KEY)
        self.at_sensor = Socket(self.air, self.local, self.at_controller)
        return SensorNode(wire, self.at_sensor, self.clock)

    def new_actuator(self):
        input_delay = self.controller.loop.input_delay
        self.at_actuator = Socket(self.air, self.local, self.at_controller)
        actuator = Actuator(input_delay, self.plant.m, self.plant.u_max)
        return ActuatorNode(Wire(self.plant, input_delay, KEY), self.at_actuator, self.clock, actuator)

    def act(self, step):
        """What the board beside the plant does at a step."""
        plant, rng = self.plant, self.rng
        if self.held is not None and (self.clock.episode in (0, self.held) or step < 0):
            self.state, self.is_moving = np.zeros(plant.n), False
        self.is_moving |= self.held != self.clock.episode != 0 and step >= 0
        if self.sensor is not None:
            self.sent.append(self.sensor.is_requested(step))
            self.sensor.send(step, plant.H @ self.state + plant.sensor_noise.bound.sample_boundary(rng))
        u = np.zeros(plant.m) if self.actuator is None else self.actuator.apply(step)
        if self.is_moving:
            self.history.append(self.state)
            self.missing.append(0 if self.actuator is None else self.actuator.actuator.echo.missing)
            nominal = plant.A @ self.state + plant.B @ u
            self.state = nominal + plant.nominal_disturbance.extreme_point(self.certificate.M @ nominal + 1e-12)

    def run(self, steps, proposed=None):
        """Runs for some steps of the controller's clock, every node at its own times."""
        propose = proposed or (lambda estimate: PLANT.u_max * (1.0 if len(self.proved) // 40 % 2 else -1.0))
        end = self.air.now + steps * self.dt
        reasons = []
        while True:
            by_plant = (self.clock.time_of(self.last + 1) - self.offset) / (1.0 + self.drift)
            node = self.controller
            waiting = node is None or node.episode == 0
            by_controller = self.air.now + self.dt if waiting else node.clock.time_of(node.step)
            if waiting:
                self.next_step = self.next_step if self.next_step and self.next_step > self.air.now else by_controller
                by_controller = self.next_step
            by_controller = max(by_controller, self.busy_until)
            time = max(min(by_plant, by_controller), self.air.now)
            if time > end:
                self.air.now = end
                return reasons
            self.air.now = time + 1e-9
            self.air.deliver()
            if by_controller <= by_plant:
                if node is not None:
                    estimate = node.receive(self.air.now)
                    if estimate is not None:
                        reasons.append(node.loop.reason)
                        self.proved.append(node.loop.guaranteed)
                        self.ages.append(node.loop.measurement_age)
                        node.decide(propose(estimate), ask=self.ask())
                continue
            now = self.local(self.air.now)
            for each in (self.sensor, self.actuator):
                if each is not None:
                    each.listen(now)
            step = self.clock.step_at(now + 0.1 * self.dt)
            if self.clock.episode != self.episode:
                self.episode, self.last = self.clock.episode, step
            elif step > self.last:
                self.last = step
                if self.clock.is_settled:
                    self.act(step)

    @property
    def worst(self):
        return max(np.abs(self.plant.box_rows @ state).max() for state in self.history)


@pytest.mark.cases(1)
@pytest.mark.parametrize(("seed", "offset", "drift"), [(0, 0.0, 0.0), (1, 1234.0, 3e-4), (2, -77.7, -3e-4)])
def test_nothing_leaves_the_box_and_the_proof_holds_while_the_network_keeps_its_contract(seed, offset, drift):
    world = World(seed=seed, offset=offset, drift=drift)
    reasons = world.run(800)
    assert set(reasons) == {""}
    assert len(reasons) > 700
    assert world.worst <= 1.0
    assert world.actuator.actuator.echo.missing == 0
    assert world.controller.skipped == 0
    assert world.clock.jumps == 0
    assert world.clock.drift == pytest.approx(-drift, abs=3e-4)
    assert {"tag", "episode"} & set(world.sensor.refused | world.actuator.refused | world.controller.refused)


@pytest.mark.slow
def test_hour_at_50_hz_with_drift_attacks_and_mischief_is_proved_at_every_step():
    world, reasons, worst = World(seed=5, offset=1234.0, drift=3e-4), set(), 0.0
    for _ in range(90):
        reasons |= set(world.run(2000))
        worst = max(worst, world.worst)
        world.history.clear()
        world.air.recorded = world.air.recorded[-1000:]
    assert reasons == {""}
    assert 0.9 < worst <= 1.0  # the attack comes close
    assert (world.actuator.actuator.echo.missing, world.clock.jumps) == (0, 0)


def asking(kind, world):
    """Whether a sample is asked for: hostile ones know the true state, or what is on its way."""
    alternating = itertools.cycle([True, False])
    return {
        "never": lambda: False,
        "at random": lambda: bool(world.rng.random() < 0.3),
        "every second": lambda: next(alternating),
        "while it is safe": lambda: bool(np.abs(world.plant.box_rows @ world.state).max() < 0.5),
        "while the network loses": lambda: any(state.consecutive for state in world.air.states.values()),
    }[kind]


@pytest.mark.cases(1)
@pytest.mark.parametrize("kind", ["never", "at random", "every second", "while it is safe", "while the network loses"])
def test_samples_on_request_are_never_older_than_the_contract_allows_whoever_asks(kind):
    """There is room for two steps beyond the four of each way."""
    world = World(
        certificate=certificate_of(PLANT, ChannelContract(10)), uplink=replace(CHANNEL, on_request=True), seed=3
    )
    world.air.until_worst = True
    world.ask = asking(kind, world)
    reasons = world.run(400)
    assert set(reasons) == {""}
    assert len(reasons) > 300
    assert world.worst <= 1.0
    assert max(world.ages) == 6
    assert world.actuator.actuator.echo.missing == 0
    assert 0.3 < np.mean(world.sent) < 0.95
    assert world.controller.episode == world.sensor.episode != 0


def test_sensor_that_hears_nothing_sends_every_sample():
    world = World(certificate=certificate_of(PLANT, ChannelContract(10)), uplink=replace(CHANNEL, on_request=True))
    world.run(200)
    while all(world.sensor.is_requested(step) for step in range(world.last + 1, world.last + 5)):
        world.run(1)  # until it has heard of a sample that is not to be sent
    del world.sent[:]
    world.sensor.listen = lambda now: world.at_sensor.received()
    world.run(50)
    assert all(world.sent[8:])
    assert not all(world.sent)


def test_message_recorded_from_a_waiting_sensor_does_not_silence_one_that_is_not_asked():
    """A sensor that may be silent for longer than others are is not taken over meanwhile."""
    plant = truck_trailer(mass=4000.0)
    uplink = replace(CHANNEL, on_request=True)
    world = World(plant, certificate_of(plant), uplink=uplink, mischief=0.0)
    world.run(PRELUDE + 60)
    waiting = [each for each in world.air.recorded if each[1] is world.at_sensor][:3]
    episode, push = world.controller.episode, lambda estimate: plant.u_max * (1.0 if estimate[0] < 0 else -1.0)
    for _ in range(200):
        world.air.arrive(0, waiting[0][0], Socket(world.air, lambda time: time), world.at_controller)
        assert set(world.run(1, push)) <= {""}
    assert world.controller.episode == episode == world.sensor.episode
    assert max(world.ages) > PATIENCE


def test_the_same_without_the_shield_leaves_the_box():
    world = World()
    loop = SafeLoop(world.certificate, PLANT, CHANNEL, "monitor", downlink=CHANNEL, echo_age=10, on_unproved="ignore")
    world.controller.loop = loop
    world.run(400)
    assert world.worst > 1.0


def test_clock_that_follows_steps_as_long_as_the_other_and_not_before_it():
    rng, clock = np.random.default_rng(0), StepClock(0.02)
    clock.join(5, 7.0, 0)
    steps = np.arange(1, 20_000)
    for step in steps:
        begins = 7.0 + 0.02 * step * (1.0 + 3e-4)
        clock.follow(int(step), begins + rng.uniform(0.001, 0.03))
        clock.follow(int(rng.integers(0, step + 1)), begins + rng.uniform(0.0, 0.03))  # one that is repeated
        if step > 1000:
            assert -0.001 < clock.time_of(int(step)) - begins < 0.004
    assert clock.drift == pytest.approx(-3e-4, rel=0.05)
    assert clock.jumps == 0


def test_clock_notices_that_the_other_one_jumps():
    clock = StepClock(0.02)
    clock.join(5, 7.0, 0)
    for step in range(1, 200):
        assert clock.follow(step, 7.0 + 0.02 * step)
    assert not clock.follow(200, 6.0 + 0.02 * 200)
    assert (clock.jumps, clock.episode) == (1, 0)


def test_board_whose_controller_s_clock_jumps_ends_the_proof():
    world = World(mischief=0.0)
    world.run(200)
    world.controller.clock.origin -= 3 * world.dt
    reasons = world.run(100, proposed=lambda estimate: None)
    assert reasons[-1] == LATE_INPUT
    assert world.clock.jumps == 1
    assert world.clock.episode == world.actuator.episode == world.controller.episode


def test_controller_that_is_held_up_decides_the_missed_steps_and_says_so():
    world = World(mischief=0.0)
    world.air.channel = Channel(delay=1)  # quick enough to leave room
    world.run(200)
    for lag, is_kept in ((2, True), (8, False)):
        world.busy_until = world.air.now + (lag + 0.5) * world.dt
        before = world.controller.skipped
        reasons = world.run(100)
        assert world.controller.skipped - before == pytest.approx(lag, abs=2)
        assert (set(reasons) == {""}) is is_kept


@pytest.mark.cases(1)
@pytest.mark.parametrize("silence", [1, 100])
def test_sensor_that_is_restarted_joins_again(silence):
    world = World()
    world.run(200)
    episode = world.controller.episode
    world.sensor = None
    gone = world.run(silence)
    world.sensor = world.new_sensor()
    back = world.run(300, proposed=lambda estimate: None)
    assert world.controller.episode == episode == world.sensor.episode
    assert (OLD_SAMPLE in gone) is (silence > 8)
    if silence == 1:
        assert OLD_SAMPLE in back
        assert back[-1] == ""
        assert world.worst <= 1.0


def test_actuator_that_is_restarted_applies_zero_and_ends_the_proof_until_another_episode():
    world = World()
    world.run(200)
    world.actuator = world.new_actuator()
    reasons = world.run(100, proposed=lambda estimate: None)
    assert reasons[-1] == LATE_INPUT
    assert world.actuator.episode == world.controller.episode
    world.held = world.clock.episode
    world.controller.begin(np.zeros(PLANT.n), known=False)
    reasons = world.run(200, proposed=lambda estimate: None)
    assert reasons[0] == UNKNOWN_START
    assert reasons[-1] == ""


def test_actuator_without_a_controller_goes_to_zero_when_what_is_committed_ends():
    world = World(mischief=0.0)
    world.run(200)
    world.controller = None
    applied = []
    apply = world.actuator.apply
    world.actuator.apply = lambda step: applied.append(apply(step)) or applied[-1]
    input_delay = world.actuator.actuator.input_delay
    world.run(PATIENCE + input_delay + 5)
    sizes = [float(np.abs(u).max()) for u in applied]
    assert any(sizes[:input_delay])
    assert not any(sizes[input_delay + 3 :])
    assert world.actuator.episode == world.sensor.episode == 0


def test_controller_that_is_restarted_claims_nothing_until_it_knows_and_then_it_proves_again():
    plant = truck_trailer(mass=4000.0)
    world = World(plant, certificate_of(plant))
    push = lambda estimate: plant.u_max * (1.0 if estimate[0] < 0 else -1.0)  # noqa: E731
    world.run(200, push)
    before = world.controller.episode
    world.controller = None
    world.run(30)
    world.controller = world.new_controller(np.zeros(plant.n), known=False)
    reasons = world.run(PRELUDE + 100, push)
    assert world.controller.episode not in (0, before)
    assert reasons[0] == UNKNOWN_START
    assert reasons[-1] == ""
    assert world.worst <= 1.0


def test_what_was_recorded_in_earlier_episodes_moves_nothing():
    world = World(mischief=0.0)
    world.run(200)
    recorded = [each for each in world.air.recorded if each[2] is world.at_actuator]
    world.controller = None
    world.run(3 * PATIENCE)
    assert world.actuator.episode == 0
    moved = []
    apply = world.actuator.apply
    world.actuator.apply = lambda step: moved.append(apply(step)) or moved[-1]
    for each in recorded * 2:
        world.air.arrive(0, *each)
    world.run(50)
    assert not np.any(moved)
    assert world.actuator.episode == 0
    assert world.actuator.refused["episode"] >= 2 * len(recorded)


def test_stamp_far_ahead_is_refused_although_it_is_authentic():
    world = World(mischief=0.0)
    world.run(100)
    wire = Wire(PLANT, world.controller.loop.input_delay, KEY)
    for stamp in (2**61, world.controller.step + PRELUDE + 100):
        fields = {"kind": Kind.SAMPLE, "episode": world.controller.episode, "values": np.full(4, 9.0)}
        world.air.arrive(0, wire.encode(Message(stamp=stamp, **fields)), world.at_sensor, world.at_controller)
    assert set(world.run(100)) == {""}
    assert world.controller.refused["ahead"] == 2


def test_network_that_breaks_its_contract_pauses_or_ends_the_proof_and_says_which():
    world = World(mischief=0.0)
    world.run(200)
    world.air.is_cut = True
    cut = world.run(30)
    world.air.is_cut = False
    back = world.run(100, proposed=lambda estimate: None)
    assert cut[0] == ""
    assert {OLD_SAMPLE, NOT_CONFIRMED} & set(cut)
    assert back[-1] == LATE_INPUT  # the actuator ran out of inputs, and its echo says so
    late = next(i for i, missing in enumerate(world.missing) if missing)
    assert max(np.abs(PLANT.box_rows @ state).max() for state in world.history[:late]) <= 1.0
