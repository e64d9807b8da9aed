from dataclasses import replace
from fractions import Fraction

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import (
    Channel,
    ChannelContract,
    Ellipsoid,
    ErrorSetError,
    GilbertElliott,
    Packet,
    cart_pole,
    contract_of,
    truck_trailer,
)
from ncs_gym.ellipsoid import is_inside
from ncs_gym.estimation import kalman_filter
from ncs_gym.estimation.arrival_histories import histories_of
from ncs_gym.estimation.error_bound import certified_error_set, require_error_set
from ncs_gym.estimation.estimator import Estimator
from ncs_gym.estimation.kalman_filter import ErrorRecursion, ErrorStatistics, SetMembership
from ncs_gym.network.packet_loss_and_delay import ChannelState
from ncs_gym.plants.library import batch_reactor
from shields.verification.rational_matrix import (
    add,
    congruence,
    is_positive_semidefinite,
    multiply,
    rational,
    scale,
    subtract,
)
from tests.product import altered, linear_plant, loop_env

PLANTS = {
    "cart-pole": (cart_pole(), ChannelContract(4, 1e-4)),
    "cart-pole, position and angle": (cart_pole(full_state=False), ChannelContract(3)),
    "batch reactor": (batch_reactor(), ChannelContract(3, 1e-3)),
    "truck-trailer": (truck_trailer(), ChannelContract(5, 0.05)),
    "scalar": (linear_plant(A=[[1.2]], B=[[1.0]], box=[[1.0]], u_max=1.0, dt=0.1, gamma=1e-4), ChannelContract(0)),
}
CHANNELS = [
    Channel(loss=0.5, max_consecutive_losses=2),
    Channel(loss=1.0, max_consecutive_losses=1, send_period=3),
    Channel(loss=GilbertElliott(p_good_to_bad=0.3, p_bad_to_good=0.1), max_consecutive_losses=3, delay=1, jitter=2),
    Channel(delay=4),
    Channel(loss=0.7, max_consecutive_losses=1, send_period=2, jitter=3),
]


@pytest.mark.parametrize("channel", CHANNELS)
def test_channel_keeps_the_contract_derived_from_it_and_no_better_one(channel):
    # By another route: the newest sample that has arrived, counted packet by packet.
    contract, rng = contract_of(channel), np.random.default_rng(0)
    link, newest, oldest = ChannelState(channel, rng), 0, 0
    for step in range(1, 2_000):
        sample = np.zeros(1) if link.sends_at(step) else None
        newest = max([newest, *(packet.stamp for packet in link.exchange(rng, step, sample))])
        oldest = max(oldest, step - newest)
    assert oldest == contract.max_age


def test_channel_that_may_lose_for_ever_promises_nothing():
    assert contract_of(Channel(loss=0.1)) is None
    assert contract_of(Channel(loss=1.0)) is None
    assert contract_of(Channel(loss=GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.5))) is None
    assert contract_of(Channel(quantization_step=0.1)) == ChannelContract(0, 0.1)
    assert contract_of(Channel(loss=GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.5, loss_bad=0.0))).max_age == 0


def test_contract_knows_who_keeps_it():
    contract = ChannelContract(3, 0.01)
    assert contract.is_kept_by(Channel(loss=0.5, max_consecutive_losses=3))
    assert not contract.is_kept_by(Channel(loss=0.5, max_consecutive_losses=4))
    assert not contract.is_kept_by(Channel(quantization_step=0.02))
    assert not contract.is_kept_by(Channel(loss=0.5))


