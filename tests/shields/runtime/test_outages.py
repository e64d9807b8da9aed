"""What goes wrong in real loops: outages of the plant, wild commands, controllers that start anew in the middle."""

import pickle

import numpy as np
import pytest

from ncs_gym import (
    Actuator,
    Channel,
    ChannelContract,
    Command,
    Ellipsoid,
    Packet,
    cart_pole,
    certified_error_set,
    truck_trailer,
)
from ncs_gym.estimation.first_estimate import first_estimate
from ncs_gym.processes.cart_pole_process import nonlinear_cart_pole
from shields.runtime.guarantee import (
    ALARM,
    LATE_INPUT,
    NOT_CONFIRMED,
    OTHER_EPISODE,
    OTHER_INPUT,
    UNKNOWN_START,
)
from tests.certificates import certificate_of
from tests.product import safe_loop, sampled_plant

PLANT = cart_pole()
UPLINK = Channel(loss=0.3, delay=1, max_consecutive_losses=1)
DOWNLINK = Channel(loss=0.3, delay=1, max_consecutive_losses=1)  # c = 2


def loop_with(echo_age=4, downlink=DOWNLINK, plant=PLANT, contract=4, **settings):
    certificate = certificate_of(plant, None if contract is None else ChannelContract(contract))
    return safe_loop(certificate, plant, UPLINK, downlink=downlink, echo_age=echo_age, **settings)


class World:
    """A plant with its actuator, which can be switched off: then it stays where it is, and sends nothing."""

    def __init__(self, loop, state=None, seed=0):
        self.loop, self.plant, self.rng = loop, loop.filter.plant, np.random.default_rng(seed)
        self.state = np.zeros(self.plant.n) if state is None else state
        self.actuator = Actuator(loop.input_delay, self.plant.m, self.plant.u_max)
        self.packets, self.echoes, self.step = [], [], 0

    def start(self, **settings):
        plant = self.plant
        self.loop.start(self.state + plant.of_first_error.drawn(self.rng), **settings)
        self.actuator.start(self.loop.episode)
        self.packets, self.echoes, self.step = [], [], 0

    def move(self, proposed=0.0, *, is_on=True, is_heard=True):
        loop, plant = self.loop, self.plant
        loop.receive(self.packets, echoes=self.echoes)
        guaranteed = loop.guaranteed
        loop.decide(proposed)
        self.packets, self.echoes = [], []
        if is_on:
            if is_heard:
                self.actuator.receive([loop.command()])
            sample = plant.H @ self.state + plant.of_sensor.drawn(self.rng)
            self.packets = [Packet(self.step, sample, loop.episode)]
            u = self.actuator.apply(self.step)
            self.echoes = [self.actuator.echo]
            d = plant.nominal_disturbance.sample_boundary(self.rng)
            self.state = plant.A @ self.state + plant.B @ u + d
        self.step += 1
        return guaranteed


@pytest.mark.cases(4)
@pytest.mark.parametrize("length", [1, 2, 5, 10, 30])
@pytest.mark.parametrize("downlink", [None, DOWNLINK])
def test_outage_of_the_plant_ends_the_proof_for_the_episode(length, downlink):
    loop = loop_with(downlink=downlink)
    world = World(loop)
    world.start()
    before = [world.move() for _ in range(20)]
    for _ in range(length):
        world.move(is_on=False)
    world.move()
    after = [world.move() for _ in range(40)]
    assert all(before)
    assert not any(after)
    assert loop.reason == (OTHER_INPUT if downlink is None else LATE_INPUT)
    world.state = np.zeros(PLANT.n)
    world.start()
    assert world.move()


def test_a_single_input_that_was_not_applied_is_found_out_although_later_echoes_are_lost():
    loop = loop_with(echo_age=30)
    world = World(loop)
    world.start()
    for step in range(60):
        world.move(is_heard=not 20 <= step < 23)  # three commands in a row are lost: one input is missing
        if 20 <= step < 40:
            world.echoes = []
        assert (loop.reason == LATE_INPUT) is (step > 40)


