"""What is stored and proved where nothing else would show a mistake: restarts, starts in the box, other inputs."""

import numpy as np
import pytest

from ncs_gym import Ellipsoid, truck_trailer
from shields.runtime.guard import NOT_KNOWN_INSIDE, OTHER_INPUT
from shields.runtime.starts import starts_in_box
from tests.certificates import certificate_of
from tests.product import loop_env, safe_loop, safety_filter, safety_shield, vector_env, vector_shield
from tests.shields.attacks.cases import box_ellipsoid, case, plan_case

COUNT = 6


@pytest.fixture
def many():
    """Six reactors behind lookahead, with starts anywhere in an ellipsoid of nearly the size of the box."""
    plant, horizon, network, contract = plan_case("batch reactor", "overtaking")
    start = {"initial_set": box_ellipsoid(plant, 0.95), "disturbance": "adversarial"}
    env = vector_env(COUNT, plant=plant, channel=network, contract=contract, **start)
    return vector_shield(env, certificate_of(plant, contract), "lookahead", horizon=horizon)


def test_a_restart_before_the_first_step_drops_the_plan_of_the_start_and_no_other(many):
    rng, dropped, n = np.random.default_rng(0), 0, 4
    for seed in range(8):
        _, first = many.reset(seed=seed, options={"state": rng.uniform(-0.9, 0.9, (COUNT, n))})
        again = rng.permutation(COUNT) < COUNT // 2
        _, info = many.reset(options={"state": np.zeros((COUNT, n)), "reset_mask": again})
        assert (info["shield_plan_length"][again] == 0).all()
        assert info["shield_guaranteed"][again].all()
        for key in ("shield_plan_length", "shield_guaranteed"):
            np.testing.assert_array_equal(info[key][~again], first[key][~again])
        dropped += np.count_nonzero(first["shield_plan_length"][again])
    assert dropped > 5


@pytest.mark.parametrize("goes_on", ["step", "reset"])
def test_a_step_without_the_guard_drops_every_plan(many, goes_on):
    push, n, m = np.ones((COUNT, 2), np.float32), 4, 2
    _, info = many.reset(seed=0, options={"state": np.random.default_rng(0).uniform(-0.9, 0.9, (COUNT, n))})
    assert info["shield_plan_length"].any()
    env = many.unwrapped
    env._now.move(env.np_random, np.zeros((m, COUNT)))
    untouched = np.ones(COUNT, np.bool_)
    if goes_on == "step":
        *_, info = many.step(push)
    else:
        untouched[0] = False
        _, info = many.reset(options={"reset_mask": ~untouched})
    assert not info["shield_plan_length"][untouched].any()
    assert not info["shield_guaranteed"][untouched].any()


def test_a_start_in_the_box_is_decided_to_the_last_digit():
    plant = plan_case("batch reactor", "overtaking")[0]
    row = plant.box[2] / np.linalg.norm(plant.box[2])
    inward, outward = 1.0 - 1e-9, 1.0 + 1e-9
    for scale, inside in ((inward, True), (outward, False)):
        reached = scale / abs(plant.box[2] @ row)
        assert starts_in_box(plant, reached * row) is inside
        shape = np.diag(np.full(plant.n, 1e-4)) + (reached**2 - 1e-4) * np.outer(row, row)
        assert Ellipsoid(shape).support(plant.box[2]) == pytest.approx(scale, abs=1e-12)
        assert starts_in_box(plant, Ellipsoid(shape)) is inside
    # On a face, where products with rows do not round.
    assert starts_in_box(truck_trailer(), np.array([2.0, -2.0]))
    assert not starts_in_box(truck_trailer(), np.array([np.nextafter(2.0, 3.0), 0.0]))


@pytest.fixture
def planned():
    """A loop around a reactor outside S, with a stored plan of at least three inputs."""
    plant, horizon, channel, contract = plan_case("batch reactor", "overtaking")
    loop = safe_loop(certificate_of(plant, contract), plant, channel, "lookahead", horizon, on_unproved="ignore")
    rng = np.random.default_rng(0)
    for _ in range(200):
        loop.start(plant.half_widths * rng.uniform(-0.95, 0.95, plant.n))
        if loop.guaranteed and loop.plan_length > 2:
            return loop
    raise AssertionError("no such start")


def test_who_writes_into_a_decision_does_not_change_what_is_stored(planned):
    first = planned.decide(None)  # a controller that failed: the stored plan goes on
    kept = first.plan.copy()
    first.plan[:] = -planned.filter.plant.largest_input
    for u in kept[:2]:
        planned.receive()
        assert planned.guaranteed
        assert planned.plan_length == len(kept)
        decision = planned.decide(None)
        assert decision.reason == "stored"
        np.testing.assert_array_equal(decision.input, u)
        kept = kept[1:]


def test_an_input_other_than_the_decided_one_drops_the_stored_plan_and_a_start_any(planned):
    planned.decide(None)
    assert planned.plan_length > 0
    planned.receive(applied=np.full(2, 0.123))
    assert planned.plan_length == 0
    assert planned.reason == OTHER_INPUT
    planned.start(np.zeros(4))
    assert (planned.guaranteed, planned.plan_length) == (True, 0)


def test_start_outside_the_safe_set_is_guaranteed_exactly_if_a_first_plan_is_certified():
    plant, horizon, channel, contract = plan_case("batch reactor", "constant delay")
    certificate, rng, seen = certificate_of(plant, contract), np.random.default_rng(0), set()
    shield = safety_shield(loop_env(plant, channel, contract=contract), certificate, "lookahead", horizon=horizon)
    for seed in range(60):
        start = rng.uniform(-1.0, 1.0, plant.n) * plant.half_widths * rng.choice([0.3, 0.9, 1.05])
        _, info = shield.reset(seed=seed, options={"state": start})
        outside = not certificate.safe_set.contains(start)
        if (np.abs(plant.box @ start) > 1.0).any():
            assert not info["shield_guaranteed"]
            assert info["shield_reason"] == NOT_KNOWN_INSIDE
        elif outside:
            assert info["shield_guaranteed"] == (info["shield_plan_length"] > 0)
        else:
            assert info["shield_guaranteed"]
            assert info["shield_plan_length"] == 0
        seen.add((outside, info["shield_guaranteed"]))
    assert seen == {(False, True), (True, True), (True, False)}


@pytest.mark.parametrize("wrong", [np.nan, 1e3], ids=["a gap", "beyond the limits"])
def test_what_is_no_plan_counts_as_none_of_many_loops_too(wrong):
    cart, horizon = case("cart-pole"), 12
    made, plant, error = (
        safety_filter(cart.certificate, cart.plant, "lookahead", horizon),
        cart.plant,
        cart.certificate.Sigma,
    )
    lost = np.full((2, plant.n), 10.0) * plant.half_widths  # no plan is found
    proposals, stored = np.array([[np.nan], [0.0]]), np.full((2, horizon, plant.m), np.nan)
    stored[:, :4] = 0.1 * plant.largest_input
    decided = made.decide_many(lost, error, proposals, stored)
    np.testing.assert_array_equal(decided.reason, "stored")
    stored[:, 0] = wrong
    decided = made.decide_many(lost, error, proposals, stored)
    alone = [made.decide(x, error, u, plan) for x, u, plan in zip(lost, proposals, stored, strict=True)]
    assert [*decided.reason] == [each.reason for each in alone] == ["invalid", "fallback"]
    np.testing.assert_array_equal(decided.input, [each.input for each in alone])
    assert np.isnan(decided.plan).all()