@pytest.mark.parametrize("name", PLANTS)
def test_error_sets_meet_their_conditions_exactly(name):
    plant, contract = PLANTS[name]
    sets = certified_error_set(plant, contract)
    A, H, D, N = (rational(matrix) for matrix in (plant.A, plant.H, plant.disturbance.shape_matrix, sets.noise))
    shapes = [rational(shape) for shape in sets.shapes]
    assert len(shapes) == contract.max_age + 2
    assert is_positive_semidefinite(subtract(shapes[0], rational(plant.initial_error.shape_matrix)))
    for j, rate in enumerate(map(Fraction, sets.rates)):
        grown = add(scale(1 / rate, congruence(A, shapes[j])), scale(1 / (1 - rate), D))
        assert is_positive_semidefinite(subtract(shapes[j + 1], grown))
    for j, (gain, mu) in enumerate(zip(sets.gains, map(Fraction, sets.multipliers), strict=True), start=1):
        T = rational(gain)
        kept = congruence(subtract(rational(np.eye(plant.n)), multiply(T, H)), shapes[j])
        updated = add(scale(1 / mu, kept), scale(1 / (1 - mu), congruence(T, N)))
        assert is_positive_semidefinite(subtract(shapes[0], updated))


def test_contract_makes_the_error_set_of_a_stable_plant_smaller():
    plant = truck_trailer(mass=4000.0)
    promised = certified_error_set(plant, ChannelContract(2))
    assert np.trace(promised.Sigma) < np.trace(certified_error_set(plant).Sigma)


def test_unstable_plant_needs_a_promise():
    assert loop_env(cart_pole(), Channel(delay=1)).contract == ChannelContract(1)
    assert loop_env(cart_pole(), Channel(loss=0.1), contract=ChannelContract(4)).contract == ChannelContract(4)
    assert loop_env(truck_trailer(), Channel()).contract is None


def test_update_falls_back_to_the_certified_gain_and_never_skips(monkeypatch):
    plant, contract = PLANTS["batch reactor"]
    channel = Channel(loss=0.5, max_consecutive_losses=3)
    histories = histories_of(plant, channel, certified_error_set(plant, contract))
    estimator, recursion = Estimator(plant, channel, histories=histories), histories.recursion
    # Bad gains: neither the Kalman nor the set-membership gain will do.
    monkeypatch.setattr(recursion.sets, "gain", lambda shape: np.full((4, 2), 50.0))
    rng, x = np.random.default_rng(0), 1e-4 * np.ones(4)
    estimator.reset(x.copy())
    monkeypatch.setattr(kalman_filter, "updated_covariance", lambda P, H, R: (np.full((4, 2), 50.0), P))
    link, used = ChannelState(channel, rng), 0
    for step in range(1, 100):  # the plant is unstable and not controlled; only the error matters here
        x = plant.A @ x + (1 - 1e-9) * plant.nominal_disturbance.sample_boundary(rng)
        packets = link.exchange(rng, step, plant.H @ x + (1 - 1e-9) * plant.sensor_noise.bound.sample_boundary(rng))
        estimator.advance(np.zeros(2), packets)
        used += estimator.age == 0
        assert is_inside(estimator.shape, (1 + 1e-12) * estimator.error_set.shape_at(estimator.age))
        assert Ellipsoid(estimator.shape).gauge(estimator.mean - x) <= 1.0
    assert used > 25


def test_breaking_the_contract_is_reported_when_it_happens():
    whole = gym.make("ncs_gym/CartPole-v0").unwrapped.channel
    env = gym.make("ncs_gym/CartPole-v0", channel=replace(whole, max_consecutive_losses=None, loss=1.0)).unwrapped
    env.reset(seed=0)
    for step in range(1, 12):
        info = env.step(np.zeros(env.plant.m))[4]
        assert info["contract_broken"] is (step > env.contract.max_age)


def test_a_long_outage_ends_no_episode_with_an_exception():
    settings = {"u_max": 1.0, "dt": 0.1, "gamma": 1e-4, "measurement_noise_cov": 1e-6 * np.eye(2)}
    plant = linear_plant(A=[[1.2]], B=[[1.0]], box=[[1.0]], H=[[1.0], [1.0]], **settings)
    estimator = Estimator(plant, Channel(), certified_error_set(plant, ChannelContract(2)))
    estimator.reset(np.zeros(1))
    for step in range(1, 160):
        estimator.advance(np.zeros(1), [] if step < 150 else [Packet(step, np.zeros(2))])
    assert np.isfinite(estimator.mean).all()