def reasons_of(loop, echoes_at):
    """What the loop says in 40 steps; `echoes_at` returns what it hears back of the echoes of a step."""
    world, reasons = World(loop), []
    world.start()
    for step in range(40):
        world.move()
        reasons.append(loop.reason)
        world.echoes = echoes_at(step, world.echoes)
    return reasons


def test_silent_actuator_is_not_trusted_for_longer_than_asked_for():
    reasons = reasons_of(loop_with(echo_age=4), lambda step, echoes: [] if 10 <= step < 20 else echoes)
    assert reasons == [""] * 15 + [NOT_CONFIRMED] * 6 + [""] * 19


def test_echoes_of_another_episode_are_a_reason_of_their_own_while_they_come():
    loop = loop_with(echo_age=4)

    def strange_then_none(step, echoes):
        if 10 <= step < 20:
            return [each._replace(episode=loop.episode + 1) for each in echoes]
        return [] if 20 <= step < 30 else echoes

    reasons = reasons_of(loop, strange_then_none)
    assert reasons == [""] * 15 + [OTHER_EPISODE] * 10 + [NOT_CONFIRMED] * 6 + [""] * 9


def test_what_the_loop_says_is_conditional_where_nothing_is_echoed():
    told, untold = loop_with(), loop_with(echo_age=None)
    for loop in (told, untold):
        loop.start(np.zeros(4))
    condition = "if everything that is decided is applied"
    assert (condition in str(told), condition in str(untold)) == (False, True)


@pytest.mark.parametrize("input_delay", [0, 2, 5])
def test_wild_stamps_and_inputs_do_not_stop_an_actuator(input_delay):
    actuator = Actuator(input_delay, 1, 10.0)
    inputs, size = np.ones((input_delay + 1, 1)), 0
    for step in range(100):
        wild = [Command(stamp, -inputs) for stamp in (10**9, 2**62, step + input_delay + 2, -(10**9))]
        wild += [Command(step, size * inputs) for size in (1e6, -10.001)]
        actuator.receive([*wild, Command(step, inputs), *wild])
        u = actuator.apply(step)
        assert u.tolist() == [1.0 if step >= input_delay else 0.0]
        size = len(pickle.dumps(actuator)) if step == 10 else size
    assert actuator.echo.missing == 0
    assert actuator.refused == 100 * 10
    assert len(pickle.dumps(actuator)) < 2 * size


def test_command_that_comes_early_is_kept_for_its_step():
    actuator = Actuator(1, 1)
    actuator.receive([Command(0, np.array([[0.0], [1.0]])), Command(1, np.array([[1.0], [2.0]]))])
    assert [actuator.apply(step).tolist() for step in range(4)] == [[0.0], [1.0], [2.0], [0.0]]
    assert (actuator.missing, actuator.echo.missing) == (True, 1)


def far_out(plant, seed):
    """A state in the middle of S."""
    return 0.5 * certificate_of(plant, ChannelContract(4)).safe_set.sample_boundary(np.random.default_rng(seed))


@pytest.mark.cases(4)
@pytest.mark.parametrize("downlink", [None, DOWNLINK])
@pytest.mark.parametrize("seed", range(5))
def test_controller_that_starts_in_the_middle_claims_nothing_until_samples_tell_where_the_state_is(downlink, seed):
    loop = loop_with(downlink=downlink)
    world = World(loop, far_out(PLANT, seed), seed)
    wrong = np.zeros(4) if seed else np.full(4, 1e6)
    world.start()
    loop.start(wrong, known=False)
    world.actuator.start(loop.episode)
    assert loop.reason == UNKNOWN_START
    proved = []
    for _ in range(60):
        x = world.state.copy()
        proved.append(world.move())
        if loop.reason != UNKNOWN_START and loop.input_delay == 0:
            e = loop.estimate - x
            assert e @ np.linalg.solve(loop.error_shape, e) <= 1.0
    assert not proved[0]
    assert proved[-1]
    assert proved == sorted(proved)
    assert np.abs(PLANT.box_rows @ world.state).max() <= 1.0


