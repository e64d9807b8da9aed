"""Plans that are as long as is asked for: what passes, what is stored of it, and that a silent network uses it up."""

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import Channel, LinearPlant, NCSEnv, NCSVectorEnv, TraceChannel, truck_trailer
from shields import SafeLoop, SafetyFilter, SafetyShield, VectorSafetyShield
from shields.runtime.backup_plans.plan_search import completed
from shields.runtime.guarantee import ALARM, OUTSIDE_BOUND
from tests.certificates import certificate_of
from tests.shields.attacks.cases import case

LEAST, HORIZON = 7, 12
CART = case("cart-pole")
# Samples for thirty steps, then none for forty.
PAUSES = TraceChannel(trace=(0,) * 30 + (-1,) * 40)


def cart_filter(least, horizon):
    return SafetyFilter(CART.certificate, CART.plant, "lookahead", horizon, least)


def beliefs(count):
    """Estimates, error shapes and proposals all over the box."""
    rng, plant = np.random.default_rng(0), CART.plant
    estimates = rng.uniform(-0.7, 0.7, (count, plant.n)) * plant.half_widths
    proposals = rng.uniform(-1.0, 1.0, (count, plant.m)) * plant.u_max
    return estimates, rng.choice([0.2, 0.6, 1.0], count)[:, None, None] * CART.certificate.Sigma, proposals


def test_what_passes_leaves_enough_or_as_much_as_anything_that_is_tried():
    least = 30  # which costs some proposals, other than a few steps
    careful, free = cart_filter(least, 36), cart_filter(0, 36)
    estimates, shapes, proposals = beliefs(400)
    decided, usual = careful.decide_many(estimates, shapes, proposals), free.decide_many(estimates, shapes, proposals)
    lengths = np.count_nonzero(~np.isnan(decided.plan[..., 0]), axis=1)
    enough = lengths >= least
    assert 0.1 < enough.mean() < 0.9
    # Nothing is refused to somebody who asks for no steps in order to keep what cannot be kept.
    assert (decided.proved == usual.proved).all()
    passes = enough & ~decided.intervened
    assert 20 < np.count_nonzero(passes) < np.count_nonzero(~usual.intervened)
    np.testing.assert_array_equal(decided.input[passes], proposals[passes])
    # K x_hat and what follows from it is one of the plans that are tried.
    test, nothing = careful.lookahead.planner.test, np.full((400, 1, 36, CART.plant.m), np.nan)
    held = completed(CART.plant, CART.certificate.fallback, estimates, nothing, CART.certificate.K[None])
    certified = test.certified(estimates, test.tightenings_of(shapes), held)[:, 0]
    left = np.where(certified.any(axis=1), 35 - certified[:, ::-1].argmax(axis=1), 0)
    assert (np.minimum(lengths, least) >= np.minimum(left, least)).all()
    assert (left > 0).any()


@pytest.mark.parametrize("is_vector", [False, True], ids=["scalar", "vector"])
def test_silence_uses_them_up_one_by_one_and_samples_bring_them_back(is_vector):
    settings = {"plant": CART.plant, "channel": PAUSES, "contract": CART.contract, "disturbance": "adversarial"}
    given = {"mode": "lookahead", "horizon": HORIZON, "least_safe_steps": LEAST, "on_unproved": "ignore"}
    if is_vector:
        env = VectorSafetyShield(NCSVectorEnv(3, **settings), CART.certificate, **given)
    else:
        env = SafetyShield(gym.make("ncs_gym/LinearNCS-v0", **settings), CART.certificate, **given)
    rng, m = np.random.default_rng(0), CART.plant.m
    _, info = env.reset(seed=1)
    before, falls, rises, lost = info["shield_safe_steps"], 0, 0, 0
    assert np.all(np.asarray(before) == LEAST)
    for _ in range(250):
        actions = rng.uniform(-1.0, 1.0, (3, m) if is_vector else m).astype(np.float32)
        *_, info = env.step(actions)
        now = info["shield_safe_steps"]
        assert np.all(now >= np.asarray(before) - 1)
        assert np.all(info["shield_plan_length"] >= now)
        falls, rises = falls + np.count_nonzero(now < before), rises + np.count_nonzero(now > before)
        reasons, kept = np.atleast_1d(info["shield_reason"]), np.atleast_1d(now) > 0
        for reason, proved, is_kept in zip(reasons, np.atleast_1d(info["shield_guaranteed"]), kept, strict=True):
            assert (reason == "") == proved
            assert reason.endswith("kept for as many steps as shield_safe_steps says") == (is_kept and not proved)
        lost += np.count_nonzero(~np.asarray(info["shield_guaranteed"]) & (np.asarray(now) > 0))
        before = now
    assert falls > LEAST
    assert rises > 1
    assert lost > LEAST  # the box is kept where the contract is broken


