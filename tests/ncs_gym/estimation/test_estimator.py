import copy

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.networks import KINDS, gains_taken
from ncs_gym import Channel, ChannelContract, Ellipsoid, Packet, cart_pole, truck_trailer
from ncs_gym.ellipsoid import FLAT_INFLATION, quick_test
from ncs_gym.estimation.arrival_histories import histories_of
from ncs_gym.estimation.error_bound import ErrorSet, certified_error_set
from ncs_gym.estimation.estimator import Estimator
from ncs_gym.estimation.kalman_filter import (
    ErrorRecursion,
    SetMembership,
    enlarged_by_rounding,
    predicted_covariance,
    updated_covariance,
)
from ncs_gym.network.channel import GilbertElliott
from ncs_gym.network.packet_loss_and_delay import ChannelState
from shields.verification.rational_matrix import congruence, is_positive_semidefinite, rational, subtract
from tests.plants import random_plant
from tests.product import altered, library_plant, linear_plant, sampled_plant

# So fine that rounding of covariances and shapes does not show.
FINE = {"covariance_bits": 45, "shape_step": 2.0**-45}


def roomy(plant, factor=1e4):
    """An error set so large that the guard accepts every Kalman update."""
    errors = certified_error_set(plant)
    return ErrorSet(shapes=np.array([factor * errors.Sigma]), rates=np.array([errors.rates[-1]]))


def sets_of(plant, channel=None):
    """What moves the shapes of an estimator."""
    return SetMembership(plant, (channel or Channel()).quantization_step, certified_error_set(plant))


def batch_estimate(plant, first, inputs, packets, noise_cov):
    """The last state's mean and covariance from the joint precision of all states: no recursion, no gains."""
    n, steps = plant.n, len(inputs)
    Q = plant.process_noise.covariance + plant.gamma * np.eye(n)
    precision = np.zeros((n * (steps + 1), n * (steps + 1)))
    vector = np.zeros(n * (steps + 1))
    start = np.linalg.inv(plant.initial_noise.covariance)
    precision[:n, :n] += start
    vector[:n] += start @ first
    Q_inverse, R_inverse = np.linalg.inv(Q), np.linalg.inv(noise_cov)
    for k, u in enumerate(inputs):
        rows = slice(n * k, n * (k + 2))
        difference = np.hstack([-plant.A, np.eye(n)])
        precision[rows, rows] += difference.T @ Q_inverse @ difference
        vector[rows] += difference.T @ Q_inverse @ (plant.B @ u)
    for stamp, y in packets:
        rows = slice(n * stamp, n * (stamp + 1))
        precision[rows, rows] += plant.H.T @ R_inverse @ plant.H
        vector[rows] += plant.H.T @ R_inverse @ y
    covariance = np.linalg.inv(precision)
    return (covariance @ vector)[-n:], covariance[-n:, -n:]


@pytest.mark.parametrize("p", [None, 1])
@pytest.mark.parametrize("seed", range(2))
def test_estimate_equals_batch_least_squares_with_late_and_reordered_packets(seed, p):
    plant = random_plant(seed, 3, 1, p)
    # Good sensors, so that every Kalman update also shrinks the hard ellipsoid and none is turned down.
    plant = altered(plant, measurement_noise_cov=1e-7 * np.eye(plant.p))
    channel = Channel(loss=0.3, quantization_step=0.001, delay=1, jitter=3)
    rng = np.random.default_rng(seed)
    estimator = Estimator(plant, channel, histories=histories_of(plant, channel, roomy(plant), **FINE))
    first = rng.standard_normal(3)
    estimator.reset(first)
    link, inputs, used = ChannelState(channel, rng), [], []
    # The samples are the truth's; the hard bound on them keeps the monitor silent.
    x = first + plant.initial_noise.sample(rng)
    for step in range(1, 31):
        inputs.append(rng.uniform(-1, 1, 1))
        x = plant.A @ x + plant.B @ inputs[-1] + plant.disturbance.sample(rng) * 0.3
        packets = link.exchange(rng, step, plant.H @ x + plant.sensor_noise.sample(rng))
        used += [(packet.stamp, packet.measurement) for packet in packets]
        estimator.advance(inputs[-1], packets)
        noise_cov = plant.sensor_noise.covariance + 0.001**2 / 12 * np.eye(plant.p)
        mean, covariance = batch_estimate(plant, first, inputs, used, noise_cov)
        np.testing.assert_allclose(estimator.mean, mean, atol=1e-9)
        np.testing.assert_allclose(estimator.covariance, covariance, atol=1e-10)


