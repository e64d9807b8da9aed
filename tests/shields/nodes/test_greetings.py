"""What docs/network_loop.md promises about messages, against somebody who records, repeats and holds them back."""

import itertools

import numpy as np
import pytest

from ncs_gym import Actuator, Channel, truck_trailer
from ncs_gym.network.wire import Kind, Message, Wire
from shields import ActuatorNode, ControllerNode, SafeLoop, SensorNode
from shields.nodes import Datagram, StepClock
from shields.nodes.nodes import PRELUDE
from shields.runtime.guarantee import LATE_INPUT, NOT_CONFIRMED
from tests.certificates import certificate_of

PLANT, KEY = truck_trailer(mass=4000.0), bytes(range(32))
CHANNEL = Channel(loss=0.2, delay=1, jitter=1, max_consecutive_losses=2)
ECHO_AGE = 30
# Long enough for any beginning of an episode, and for any end.
A_WHILE = 150


class Socket:
    """Hands what it sends to its peer, or to whom it answers, for the next step."""

    def __init__(self, line, peer=None):
        self.line, self.peer, self.inbox = line, peer, []

    def send(self, data, to=None):
        self.line.carry(data, self, to or self.peer)

    def received(self):
        taken = [each for each in self.inbox if each.time < self.line.now]
        self.inbox = [each for each in self.inbox if each.time >= self.line.now]
        return taken

    def close(self):
        pass


class Line:
    """A plant with its two nodes, a controller or none, and a network that somebody listens to.

    What is sent in one step is there at the next, unless `loses(data, sender, receiver)` says otherwise.
    """

    def __init__(self, channel=CHANNEL):
        self.now, self.sent, self.loses = 0.0, [], lambda data, sender, receiver: False
        self.channel, self.applied, self.steps = channel, [], []
        self.quicker, self.slower = [], []  # addresses from which copies reach the controller before and after
        self.at_controller = Socket(self)
        self.sensor = self.actuator = self.controller = None
        self.clock = StepClock(PLANT.dt)
        self.counted, self.state = (0, 0), np.zeros(PLANT.n)
        self.clock.start(0.0)

    def carry(self, data, sender, receiver):
        self.sent.append((data, sender, receiver))
        is_heard = receiver is self.at_controller
        came = [] if self.loses(data, sender, receiver) else [sender]
        for each in [*self.quicker, *came, *self.slower] if is_heard else came:
            receiver.inbox.append(Datagram(self.now, data, each))

    def addresses(self, number):
        """Addresses of somebody who copies what is sent."""
        return [Socket(self) for _ in range(number)]

    def repeat(self, data, receiver, sender="somebody"):
        """Sends a recording."""
        sender = Socket(self) if sender == "somebody" else sender
        receiver.inbox.append(Datagram(self.now, data, sender))

    def add_controller(self):
        settings = {"downlink": self.channel, "echo_age": ECHO_AGE, "on_unproved": "ignore"}
        loop = SafeLoop(certificate_of(PLANT), PLANT, CHANNEL, **settings)
        self.wire, self.input_delay = Wire(PLANT, loop.input_delay, KEY), loop.input_delay
        self.at_controller.inbox = []
        start = np.zeros(PLANT.n)
        clock = StepClock(PLANT.dt)
        self.controller = ControllerNode(loop, self.wire, self.at_controller, clock, start, known=True)
        return self

    def add_sensor(self):
        self.at_sensor = Socket(self, self.at_controller)
        self.sensor = SensorNode(self.wire, self.at_sensor, self.clock)
        return self

    def add_actuator(self):
        self.at_actuator = Socket(self, self.at_controller)
        board = Actuator(self.input_delay, PLANT.m, PLANT.u_max)
        self.actuator = ActuatorNode(self.wire, self.at_actuator, self.clock, board)
        return self

    def run(self, steps, each_step=lambda: None):
        """Returns whether the state is said to be proved safe, for each step at which the controller decided."""
        proved = []
        for _ in range(steps):
            self.now += PLANT.dt
            each_step()
            self._plant_side()
            if self.controller is not None and self.controller.receive(self.now) is not None:
                proved.append(self.controller.loop.guaranteed)
                self.controller.decide(PLANT.u_max / 2)
        return proved

    def _plant_side(self):
        for node in (self.sensor, self.actuator):
            if node is not None:
                node.listen(self.now)
        step = self.clock.step_at(self.now + 0.1 * PLANT.dt)
        if self.counted[0] != self.clock.episode:
            self.counted = self.clock.episode, step - 1
        if step <= self.counted[1] or not self.clock.is_settled:
            return
        self.counted = self.clock.episode, step
        if self.sensor is not None:
            self.sensor.send(step, PLANT.H @ self.state)
        if self.actuator is not None:
            self.steps.append(step if self.actuator.episode else None)
            self.applied.append(self.actuator.apply(step))
            self.state = PLANT.A @ self.state + PLANT.B @ self.applied[-1]

    def recorded(self, kind, greetings_only=False):
        """Datagrams of a kind that were sent so far."""
        messages = [(self.wire.decode(data), data) for data, _, _ in self.sent]
        return [data for each, data in messages if each.kind is kind and (not greetings_only or each.episode == 0)]