def test_a_loop_prints_for_how_long_the_box_is_kept():
    loop = SafeLoop(CART.certificate, CART.plant, Channel(delay=1), "lookahead", least_safe_steps=5)
    loop.start(np.zeros(CART.plant.n), initial_set=np.zeros(CART.plant.n))
    assert loop.safe_steps == 5
    assert "in silence" in str(loop)
    assert "the box is kept for 5 steps at least" in " ".join(str(loop).split())
    assert "in silence" not in str(SafeLoop(CART.certificate, CART.plant, Channel(delay=1), "lookahead"))


@pytest.mark.parametrize("broken", [ALARM, OUTSIDE_BOUND])
def test_nothing_is_promised_on_bounds_that_a_measurement_or_the_simulation_contradicts(broken):
    plant = truck_trailer(mass=4000.0, delta=0.97)
    settings = {"noise": "gaussian"} if broken == ALARM else {
        "disturbance": lambda rng, plant, nominal: 40.0 * plant.disturbance.sample_boundary(rng),
        "allow_assumption_violation": True,
    }  # fmt: skip
    env = SafetyShield(
        NCSEnv(plant, Channel(), **settings), certificate_of(plant),
        mode="lookahead", least_safe_steps=3, on_unproved="ignore",
    )  # fmt: skip
    _, info = env.reset(seed=0)
    assert info["shield_safe_steps"] == 3
    for _ in range(30):
        *_, info = env.step(np.zeros(1, np.float32))
        assert info["shield_safe_steps"] == 0 or info["shield_reason"] != broken
    assert info["shield_reason"] == broken


@pytest.mark.parametrize("is_vector", [False, True], ids=["scalar", "vector"])
def test_nothing_is_promised_while_the_state_is_outside_the_box_though_a_plan_leads_back(is_vector):
    plant = LinearPlant(
        A=0.5 * np.eye(2), B=[[0.0], [0.3]], box=1.0, u_max=1.0, dt=0.1,
        disturbance_bound=0.05, sensor_bound=0.01, initial_bound=0.02,
    )  # fmt: skip
    given = {"mode": "lookahead", "least_safe_steps": 3, "on_unproved": "ignore"}
    start, action = np.array([1.2, 0.0]), np.zeros(1, np.float32)
    if is_vector:
        shield = VectorSafetyShield(NCSVectorEnv(2, plant=plant, channel=Channel()), **given)
        start, action = np.array([0.5 * start, start]), np.array([action, action])
    else:
        shield = SafetyShield(NCSEnv(plant=plant, channel=Channel()), **given)
    _, info = shield.reset(seed=0, options={"state": start})
    assert np.all(info["shield_plan_length"] == 4)
    np.testing.assert_array_equal(info["shield_safe_steps"], [3, 0] if is_vector else 0)
    *_, info = shield.step(action)
    assert np.all(info["shield_safe_steps"] == 3)


@pytest.mark.parametrize("least", [0, LEAST])
@pytest.mark.parametrize("wrong", [np.nan, 1e3], ids=["a gap", "beyond the limits"])
def test_what_is_no_plan_counts_as_none_of_many_loops_too(least, wrong):
    made, plant = cart_filter(least, HORIZON), CART.plant
    lost = np.full((2, plant.n), 10.0) * plant.half_widths  # no plan is found
    proposals, stored = np.array([[np.nan], [0.0]]), np.full((2, HORIZON, plant.m), np.nan)
    stored[:, :4] = 0.1 * plant.u_max
    decided = made.decide_many(lost, CART.certificate.Sigma, proposals, stored)
    np.testing.assert_array_equal(decided.reason, "stored")
    stored[:, 0] = wrong
    decided = made.decide_many(lost, CART.certificate.Sigma, proposals, stored)
    alone = [
        made.decide(x, CART.certificate.Sigma, u, plan) for x, u, plan in zip(lost, proposals, stored, strict=True)
    ]
    assert [*decided.reason] == [each.reason for each in alone] == ["invalid", "fallback"]
    np.testing.assert_array_equal(decided.input, [each.input for each in alone])
    assert np.isnan(decided.plan).all()


def test_numbers_of_numpy_are_those_of_a_spec():
    counts = {"least_safe_steps": np.int64(3), "horizon": np.int64(6)}
    env = SafetyShield(gym.make("ncs_gym/TruckTrailerCruise-v0"), mode="lookahead", **counts)
    made = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert (made.get_wrapper_attr("least_safe_steps"), made.get_wrapper_attr("horizon")) == (3, 6)


def test_horizon_is_long_enough_by_itself():
    made = SafetyFilter(certificate_of(CART.plant, CART.contract), CART.plant, "lookahead", least_safe_steps=9)
    assert (made.horizon, made.least_safe_steps) == (10, 9)