def drive(plant, channel, seed, steps, push):
    """Runs an estimator against a disturbance that pushes the error outwards; yields (estimator, true state)."""
    rng = np.random.default_rng(seed)
    estimator = Estimator(plant, channel)
    x = rng.uniform(-0.5, 0.5, plant.n)
    e0 = plant.initial_noise.bound.sample_boundary(rng)
    estimator.reset(x + e0)
    link = ChannelState(channel, rng)
    for step in range(1, steps + 1):
        u = rng.uniform(-1, 1, plant.m) * plant.largest_input
        e = estimator.mean - x
        d = -plant.disturbance.farthest_point(plant.A @ e, push(rng)) * (1 - 1e-12)
        x = plant.A @ x + plant.B @ u + d
        noise = plant.sensor_noise.bound.sample_boundary(rng) if link.sends_at(step) else None
        sample = None if noise is None else plant.H @ x + noise
        estimator.advance(u, link.exchange(rng, step, sample))
        yield estimator, x


CHANNELS = [
    Channel(loss=1.0),
    Channel(loss=0.3, quantization_step=0.05, send_period=2, delay=2),
    Channel(quantization_step=0.02, delay=1, jitter=4),
    Channel(loss=GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.2), send_period=1, jitter=2),
]


@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 4))])
def test_error_stays_in_its_running_ellipsoid_under_adversarial_noise(channel, seed):
    plant = random_plant(seed, 2 + seed % 3, 1, p=1 + seed % 2) if seed else truck_trailer(mass=4000.0)

    def push(rng):
        axis = rng.standard_normal(plant.n)
        return np.outer(axis, axis)

    Sigma = certified_error_set(plant).Sigma
    largest = 0.0
    for estimator, x in drive(plant, channel, seed, 70, push):
        shape = estimator.shape
        largest = max(largest, Ellipsoid(shape).gauge(estimator.mean - x))
        assert np.linalg.eigvalsh(Sigma - shape)[0] >= -1e-15
        assert not estimator.alarm
    assert 0.5 < largest <= 1.0


@pytest.mark.parametrize("channel", [Channel(), CHANNELS[1]])
def test_samples_are_used_however_wide_the_box_of_another_state_is(channel):
    """The trace-optimal gain counts in half-widths of the box, and would leave the set where one is very wide."""
    plant = sampled_plant(
        ([[-1.0, 10.0], [-2.0, -20.0]], [[0.0], [20.0]], [[1.0, 0.0]], [[0.0]]),
        dt=0.02, box=[5.0, np.inf], u_max=12.0,
        disturbance_bound=[0.02, 0.01], sensor_bound=0.02, initial_bound=[0.05, 0.05],
    )  # fmt: skip
    Sigma, ages, speeds, gauges = certified_error_set(plant).Sigma, [], [], []
    for estimator, x in drive(plant, channel, 0, 200, lambda rng: np.diag(rng.uniform(0.0, 1.0, 2))):
        shape = estimator.shape
        ages.append(estimator.age)
        speeds.append(np.sqrt(shape[0, 0]))
        gauges.append(Ellipsoid(shape).gauge(estimator.mean - x))
        assert np.linalg.eigvalsh(Sigma - shape)[0] >= -1e-15
        assert not estimator.alarm
    assert 0.5 < max(gauges) <= 1.0
    assert np.mean(ages) < (0.01 if channel == Channel() else 4.0)  # every one that arrives
    assert np.mean(speeds) < (0.1 if channel == Channel() else 0.4) * np.sqrt(Sigma[0, 0])


def test_an_update_may_enlarge_what_later_steps_shrink():
    """Where the trace decided at the step of the sample, late ones were skipped: 1.48 in place of .22."""
    plant = linear_plant(
        A=[[0.02, 0.63], [-1.1, -0.07]], B=[[1.0], [1.0]], H=[[0.05, 1.4]], box=[0.5, 650.0], u_max=1.0, dt=0.1,
        disturbance_bound=[0.076, 0.001], sensor_bound=[0.007], initial_bound=[0.8, 0.2],
    )  # fmt: skip
    estimator, traces = Estimator(plant, Channel(delay=1)), []
    estimator.reset(np.zeros(2))
    for step in range(1, 201):
        estimator.advance(np.zeros(1), [Packet(step - 1, np.zeros(1))] if step > 1 else [])
        traces.append(np.vdot(plant.weight, estimator.shape))
        assert estimator.age == 1
    assert np.mean(traces[100:]) < 0.05 * np.vdot(plant.weight, certified_error_set(plant).Sigma)