@pytest.mark.cases(2)
@pytest.mark.parametrize("plant", [PLANT, cart_pole(full_state=False), truck_trailer()])
def test_first_estimate_holds_what_it_claims_against_the_worst_disturbance_and_noise(plant):
    """The claim is attacked by the extreme disturbances and noises of one direction of the error."""
    noise, ages = plant.nominal_sensor_error, certified_error_set(plant, ChannelContract(5))
    rng, found = np.random.default_rng(0), 0
    for _ in range(60):
        x, inputs, states = rng.uniform(-0.3, 0.3, plant.n) * plant.half_widths, [], []
        for _ in range(int(rng.integers(0, 8))):
            states.insert(0, x)
            inputs.insert(0, rng.uniform(-1, 1, plant.m) * plant.u_max)
            push = rng.standard_normal(plant.n)
            x = plant.A @ x + plant.B @ inputs[0] + plant.nominal_disturbance.extreme_point(push)
        states.insert(0, x)
        samples = {
            age: plant.H @ state + noise.extreme_point(rng.standard_normal(plant.p))
            for age, state in enumerate(states)
            if rng.random() < 0.5
        }
        known = first_estimate(plant, ages, samples, inputs, plant.sensor_error.shape_matrix)
        if known is not None:
            found += 1
            assert known[1] == min(samples)
            assert Ellipsoid(ages.shape_at(known[1])).gauge(known[0] - x) <= 1.0
    assert 5 < found < 60


@pytest.mark.parametrize("plant", [PLANT, cart_pole(full_state=False)])
def test_sample_that_contradicts_the_others_leaves_the_state_unknown(plant):
    ages, noise = certified_error_set(plant, ChannelContract(5)), plant.sensor_error.shape_matrix
    inputs = [np.zeros(plant.m)] * 8
    samples = {age: np.zeros(plant.p) for age in range(9)}
    assert first_estimate(plant, ages, samples, inputs, noise) is not None
    for wrong in range(9):
        given = samples | {wrong: 0.5 * plant.H @ plant.half_widths}
        assert first_estimate(plant, ages, given, inputs, noise) is None


def test_slightly_wrong_sample_among_the_newest_leaves_the_state_unknown():
    """Off by 18 times its largest noise: older samples alone do not tell, what a fit of all leaves of each does."""
    plant = cart_pole(full_state=False)
    ages, N = certified_error_set(plant, ChannelContract(5)), plant.sensor_error.shape_matrix
    inputs, samples = [np.zeros(plant.m)] * 8, {age: np.zeros(plant.p) for age in range(9)}
    for wrong in range(1, 8):
        for entry in np.diag(18.0 * np.sqrt(np.diag(N))):
            assert first_estimate(plant, ages, samples | {wrong: entry}, inputs, N) is None


def test_too_few_or_too_coarse_samples_are_no_first_estimate():
    position, contract = cart_pole(full_state=False), ChannelContract(5)
    N, ages = position.sensor_error.shape_matrix, certified_error_set(position, contract)
    assert first_estimate(position, ages, {}, [], N) is None
    assert first_estimate(position, ages, {0: np.zeros(2)}, [], N) is None  # two of four states are not seen
    N, ages = PLANT.sensor_error.shape_matrix, certified_error_set(PLANT, contract)
    assert first_estimate(PLANT, ages, {0: np.zeros(4)}, [], N) is not None
    assert first_estimate(PLANT, ages, {0: np.zeros(4)}, [], 100.0 * N) is None
    assert first_estimate(PLANT, ages, {0: np.full(4, np.inf)}, [], N) is None
    assert first_estimate(PLANT, ages, {6: np.zeros(4)}, [np.zeros(1)] * 6, N) is None  # too old
    local = nonlinear_cart_pole()
    ages = certified_error_set(local, contract)
    assert first_estimate(local, ages, {0: np.zeros(4)}, [], local.sensor_error.shape_matrix) is None