def test_prediction_falls_back_to_the_certified_set(monkeypatch):
    plant, contract = PLANTS["cart-pole"]
    sets = certified_error_set(plant, contract)
    membership = SetMembership(plant, 0.0, sets)
    monkeypatch.setattr(kalman_filter, "outer_sum", lambda first, second, weight: 1e3 * (first + second))
    monkeypatch.setattr(type(sets), "rate_at", lambda self, age: 1e-6)
    shape = membership.predicted(sets.shapes[1], 1)
    np.testing.assert_array_equal(shape, sets.shapes[2])
    outside = 2.0 * sets.shapes[1]  # a broken contract: no certified set applies
    assert not is_inside(membership.predicted(outside, 1), sets.shapes[2])


def test_certified_gain_proves_nothing_for_an_error_outside_the_certified_set(monkeypatch):
    plant, contract = PLANTS["batch reactor"]
    sets = certified_error_set(plant, contract)
    recursion = ErrorRecursion(plant, 0.0, sets)
    useless = np.full((4, 2), 50.0)
    monkeypatch.setattr(recursion, "_kalman_update", lambda covariance: None)
    monkeypatch.setattr(recursion.sets, "gain", lambda shape: useless)
    back = recursion.sets.on_the_way_back
    monkeypatch.setattr(
        recursion.sets, "on_the_way_back", lambda shape: (useless, recursion.sets.updated(shape, useless))
    )

    def updated(shape, age):
        return recursion.updated(ErrorStatistics(np.eye(4), shape, age, True))

    oldest = contract.max_age + 1
    for age in (1, oldest):
        gain, inside = updated(sets.shapes[age], age)
        np.testing.assert_array_equal(gain, sets.gains[age - 1])
        np.testing.assert_array_equal(inside.shape, sets.shapes[0])
        _, outside = updated(1.1 * sets.shapes[age], age)
        assert not is_inside(outside.shape, sets.shapes[0])
    gain, late = updated(sets.shapes[oldest], oldest + 9)  # the last set counts, whatever the age
    np.testing.assert_array_equal(gain, sets.gains[-1])
    assert late.certified
    np.testing.assert_array_equal(late.shape, sets.shapes[0])
    monkeypatch.setattr(recursion.sets, "on_the_way_back", back)
    gain, inside = updated(sets.shapes[oldest], oldest)  # also where the way back would lead inside: shapes recur
    np.testing.assert_array_equal(gain, sets.gains[-1])
    assert is_inside(inside.shape, sets.shapes[0])
    _, late = updated(1.1 * sets.shapes[oldest], oldest + 9)
    assert not late.certified
    assert not is_inside(late.shape, sets.shapes[0])


def test_sets_by_age_that_fail_a_condition_are_an_error():
    plant, contract = PLANTS["cart-pole"]
    plant = altered(plant, initial_cov=np.zeros((4, 4)))
    errors = certified_error_set(plant, contract)
    require_error_set(errors, plant)
    # The first set would hold no update, and the last not what the one before it moves into.
    for age, name in ((0, r"\(C2\)"), (contract.max_age + 1, r"\(C1\)")):
        shapes = errors.shapes.copy()
        shapes[age] *= 0.5
        with pytest.raises(ErrorSetError, match=name):
            require_error_set(replace(errors, shapes=shapes), plant)
    worse = altered(plant, initial_cov=np.eye(4))
    with pytest.raises(ErrorSetError, match=r"\(C0\)"):
        require_error_set(errors, worse)


def test_every_age_has_a_set_and_a_rate_of_its_own():
    errors = certified_error_set(*PLANTS["batch reactor"])
    rates = [errors.rate_at(age) for age in range(len(errors.rates))]
    assert rates == errors.rates.tolist()
    assert len(set(rates)) == len(rates)
    assert errors.shape_at(len(errors.shapes)) is None