def test_under_a_contract_the_certified_gain_comes_before_the_way_back_so_that_shapes_recur():
    env = gym.make("ncs_gym/BatchReactor-v0").unwrapped
    recursion = ErrorRecursion(env.plant, 0.0, env.error_set)
    known = recursion.first
    for _ in range(30):
        _, known = recursion.updated(recursion.predicted(known))
        assert known.certified
    np.testing.assert_array_equal(known.shape, env.error_set.shape_at(0))


def test_two_sensors_that_contradict_each_other_raise_the_alarm_where_one_of_them_says_what_was_predicted():
    """So exact, and so alike, that no inverse vouches for a residual: infinite weights times zero are no number."""
    settings = {"disturbance_bound": 0.1, "sensor_bound": 1e-9, "initial_bound": 0.1}
    plant = linear_plant(A=[[0.5]], B=[[1.0]], H=[[1.0], [1.0]], box=[1.0], u_max=1.0, dt=0.1, **settings)
    for off, alarm in ((0.0, False), (0.01, True)):
        estimator = Estimator(plant, Channel())
        estimator.reset(np.zeros(1))
        estimator.advance(np.zeros(1), [Packet(1, np.array([0.0, off]))])
        assert estimator.alarm is alarm


def test_innovation_at_the_edge_of_both_bounds_is_no_alarm():
    # The test against E(H Sigma H' + N) would raise it; the exact Minkowski test must not.
    plant = truck_trailer()
    prior = Estimator(plant, Channel())
    prior.advance(np.zeros(1), [])
    spread = Ellipsoid(plant.H @ prior.shape @ plant.H.T)
    direction = np.array([1.0, 0.3])
    noise = Ellipsoid(sets_of(plant).noise)
    edge = spread.extreme_point(direction) + noise.extreme_point(direction)
    naive = Ellipsoid(spread.shape_matrix + noise.shape_matrix)
    assert not naive.contains(edge)
    for residual, alarm in ((edge, False), (1.001 * edge, True)):
        estimator = Estimator(plant, Channel())
        estimator.advance(np.zeros(1), [Packet(1, plant.H @ prior.mean + residual)])
        assert estimator.alarm is alarm


@given(st.integers(0, 10_000))
@settings(max_examples=6, deadline=None)
def test_a_packet_never_leaves_a_larger_ellipsoid_than_ignoring_it(seed):
    plant = random_plant(seed, 2, 1, p=1)
    rng = np.random.default_rng(seed)
    estimator = Estimator(plant, Channel(delay=6))
    for step in range(1, 20):
        u = rng.uniform(-1, 1, 1)
        stamp = int(rng.integers(max(1, step - 5), step + 1))
        ignoring = copy.deepcopy(estimator)
        estimator.advance(u, [Packet(stamp, np.zeros(1))])
        ignoring.advance(u, [])
        assert np.vdot(plant.weight, estimator.shape) <= np.vdot(plant.weight, ignoring.shape)


def test_computed_shapes_hold_the_exact_ones():
    # In a thin tilted box rounding is large against the thin direction; the enlargement must cover it exactly.
    angle = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    for aspect in (1.0, 1e3, 1e5):
        T = angle @ np.diag([1.0, 1.0 / aspect])
        A = T @ np.array([[0.8, 0.1], [-0.05, 0.7]]) @ np.linalg.inv(T)
        shape = T @ T.T
        shape = 0.5 * (shape + shape.T)
        grown = enlarged_by_rounding(A @ shape @ A.T, np.abs(A) @ np.sqrt(np.diag(shape)))
        exact = congruence(rational(A), rational(shape))
        assert is_positive_semidefinite(subtract(rational(grown), exact))
        if aspect <= 1e3:  # ... and no more than that
            assert np.trace(grown) <= np.trace(A @ shape @ A.T) * (1 + 1e-7)


