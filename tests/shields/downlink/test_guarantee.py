"""When a guarantee behind a downlink holds, when it ends and why; the first steps; the loop without Gymnasium."""

import numpy as np
import pytest

from ncs_gym import Actuator, Channel, Ellipsoid, cart_pole, truck_trailer
from ncs_gym.network.downlink import downlink_protocol
from ncs_gym.network.packet_loss_and_delay import ChannelState
from shields.runtime.guard import (
    EXPLANATIONS,
    FAR_OUT,
    LARGE_ERROR,
    LATE_INPUT,
    NOT_KNOWN_INSIDE,
    OLD_SAMPLE,
    OTHER_INPUT,
    GuaranteeMonitor,
)
from shields.runtime.starts import starts_known
from shields.verification.rational_matrix import (
    congruence,
    is_positive_semidefinite,
    multiply,
    quadratic,
    rational,
    subtract,
    transpose,
)
from tests.certificates import certificate_of, metric
from tests.product import (
    belief,
    linear_plant,
    loop_env,
    safe_loop,
    safety_filter,
    safety_shield,
    staying,
    vector_env,
    vector_shield,
)
from tests.shields.attacks.cases import behind
from tests.shields.edges import edge_of

PLANT = truck_trailer(mass=4000.0)
UPLINK = Channel(loss=0.3, quantization_step=0.05, send_period=2, delay=2)
KEPT = Channel(loss=0.4, delay=1, max_consecutive_losses=1)
THIN = np.array([[1.0, -0.5], [-0.5, 0.25]])
UNSTABLE = behind(cart_pole(), (Channel(loss=0.3, delay=1, max_consecutive_losses=1), Channel(delay=2)))


def shielded(mode="project", start=0.3, kind=loop_env, **settings):
    certificate = certificate_of(PLANT)
    usual = {"downlink": KEPT, "initial_set": Ellipsoid(start**2 * certificate.safe_set.shape_matrix)}
    env = kind(PLANT, UPLINK, **(usual | settings))
    return safety_shield(env, certificate, mode=mode)


def test_first_steps_are_known_exactly_where_they_can_leave_the_safe_set():
    shield, input_delay = shielded().filter, 3
    small, large = (Ellipsoid(scale**2 * shield.certificate.safe_set.shape_matrix) for scale in (0.3, 0.999999))
    assert all(known.in_safe_set for known in starts_known(shield, small, input_delay))
    known = starts_known(shield, large, input_delay)
    assert known[0].in_safe_set
    assert not all(each.in_safe_set for each in known)
    assert [each.in_safe_set for each in starts_known(shield, None, input_delay)] == [False] * 4


def test_a_given_start_is_followed_under_zero_input():
    plant, certificate, input_delay, rng = UNSTABLE.plant, UNSTABLE.certificate, 3, np.random.default_rng(0)
    shield, safe, root = (
        safety_filter(certificate, plant),
        certificate.safe_set,
        np.linalg.cholesky(metric(certificate)).T,
    )
    powers = [np.linalg.matrix_power(plant.A, k) for k in range(input_delay + 1)]
    spread = [np.linalg.norm(root @ power @ np.linalg.cholesky(plant.disturbance.shape_matrix), 2) for power in powers]
    entered = left = 0
    for _ in range(200):
        start = safe.sample_boundary(rng) * rng.uniform(0.7, 1.3)
        known = [each.in_safe_set for each in starts_known(shield, start, input_delay)]
        for k, power in enumerate(powers):
            level = safe.gauge(power @ start)
            assert not known[k] or level + max(spread[:k], default=0.0) <= 1.0
            assert known[k] or level + 1.2 * sum(spread[:k]) > 1.0
        entered += known[-1] and not known[0]
        left += known[0] and not known[-1]
    assert entered > 5
    assert left > 5


@pytest.mark.cases(1)
@pytest.mark.parametrize("count", [16, pytest.param(300, marks=pytest.mark.slow)])
@pytest.mark.parametrize("size", [1e11, 1.0, 1e7])
def test_a_start_however_far_out_is_known_to_move_into_the_safe_set_only_if_it_does(size, count):
    # Starts that A annihilates, but for the rounding of products of huge numbers.
    settings = {"u_max": 1.0, "dt": 0.1, "disturbance_bound": 1e-9, "sensor_bound": 0.0, "initial_bound": 0.0}
    plant = linear_plant(A=[[0.5, -0.3], [0.25, -0.15]], B=np.ones((2, 1)), box=np.eye(2), **settings)
    certificate, rng, known = certificate_of(plant), np.random.default_rng(0), 0
    shield, M = safety_filter(certificate, plant), rational(metric(certificate))
    *_, axes = np.linalg.svd(plant.A)
    for _ in range(count):
        base = axes[1] * size * rng.uniform(0.5, 1.0)
        way = edge_of(lambda x, base=base: starts_known(shield, base + x * axes[0], 1)[1].in_safe_set, 4.0)
        if way > 0.0:
            known += 1
            moved = multiply(rational(plant.A), rational((base + way * axes[0])[:, None]))
            assert quadratic(transpose(moved), M) <= 1
    assert known > count // 2