def started():
    line = Line().add_controller().add_sensor().add_actuator()
    assert all(line.run(A_WHILE))
    assert line.controller.episode == line.sensor.episode == line.actuator.episode != 0
    return line


def without_plant(line):
    """The same network after the plant side was switched off, and another controller."""
    line.sensor = line.actuator = None
    line.state = np.zeros(PLANT.n)
    return line.add_controller()


@pytest.mark.parametrize("greetings_only", [True, False])
def test_recordings_of_an_earlier_run_begin_no_episode_with_nobody(greetings_only):
    line = started()
    samples, echoes = (line.recorded(kind, greetings_only) for kind in (Kind.SAMPLE, Kind.ECHO))
    assert samples
    assert echoes
    without_plant(line)
    of_each = itertools.cycle(itertools.zip_longest(samples, echoes, fillvalue=samples[0]))

    def repeat():
        for data in next(of_each):
            line.repeat(data, line.at_controller)

    assert line.run(2 * A_WHILE, repeat) == []


@pytest.mark.parametrize("present", ["sensor", "actuator"])
def test_recorded_greeting_of_the_other_node_begins_no_episode_and_the_plant_does_not_move(present):
    line = started()
    greeting = line.recorded(Kind.ECHO if present == "sensor" else Kind.SAMPLE, greetings_only=True)[0]
    without_plant(line)
    line.clock = StepClock(PLANT.dt)
    line.clock.start(line.now)
    getattr(line, f"add_{present}")()
    line.steps.clear()
    assert line.run(2 * A_WHILE, lambda: line.repeat(greeting, line.at_controller)) == []
    assert line.clock.step_at(line.now) < 0 or line.clock.episode == 0 or getattr(line, present).episode == 0
    assert all(step is None or step < 0 for step in line.steps)


def test_episode_begins_as_known_once_everybody_is_there_although_greetings_were_repeated():
    line = started()
    greetings = [line.recorded(kind, greetings_only=True)[0] for kind in (Kind.SAMPLE, Kind.ECHO)]
    without_plant(line)

    def repeat():
        for data in greetings:
            line.repeat(data, line.at_controller)

    line.run(A_WHILE, repeat)
    line.clock = StepClock(PLANT.dt)
    line.clock.start(line.now)
    line.add_sensor().add_actuator()
    proved = line.run(2 * A_WHILE, repeat)
    assert proved
    assert all(proved)
    assert line.actuator.actuator.echo.missing == 0


@pytest.mark.parametrize("leaves", ["sensor", "actuator"])
def test_node_that_leaves_before_the_first_step_is_waited_for(leaves):
    line = Line().add_controller().add_sensor().add_actuator()
    line.run(8)
    assert getattr(line, leaves).episode == line.controller.episode != 0
    setattr(line, leaves, None)
    assert line.run(2 * A_WHILE) == []
    getattr(line, f"add_{leaves}")()
    proved = line.run(2 * A_WHILE)
    assert proved
    assert all(proved)


def test_outage_just_before_the_first_step_begins_another_episode_that_claims_nothing_by_itself():
    """The others may have passed step 0 meanwhile: where the state is then, samples have to tell."""
    line = Line().add_controller().add_sensor().add_actuator()
    line.run(26)
    line.loses = lambda data, sender, receiver: sender is line.at_actuator
    assert line.run(A_WHILE) == []
    line.loses = lambda data, sender, receiver: False
    proved = line.run(2 * A_WHILE)
    assert proved[-1]
    assert not proved[0]


def test_node_that_heard_too_little_of_an_episode_to_go_by_it_greets_again():
    line = Line().add_controller().add_sensor().add_actuator()
    line.run(6)
    assert line.sensor.episode == line.actuator.episode == line.controller.episode != 0
    line.controller = None
    line.run(A_WHILE)
    line.add_controller()
    assert line.run(A_WHILE)[-1]


