"""Tries to drive a shielded plant out of its safe set; see `tests/shields/attacks/extremes.py` for what is tried."""

import gymnasium as gym
import numpy as np
import pytest
from scipy.optimize import differential_evolution

from ncs_gym import truck_trailer
from shields import SafetyFilter, SafetyShield
from tests.certificates import certificate_of
from tests.shields.attacks.extremes import (
    CHANNELS,
    POLICIES,
    RANDOM,
    TRUCKS,
    ExtremalNoise,
    attack,
    harmful,
)

MODES = ("project", "switch", "boundary")
RANDOM_POLICIES = ("random", "outwards", "searching")
# Steps per episode in the ordinary suite and in the slow one.
TRUCK_STEPS, RANDOM_STEPS = (280, 2800), (200, 2000)


@pytest.mark.parametrize(("suite", "total"), [(0, 100_000), (1, 1_000_000)])
def test_the_attacks_take_as_many_steps_as_we_say(suite, total):
    trucks = len(TRUCKS) * len(POLICIES) * TRUCK_STEPS[suite]
    others = len(RANDOM) * len(RANDOM_POLICIES) * RANDOM_STEPS[suite]
    assert len(CHANNELS) * len(MODES) * (trucks + others) > total


def slow_second(values):
    return [values[0], pytest.param(values[1], marks=pytest.mark.slow)]


@pytest.mark.parametrize("steps", slow_second(TRUCK_STEPS))
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("name", TRUCKS)
def test_truck_trailer_never_leaves_its_safe_set(name, channel, mode, steps):
    plant = TRUCKS[name]
    for seed, policy in enumerate(POLICIES):
        disturbance = "adversarial" if policy == "random" else harmful(plant)
        level, error, _ = attack(plant, CHANNELS[channel], disturbance, mode, policy, seed + steps, steps)
        assert level <= 1.0
        assert error <= 1.0


@pytest.mark.parametrize("steps", slow_second(RANDOM_STEPS))
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("name", RANDOM)
def test_random_plants_with_partial_measurements_never_leave_their_safe_set(name, channel, mode, steps):
    plant = RANDOM[name]
    overridden = 0
    for seed, policy in enumerate(RANDOM_POLICIES):
        disturbance = "sphere" if policy == "random" else harmful(plant)
        level, error, count = attack(plant, CHANNELS[channel], disturbance, mode, policy, seed + steps, steps)
        assert level <= 1.0
        assert error <= 1.0
        overridden += count
    assert 0 < overridden < len(RANDOM_POLICIES) * steps  # both kinds of decisions were attacked


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("generations", slow_second((60, 1000)))
@pytest.mark.parametrize("name", ["4000 kg", "n=2 m=1 p=1", "n=3 m=2 p=1", "n=4 m=3 p=2"])
def test_no_search_over_state_error_disturbance_and_proposal_leaves_the_safe_set(name, generations, mode):
    # Gradient-free, the decision as a black box: x in S, e in E(Sigma_k), d in E(D), any proposal, any Sigma_k.
    plant = (TRUCKS | RANDOM)[name]
    certificate, n = certificate_of(plant), plant.n
    shield = SafetyFilter(certificate, plant, mode)
    inside = [certificate.safe_set.factor, certificate.error_set.factor, plant.disturbance.factor]

    def levels(numbers):  # of many candidates, one per column
        balls = numbers[: 3 * n].reshape(3, n, -1)
        balls = balls / np.maximum(np.linalg.norm(balls, axis=1, keepdims=True), 1.0)
        size = numbers[-1]
        x, e, d = (factor @ ball for factor, ball in zip(inside, balls, strict=True))
        errors = shield.errors_of_many(size[:, None, None] ** 2 * certificate.Sigma)
        u = shield.decide_columns(x + size * e, errors, plant.u_max[:, None] * numbers[3 * n : -1]).input
        reached = plant.A @ x + plant.B @ u + d
        return -np.sqrt(np.einsum("ik,ij,jk->k", reached, certificate.M, reached))

    bounds = [(-1.0, 1.0)] * (3 * n + plant.m) + [(1e-3, 1.0)]
    settings = {"maxiter": generations, "popsize": 8, "rng": 0, "polish": False, "tol": 0.0}
    found = differential_evolution(levels, bounds, vectorized=True, updating="deferred", **settings)
    assert -found.fun <= 1.0
    assert -found.fun > (0.5 if mode == "boundary" else 0.9)  # the search does come close