@pytest.mark.cases(1)
@pytest.mark.parametrize("count", [6, pytest.param(120, marks=pytest.mark.slow)])
@pytest.mark.parametrize("size", [2.0**20, 1.0, 2.0**10])
def test_starts_along_a_line_that_moves_into_the_safe_set_are_known_to_only_if_they_do(size, count):
    settings = {"u_max": 1.0, "dt": 0.1, "disturbance_bound": 1e-9, "sensor_bound": 0.0, "initial_bound": 0.0}
    plant = linear_plant(A=[[0.9, -0.45], [0.45, -0.225]], B=np.ones((2, 1)), box=np.eye(2), **settings)
    certificate, rng = certificate_of(plant), np.random.default_rng(0)
    shield, A, L = safety_filter(certificate, plant), rational(plant.A), rational(certificate.safe_set.shape_matrix)
    for _ in range(count):
        long = (size * rng.uniform(0.5, 1.0)) ** 2 * np.array([[1.0, 2.0], [2.0, 4.0]])  # which A annihilates
        width = edge_of(lambda x, long=long: starts_known(shield, Ellipsoid(long + x * THIN), 1)[1].in_safe_set, 16.0)
        assert width > 0.1
        assert is_positive_semidefinite(subtract(L, congruence(A, rational(long + width * THIN))))


@pytest.mark.parametrize("many", [False, True])
def test_first_plan_is_stored_for_the_state_at_which_the_first_input_takes_effect(many):
    certificate, rng, shape = UNSTABLE.certificate, np.random.default_rng(0), UNSTABLE.plant.A.shape
    settings = {"channel": UNSTABLE.uplink, "contract": UNSTABLE.contract, "downlink": UNSTABLE.downlink}
    if many:
        shield = vector_shield(vector_env(1, plant=UNSTABLE.plant, **settings), certificate, "lookahead")
    else:
        shield = safety_shield(loop_env(UNSTABLE.plant, **settings), certificate, "lookahead")
    stored = 0
    for seed in range(40):  # starts in S, some of which leave it in the two steps before any input
        start = certificate.safe_set.sample_boundary(rng) * rng.uniform(0.9, 1.0)
        now, *_, then = starts_known(shield.filter, start, 2)
        _, info = shield.reset(seed=seed, options={"state": start[None] if many else start})
        errors = shield.filter.errors_of(np.reshape(info["error_shape"], shape))
        seen = shield.filter.test.knows_inside(np.ravel(info["estimate"]), errors, 1e-9)
        assert now.in_safe_set
        if not then.in_safe_set and not seen:
            assert np.all(info["shield_guaranteed"] == (info["shield_plan_length"] > 0))
            stored += np.sum(info["shield_plan_length"] > 0)
    assert stored > 3


def test_a_start_outside_the_box_is_not_guaranteed_although_a_plan_is_certified_once_inputs_take_effect():
    shield = shielded("lookahead", downlink=Channel(delay=3))
    # Just outside, drifting back in.
    drifting = np.array([[1.001, -0.2], [-1.001, 0.2]]) * PLANT.half_widths
    for seed, start in enumerate(drifting):
        _, info = shield.reset(seed=seed, options={"state": start})
        assert info["cost"] == 1.0
        assert info["shield_reason"] == NOT_KNOWN_INSIDE
        assert shield.step(np.zeros(1))[4]["shield_guaranteed"]  # step 3 was known to be inside from the start


def test_what_is_predicted_must_be_nearer_than_what_is_observed_now():
    """The present estimate, which is not seen then, may be farther out than its prediction was: rounding counts it."""
    shield = safety_filter(certificate_of(PLANT), PLANT)
    errors = staying(shield.errors_of(0.1 * certificate_of(PLANT).Sigma))

    def reason(distance, downlink):
        monitor = GuaranteeMonitor(shield, downlink)
        return EXPLANATIONS[monitor.reasons(monitor.start(True, belief(distance * PLANT.half_widths), errors))]

    ideal, lately = downlink_protocol(None, None), shielded().unwrapped.downlink_protocol
    assert [reason(distance, ideal) for distance in (49.0, 51.0, 99.0, 101.0)] == ["", "", "", FAR_OUT]
    assert [reason(distance, lately) for distance in (49.0, 51.0)] == ["", FAR_OUT]