@pytest.mark.parametrize("period", [1, 9])
def test_repeated_message_of_a_dead_controller_keeps_no_node_in_its_episode(period):
    line = started()
    recorded = {line.at_sensor: line.recorded(Kind.BEACON)[-1], line.at_actuator: line.recorded(Kind.COMMAND)[-1]}
    line.controller = None
    count = itertools.count()

    def repeat():
        if next(count) % period == 0:
            for receiver, data in recorded.items():
                line.repeat(data, receiver)

    line.run(40, repeat)
    assert line.sensor.episode == line.actuator.episode == 0
    assert not np.any(line.applied[-20:])


def test_messages_that_were_held_back_keep_no_node_in_the_episode_of_a_dead_controller():
    line = started()
    held = []

    def holds(data, sender, receiver):
        held.append((data, receiver))
        return True

    line.loses = lambda data, sender, receiver: receiver is not line.at_controller and holds(data, sender, receiver)
    line.run(8)  # too few for the nodes to leave
    line.loses, line.controller = lambda data, sender, receiver: False, None
    released, count = iter(held), itertools.count()

    def release():
        if next(count) % 9 == 0:
            for data, receiver in itertools.islice(released, 2):
                line.repeat(data, receiver)

    line.run(40, release)
    assert line.sensor.episode == line.actuator.episode == 0


def test_recorded_greeting_diverts_no_commands_from_an_actuator_whose_echoes_are_lost():
    line = started()
    greeting = line.recorded(Kind.ECHO, greetings_only=True)[0]
    line.loses = lambda data, sender, receiver: sender is line.at_actuator
    proved = line.run(2 * ECHO_AGE, lambda: line.repeat(greeting, line.at_controller))
    assert all(proved[: ECHO_AGE - 2])
    assert not any(proved[ECHO_AGE + 2 :])
    assert line.actuator.episode == line.controller.episode
    assert line.actuator.actuator.echo.missing == 0
    line.loses = lambda data, sender, receiver: False
    assert line.run(20)[-1]


def test_node_stays_in_its_episode_for_as_long_as_the_downlink_may_be_silent():
    line = Line(Channel(loss=0.2, delay=1, max_consecutive_losses=14)).add_controller().add_sensor().add_actuator()
    count = itertools.count()
    down = lambda receiver: receiver is not line.at_controller  # noqa: E731
    assert all(line.run(A_WHILE))
    line.loses = lambda data, sender, receiver: down(receiver) and next(count) % 30 < 28  # two messages in a step
    proved = line.run(A_WHILE)
    assert all(proved)
    assert line.actuator.actuator.echo.missing == 0


def test_before_the_first_echo_what_is_claimed_rests_on_the_downlink_alone():
    line = Line().add_controller().add_sensor().add_actuator()
    prelude = PRELUDE + 2 * line.input_delay
    line.loses = lambda data, sender, receiver: sender is line.at_actuator and line.wire.decode(data).stamp >= prelude
    proved = line.run(A_WHILE)
    assert proved == [True] * (ECHO_AGE + 1) + [False] * (len(proved) - ECHO_AGE - 1)
    assert line.controller.loop.reason == NOT_CONFIRMED


def damaged(data):
    return {
        "length": [b"", data[:-1], data + b"\0", data[:40]],
        "format": [b"X" + data[1:], data[:4] + b"\2" + data[5:], data[:6] + b"\1" + data[7:]],
        "tag": [data[:20] + bytes([data[20] ^ 1]) + data[21:], data[:-1] + bytes([data[-1] ^ 1])],
    }


def test_anything_but_a_message_of_this_loop_is_refused_and_counted_by_reason():
    line = started()
    receivers = {
        line.at_sensor: (line.sensor, [Kind.BEACON]),
        line.at_actuator: (line.actuator, [Kind.COMMAND, Kind.BEACON]),
        line.at_controller: (line.controller, [Kind.SAMPLE, Kind.ECHO]),
    }
    for receiver, (node, (kind, *others)) in receivers.items():
        before = node.refused.copy()
        cases = damaged(line.recorded(kind)[-1])
        foreign = Wire(PLANT, line.input_delay, KEY[::-1]).encode(line.wire.decode(line.recorded(kind)[-1]))
        other_plant = Wire(truck_trailer(mass=4001.0), line.input_delay, KEY)
        cases["tag"].append(foreign)
        cases["plant"] = [other_plant.encode(line.wire.decode(line.recorded(kind)[-1]))]
        cases["kind"] = [line.recorded(each)[-1] for each in Kind if each not in (kind, *others)]
        for data in itertools.chain(*cases.values()):
            line.repeat(data, receiver)
        assert all(line.run(1))
        assert {reason: len(each) for reason, each in cases.items()} == node.refused - before