@pytest.mark.parametrize("age", [0, 2, 4])
def test_a_shape_outside_the_certified_one_of_its_age_is_not_brought_back_by_a_prediction(age):
    """After an outage longer than the contract an estimate may be as new as it promises and as wrong as before."""
    plant = cart_pole()
    sets = SetMembership(plant, 0.0, certified_error_set(plant, ChannelContract(4)))
    certified, rng = sets.error_set.shape_at(age), np.random.default_rng(age)
    for _ in range(20):
        outwards = np.linalg.cholesky(certified) @ rng.standard_normal(plant.n)
        shape = 0.5 * certified + 4.0 * np.outer(outwards, outwards)  # smaller in other directions
        exact = congruence(rational(plant.A), rational(shape))
        assert is_positive_semidefinite(subtract(rational(sets.predicted(shape, age)), exact))


@pytest.mark.parametrize("size", [1.0, 2.0**10, 2.0**20])
def test_a_long_thin_shape_is_moved_without_loss(size):
    settings = {"u_max": 1.0, "dt": 0.1, "disturbance_bound": 0.0, "sensor_bound": 0.0, "initial_bound": 0.0}
    plant = linear_plant(A=[[0.9, -0.45], [0.45, -0.225]], B=np.ones((2, 1)), box=np.eye(2), **settings)
    sets = SetMembership(
        plant, 0.0, ErrorSet(shapes=np.array([1e2 * np.eye(2)]), rates=np.array([0.9])), shape_step=2.0**-90
    )
    rng = np.random.default_rng(0)
    for _ in range(60):
        long = (size * rng.uniform(0.5, 1.0)) ** 2 * np.array([[1.0, 2.0], [2.0, 4.0]])  # which A annihilates
        shape = long + 10.0 ** rng.uniform(-2, 0) * np.array([[1.0, -0.5], [-0.5, 0.25]])
        exact = congruence(rational(plant.A), rational(shape))
        assert is_positive_semidefinite(subtract(rational(sets.predicted(shape, 0)), exact))


def test_a_shape_that_outgrows_the_states_themselves_becomes_one_around_all_their_differences():
    settings = {"u_max": 1.0, "dt": 0.1, "disturbance_bound": 0.0, "sensor_bound": 0.0, "initial_bound": 0.0}
    plant = linear_plant(A=np.diag([1.5, 1.1]), B=np.ones((2, 1)), box=[1.0, 3.0], **settings)
    sets = SetMembership(plant, 0.0, ErrorSet(shapes=np.array([np.eye(2)]), rates=np.array([0.5])))
    farthest = 2.0 * plant.state_limit  # between states at opposite ends of where a simulation stops them
    for grown in (np.diag([9.0 * farthest[0] ** 2, 1.0]), np.diag([1.0, 9.0 * farthest[1] ** 2])):
        shape = sets.predicted(grown, 0)
        assert Ellipsoid(shape).gauge(farthest) == pytest.approx(1.0)
        np.testing.assert_array_equal(sets.predicted(shape, 0), shape)
    within = np.diag((0.5 * farthest) ** 2)
    assert np.diag(sets.predicted(within, 0)) == pytest.approx([1.5**2, 1.1**2] * np.diag(within), rel=1e-2)


@pytest.mark.parametrize("size", [1e-6, 1e3])
def test_rounded_shapes_are_no_smaller_where_the_certified_set_is_ill_conditioned(size):
    """Coordinates of its unit ball and back are not the identity: the inverse of its factor has entries of 2^(n-2)."""
    n, rng = 44, np.random.default_rng(0)
    factor = np.eye(n) - np.tril(np.ones((n, n)), -1)
    plant = linear_plant(A=0.5 * np.eye(n), B=np.ones((n, 1)), box=np.eye(n), u_max=1.0, dt=0.1, gamma=1e-6)
    sets = SetMembership(plant, 0.0, ErrorSet(shapes=np.array([factor @ factor.T]), rates=np.array([0.5])))
    for root in rng.standard_normal((8, n, n)):
        shape = size * factor @ root @ root.T @ factor.T
        shape = 0.5 * (shape + shape.T)
        assert np.linalg.eigvalsh(sets.rounded_up(shape) - shape)[0] > 0.0