def test_a_large_error_is_put_down_to_old_samples_once_they_are_older_than_the_sensors_contract_allows():
    """The certificate counts the steps of both channels, the age of a sample those of its own alone."""
    shield = safety_filter(UNSTABLE.certificate, UNSTABLE.plant)
    monitor = GuaranteeMonitor(shield, downlink_protocol(UNSTABLE.downlink, None))
    n, allowed = UNSTABLE.plant.n, UNSTABLE.contract.max_age
    assert UNSTABLE.certificate.contract.max_age == allowed + 2
    largest = np.linalg.eigvalsh(UNSTABLE.certificate.error_shapes).max()
    state = monitor.start(True, belief(np.zeros(n)), shield.errors_of(1.01 * largest * np.eye(n)))
    found = [EXPLANATIONS[monitor.reasons(state, age)] for age in (allowed, allowed + 1)]
    assert found == [LARGE_ERROR, OLD_SAMPLE]


class Meddler:
    """Makes a loop say, where it is told to, that other inputs were committed or applied."""

    def __init__(self, env, key):
        self.key, self.active, self._report = key, False, env._now.report
        env._now.report = self

    def __call__(self, *given, **named):
        belief, info = self._report(*given, **named)
        said = getattr(belief, self.key) + 1e-12 * np.asarray(self.active)
        return belief._replace(**{self.key: said}), info


@pytest.mark.parametrize(("key", "reason"), [("committed", OTHER_INPUT), ("applied", LATE_INPUT)])
def test_other_inputs_than_decided_end_the_guarantee(key, reason):
    certificate = certificate_of(PLANT)
    inner = loop_env(PLANT, UPLINK, initial_set=Ellipsoid(0.09 * certificate.safe_set.shape_matrix), downlink=KEPT)
    meddler, shield = Meddler(inner, key), safety_shield(inner, certificate)
    shield.reset(seed=0)
    for _ in range(5):
        assert shield.step(np.array([0.2]))[4]["shield_guaranteed"]
    meddler.active = True
    assert shield.step(np.array([0.2]))[4]["shield_reason"] == reason
    meddler.active = False
    assert shield.step(np.array([0.2]))[4]["shield_reason"] == reason  # for the rest of the episode
    shield.reset()
    assert shield.step(np.array([0.2]))[4]["shield_guaranteed"]


def test_late_inputs_drop_the_plans_of_their_own_environments_in_a_vector():
    settings = {"channel": UNSTABLE.uplink, "contract": UNSTABLE.contract, "downlink": UNSTABLE.downlink}
    env = vector_env(6, plant=UNSTABLE.plant, **settings)
    meddler, chosen = Meddler(env, "applied"), np.arange(6) % 2 == 0
    shield, rng, kept = vector_shield(env, UNSTABLE.certificate, "lookahead"), np.random.default_rng(0), 0
    for seed in range(5):
        meddler.active = False
        shield.reset(seed=seed, options={"state": UNSTABLE.certificate.safe_set.sample_boundary(rng, 6)})
        meddler.active = chosen
        *_, info = shield.step(np.ones((6, 1), np.float32))
        assert set(info["shield_reason"][chosen]) == {LATE_INPUT}
        assert not info["shield_plan_length"][chosen].any()
        kept += np.count_nonzero(info["shield_plan_length"][~chosen])
    assert kept > 3


def test_safe_loop_speaks_the_protocol():
    """A plain loop with an actuator, to which every input comes c steps after it was decided."""
    certificate, rng = certificate_of(PLANT), np.random.default_rng(0)
    downlink = Channel(loss=0.5, jitter=3, max_consecutive_losses=2)
    loop = safe_loop(certificate, PLANT, UPLINK, downlink=downlink)
    actuator = Actuator(loop.input_delay, PLANT.m)
    up, down = ChannelState(UPLINK, rng), ChannelState(downlink, rng)
    state = 0.2 * Ellipsoid(certificate.safe_set.shape_matrix).sample_boundary(rng)
    loop.start(state + PLANT.of_first_error.drawn(rng))
    actuator.start(loop.episode)
    packets, applied, scheduled, worst = [], None, [np.zeros(1)] * loop.input_delay, 0.0
    for step in range(200):
        loop.receive(packets, applied)
        assert loop.guaranteed
        worst = max(worst, certificate.safe_set.gauge(state))
        scheduled.append(loop.decide(rng.uniform(-4, 4, 1)).input)
        command = loop.command()
        assert command.inputs.shape == (loop.input_delay + 1, 1)
        actuator.receive(down.carry(rng, step, command))
        applied = actuator.apply(step)
        np.testing.assert_array_equal(applied, scheduled[step])
        state = PLANT.A @ state + PLANT.B @ applied + PLANT.disturbance.sample_boundary(rng)
        sample = PLANT.H @ state + PLANT.of_sensor.drawn(rng) if up.sends_at(step + 1) else None
        packets = up.exchange(rng, step + 1, sample, loop.episode)
    assert 0.8 < worst <= 1.0