@pytest.mark.parametrize("name", [*TRUCKS, *RANDOM])
def test_no_ascent_over_state_error_and_disturbance_leaves_the_safe_set_under_the_gain(name):
    # (I) by another route: coordinate ascent from many starts, the input rounded as it is applied.
    plant = (TRUCKS | RANDOM)[name]
    certificate = certificate_of(plant)
    shield, rng = SafetyFilter(certificate, plant), np.random.default_rng(0)
    closed, gain = plant.A + plant.B @ certificate.K, plant.B @ certificate.K
    safe, errors, M = certificate.safe_set, certificate.error_set, certificate.M
    shares = certificate.multipliers
    reach = (
        closed @ certificate.L @ closed.T / shares.state
        + gain @ certificate.Sigma @ gain.T / shares.estimate
        + certificate.D / shares.disturbance
    )
    worst, bound = 0.0, np.sqrt(np.linalg.eigvals(M @ reach).real.max())
    for _ in range(60):
        slope = rng.standard_normal(plant.n)
        for _ in range(40):
            x, e, d = (
                safe.extreme_point(closed.T @ slope),
                errors.extreme_point(gain.T @ slope),
                plant.disturbance.extreme_point(slope),
            )
            slope = M @ (closed @ x + gain @ e + d)
        u = shield.fallback_input(x + e)
        assert (np.abs(u) <= plant.u_max).all()
        worst = max(worst, safe.gauge(plant.A @ x + plant.B @ u + d))
    assert worst <= bound + 1e-7  # `bound` leaves the rounding of actions out
    assert worst > 0.9 * bound
    assert bound <= 1.0


def test_the_attack_is_strong_enough_to_come_close():
    # Otherwise the tests above would prove nothing: it reaches the edge of S and of the error ellipsoid ...
    plant = TRUCKS["4000 kg"]
    level, error, interventions = attack(plant, CHANNELS["blackout"], harmful(plant), "project", "outwards", 0, 1000)
    assert level > 0.98
    assert error > 0.8
    assert interventions > 300


def test_the_same_attack_leaves_the_safe_set_without_a_shield():
    # ... and breaks the bare plant at once.
    plant = TRUCKS["4000 kg"]
    certificate = certificate_of(plant)
    env = ExtremalNoise(plant, disturbance=harmful(plant), initial_set=certificate.safe_set)
    _, info = env.reset(seed=0)
    push = plant.B.T @ certificate.M @ plant.A
    levels = []
    for _ in range(50):
        *_, info = env.step(np.sign(push @ info["estimate"]).astype(np.float32))
        levels.append(certificate.safe_set.gauge(info["state"]))
    assert max(levels) > 1.5


@pytest.mark.parametrize("steps", slow_second((15_000, 250_000)))
@pytest.mark.parametrize("channel", ["perfect", "overtaking"])
@pytest.mark.parametrize("name", ["4000 kg", "4000 kg, position only"])
def test_extremal_noise_raises_no_false_alarm(name, channel, steps):
    env = ExtremalNoise(TRUCKS[name], CHANNELS[channel], disturbance="sphere")
    env.reset(seed=0)
    for action in np.random.default_rng(0).uniform(-1, 1, (steps, 1)):
        assert not env.step(action)[4]["assumption_violated"]
    assert env.smallest_noise() > 0.999


def test_long_shielded_run_through_the_registered_environment_has_no_violation():
    plant = truck_trailer(mass=4000.0)
    env = SafetyShield(gym.make("ncs_gym/TruckTrailerCruise-v0", disturbance="adversarial"), certificate_of(plant))
    rng = np.random.default_rng(0)
    for seed in range(10):
        env.reset(seed=seed)
        for _ in range(200):
            *_, info = env.step(rng.choice([-1.0, 1.0], 1).astype(np.float32))
        assert info["is_success"] == 1.0