def test_all_messages_of_a_kind_have_one_length_and_nothing_in_them_is_encrypted():
    line = started()
    lengths = {kind: {len(data) for data in line.recorded(kind)} for kind in Kind}
    assert all(len(each) == 1 for each in lengths.values())
    fields = {"kind": Kind.SAMPLE, "episode": 1, "stamp": 2}
    assert np.full(PLANT.p, 1.25).tobytes() in line.wire.encode(Message(**fields, values=np.full(PLANT.p, 1.25)))


def test_node_draws_another_challenge_when_it_joins_and_when_it_leaves():
    line = started()
    line.controller = None
    line.run(A_WHILE)
    line.add_controller()
    line.run(A_WHILE)
    drawn = [line.wire.decode(data).challenge for data in line.recorded(Kind.ECHO)]
    assert len({challenge for challenge, _ in itertools.groupby(drawn)}) == len([*itertools.groupby(drawn)]) == 4


def test_samples_that_may_be_too_late_for_a_prelude_are_refused_at_once():
    line = Line().add_controller()
    settings = {"downlink": CHANNEL, "echo_age": ECHO_AGE, "on_unproved": "ignore"}
    loop = SafeLoop(certificate_of(PLANT), PLANT, Channel(delay=21), **settings)
    with pytest.raises(ValueError, match="21 steps late"):
        ControllerNode(loop, line.wire, line.at_controller, StepClock(PLANT.dt), np.zeros(PLANT.n), known=True)


@pytest.mark.parametrize(("quicker", "slower"), [(0, 1), (1, 0), (31, 0), (0, 31), (15, 16)])
def test_copies_from_other_addresses_neither_keep_the_loop_from_starting_nor_divert_anything(quicker, slower):
    line = Line().add_controller().add_sensor().add_actuator()
    line.quicker, line.slower = line.addresses(quicker), line.addresses(slower)
    proved = line.run(A_WHILE)
    assert len(proved) > A_WHILE // 2
    assert all(proved)
    assert line.actuator.actuator.echo.missing == 0
    assert all(each.inbox for each in line.quicker)  # they are answered beside the nodes


def test_copies_that_come_after_the_originals_divert_nothing_however_many_there_are():
    line = started()
    line.quicker, line.slower = line.addresses(31), line.addresses(100)
    assert all(line.run(A_WHILE))
    assert line.actuator.actuator.echo.missing == 0


def test_copies_that_come_steps_before_the_originals_divert_nothing():
    line = started()
    line.quicker, held = line.addresses(31), []

    def holds(data, sender, receiver):
        if receiver is line.at_controller:
            held.append((line.now + 2.5 * PLANT.dt, data, receiver, sender))
        return receiver is line.at_controller

    def release():
        while held and held[0][0] < line.now:
            line.repeat(*held.pop(0)[1:])

    line.loses = holds
    assert all(line.run(A_WHILE, release))
    assert line.actuator.actuator.echo.missing == 0


def test_copy_of_a_message_whose_original_is_lost_diverts_nothing():
    line, count = started(), itertools.count()
    line.quicker = line.addresses(1)
    line.loses = lambda data, sender, receiver: receiver is line.at_controller and next(count) % 3 > 0
    assert all(line.run(A_WHILE))
    assert line.actuator.actuator.echo.missing == 0


def test_more_greetings_than_are_answered_keep_the_loop_from_starting_and_it_claims_nothing():
    line = Line().add_controller().add_sensor().add_actuator()
    line.slower = line.addresses(32)
    assert line.run(2 * A_WHILE) == []
    line.slower = []
    proved = line.run(2 * A_WHILE)
    assert proved
    assert all(proved)


def test_more_quicker_copies_than_are_answered_divert_commands_and_the_loop_reports_it():
    line = started()
    line.quicker = line.addresses(32)
    proved = line.run(A_WHILE)
    told = proved.index(False)
    assert told <= CHANNEL.longest_delay + 2 * line.input_delay + 2
    assert not any(proved[told:])
    assert line.controller.loop.reason == LATE_INPUT


def test_address_from_which_nothing_newer_comes_is_told_nothing_more():
    line = started()
    line.quicker = [somebody] = line.addresses(1)
    line.run(1)
    line.quicker = []
    line.run(40)
    told = len(somebody.inbox)
    assert 0 < told < 60
    line.run(40)
    assert len(somebody.inbox) == told