@pytest.mark.parametrize("size", [1e-3, 1.0])
@pytest.mark.parametrize("p", [None, 1, 2])
def test_set_membership_gain_leaves_the_smallest_ellipsoid(p, size):
    plant = random_plant(2, 3, 1, p)
    sets = sets_of(plant, Channel(quantization_step=0.01))
    shape, N, H = size * sets.error_set.Sigma, sets.noise, plant.H

    def left(gain):
        """Size of what an update leaves, with the best share for this gain."""
        kept = np.eye(3) - gain @ H
        first, second = kept @ shape @ kept.T, gain @ N @ gain.T
        return (np.sqrt(np.vdot(plant.weight, first)) + np.sqrt(np.vdot(plant.weight, second))) ** 2

    others = [shape @ H.T / mu @ np.linalg.inv(H @ shape @ H.T / mu + N / (1 - mu)) for mu in np.linspace(0.005, 0.995)]
    found = left(sets.gain(shape))
    assert found <= min(map(left, others)) * (1 + 1e-2)
    assert found < 0.95 * max(map(left, others))


@pytest.mark.parametrize("plant", [truck_trailer(), cart_pole()])
def test_covariances_and_gains_are_those_of_filterpy(plant):
    estimator = Estimator(plant, Channel(quantization_step=0.01), certified_error_set(plant, ChannelContract(3, 0.01)))
    estimator.reset(0.01 * np.ones(plant.n))
    u, y, theirs = 0.1 * plant.largest_input, 0.02 * np.ones(plant.p), estimator.as_filterpy()
    P = estimator.covariance
    theirs.predict(u)
    estimator.advance(u, [])
    np.testing.assert_allclose(theirs.x, estimator.mean, rtol=1e-12)
    P = predicted_covariance(P, plant.A, theirs.Q)
    np.testing.assert_allclose(theirs.P, P, rtol=1e-12)
    theirs.update(y)
    gain, P = updated_covariance(P, plant.H, theirs.R)
    np.testing.assert_allclose(theirs.K, gain, rtol=1e-9)
    np.testing.assert_allclose(theirs.P, P, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("perfect", [(True, True), (True, False)])
def test_perfect_sensors_get_a_little_noise_in_their_own_units(perfect):
    # Otherwise a filter that knows the state has a singular innovation covariance.
    plant = library_plant(
        truck_trailer, H=np.diag([2.0, 3.0]), measurement_noise_cov=np.diag(np.where(perfect, 0.0, 1e-4))
    )
    noise = ErrorRecursion(plant, 0.0, certified_error_set(plant)).R - plant.sensor_noise.covariance
    np.testing.assert_allclose(noise, FLAT_INFLATION * np.diag((plant.half_widths * [2.0, 3.0]) ** 2), rtol=1e-6)


@pytest.mark.parametrize("condition", [1e4, 1e12, 1e16])
def test_quick_test_passes_no_impossible_residual_however_ill_conditioned_the_bound_is(condition):
    rng = np.random.default_rng(0)
    plant = altered(truck_trailer(), measurement_noise_cov=np.eye(2))
    assumed, noise = sets_of(plant).noise, plant.sensor_noise.bound.shape_matrix
    passed = np.zeros(2, dtype=int)
    for _ in range(60):
        along = np.linalg.qr(rng.standard_normal((2, 2)))[0].T
        spread = condition * noise[0, 0] * np.outer(along[0], along[0])
        inverse = quick_test(spread, assumed)
        for share, times in ((0, 0.2), (1, 3.0)):  # across the long axis, where the noise alone decides
            residual = np.sqrt(noise[0, 0]) * (0.5 * np.sqrt(condition) * along[0] + times * along[1])
            passed[share] += residual @ inverse @ residual <= 1.0
    assert passed[1] == 0
    assert passed[0] == 60 or condition > 1e4  # what is not vouched for goes to the exact test


@pytest.mark.parametrize(("name", "kind"), [("TruckTrailer", "Kalman"), ("BatchReactor", "certified")])
def test_gain_taken_is_the_kalman_gain_on_the_trucks_and_almost_never_on_the_unstable_plants(name, kind):
    counts = gains_taken(f"ncs_gym/{name}-v0", episodes=1)
    assert set(counts) <= set(KINDS)
    assert sum(counts.values()) > 50
    assert counts[kind] >= (1.0 if kind == "Kalman" else 0.95) * sum(counts.values())