@pytest.mark.cases(3)
@pytest.mark.parametrize("loss", [0.0, 0.5])
@pytest.mark.parametrize("delay", [0, 1, 4])
def test_state_that_many_samples_tell_is_found_on_a_channel_of_any_delay(delay, loss):
    """Two tanks of which the lower one alone is measured, coarsely: six samples in a row prove where the state is."""
    model = [[-0.05, 0.0], [0.05, -0.04]], [[0.12], [0.0]], [[0.0, 1.0]], [[0.0]]
    limits = {"state_limits": ([0.2, 0.3], [2.0, 2.2]), "input_limits": (0.0, 1.0)}
    bounds = {"disturbance_bound": [0.01, 0.002], "sensor_bound": 0.02, "initial_bound": 0.02}
    point = {"operating_state": [1.2, 1.5], "operating_input": 0.5}
    plant = sampled_plant(model, dt=1.0, **limits, **bounds, **point)
    loop = safe_loop(certificate_of(plant, safe_set="polytope"), plant, Channel(delay=delay), on_unproved="ignore")
    rng, x, arrived, proved = np.random.default_rng(delay), np.array([0.3, -0.2]), [], []
    loop.start(np.zeros(2), known=False)
    for step in range(30):
        loop.receive(arrived)
        proved.append(loop.guaranteed)
        if loop.guaranteed:
            e = loop.estimate - x
            assert e @ np.linalg.solve(loop.error_shape, e) <= 1.0
        u = loop.decide(np.zeros(1)).input
        sample = plant.H @ x + rng.uniform(-0.02, 0.02)
        arrived = [Packet(step, sample, loop.episode)] if rng.random() >= loss else []
        x = plant.A @ x + plant.B @ u + rng.uniform(-1.0, 1.0, 2) * [0.01, 0.002]
    assert not proved[0]
    assert any(proved)


# With a known first estimate a sample of step 0 is of no use.
@pytest.mark.cases(6)
@pytest.mark.parametrize(("known", "first"), [(True, 1), (True, 2), (False, 0), (False, 2)])
@pytest.mark.parametrize("apart", [0, 1, 3])
def test_two_values_of_one_sample_end_the_guarantee_whether_the_start_is_known_or_not(known, apart, first):
    plant = truck_trailer(mass=4000.0)
    loop = safe_loop(certificate_of(plant), plant, Channel(delay=4), on_unproved="ignore")
    loop.start(np.zeros(2), known=known)
    proved, arrivals = [], {}
    arrivals.setdefault(first + 1, []).append(Packet(first, np.zeros(2), loop.episode))
    arrivals.setdefault(first + 1 + apart, []).append(Packet(first, np.array([1.3, 0.0]), loop.episode))
    for step in range(12):
        usual = [Packet(step - 1, np.zeros(2), loop.episode)] if step > first + 1 + apart else []
        loop.receive(arrivals.get(step, []) + usual)
        proved.append(loop.guaranteed)
        loop.decide(np.zeros(1))
    assert not any(proved[first + 1 + apart :])
    assert loop.reason == ALARM
    loop.start(np.zeros(2))
    assert loop.guaranteed


def test_samples_of_before_an_unknown_input_tell_nothing_of_where_the_state_is():
    plant = truck_trailer(mass=4000.0)
    loop = safe_loop(certificate_of(plant), plant, Channel(jitter=5), on_unproved="ignore")
    x, unknown = np.zeros(2), None
    loop.start(np.zeros(2), known=False)
    for step in range(6):  # the only sample is of step 0, and nobody knows what acted since then
        loop.receive([Packet(0, np.zeros(2), loop.episode)] if step == 5 else [], applied=unknown)
        assert not loop.guaranteed
        loop.decide(np.zeros(1))
        x, unknown = plant.A @ x + plant.B @ (0.3 * plant.u_max), np.full(1, np.nan)
    loop.receive([Packet(6, x, loop.episode)])
    assert loop.guaranteed
    error = loop.estimate - x
    assert error @ np.linalg.solve(loop.error_shape, error) <= 1.0


def test_actuator_whose_clock_goes_back_says_that_it_applied_something_else():
    actuator = Actuator(0, 1)
    actuator.receive([Command(step, np.full((1, 1), 1.0 + step)) for step in range(2)])
    for step in range(3):
        actuator.apply(step)
    echo = actuator.echo
    actuator.apply(2)  # once more
    assert actuator.echo == echo
    actuator.apply(1)
    assert actuator.echo.missing == echo.missing + 1
    assert actuator.echo.digest != echo.digest
