"""What is stored and proved where nothing else would show a mistake: restarts, starts in the box, other inputs."""

import numpy as np
import pytest

from ncs_gym import Ellipsoid, NCSEnv, NCSVectorEnv
from shields import SafetyFilter, SafetyShield, VectorSafetyShield
from shields.runtime.backup_plans.plan_search import Plans
from shields.runtime.starts import starts_in_box
from tests.certificates import certificate_of
from tests.shields.backup_plans.adversary import box_ellipsoid, case

COUNT = 6


@pytest.fixture
def many():
    """Six reactors behind lookahead, with starts anywhere in an ellipsoid of nearly the size of the box."""
    plant, horizon, network, contract = case("batch reactor", "overtaking")
    start = {"initial_set": box_ellipsoid(plant, 0.95), "disturbance": "adversarial"}
    env = NCSVectorEnv(COUNT, plant=plant, channel=network, contract=contract, **start)
    return VectorSafetyShield(env, certificate_of(plant, contract), "lookahead", horizon=horizon)


def plans(shield):
    return np.nan_to_num(shield._stored, nan=9.0)


def test_a_restart_before_the_first_step_drops_the_plan_of_the_start_and_no_other(many):
    rng, dropped, n = np.random.default_rng(0), 0, 4
    for seed in range(8):
        _, first = many.reset(seed=seed, options={"state": rng.uniform(-0.9, 0.9, (COUNT, n))})
        stored, again = plans(many), rng.permutation(COUNT) < COUNT // 2
        _, info = many.reset(options={"state": np.zeros((COUNT, n)), "reset_mask": again})
        assert (info["shield_plan_length"][again] == 0).all()
        assert info["shield_guaranteed"][again].all()
        for key in ("shield_plan_length", "shield_guaranteed"):
            np.testing.assert_array_equal(info[key][~again], first[key][~again])
        np.testing.assert_array_equal(plans(many)[..., ~again], stored[..., ~again])
        dropped += np.count_nonzero(first["shield_plan_length"][again])
    assert dropped > 5


@pytest.mark.parametrize("goes_on", ["step", "reset"])
def test_a_step_behind_the_shield_drops_every_plan(many, goes_on):
    push, n, m = np.ones((COUNT, 2), np.float32), 4, 2
    _, info = many.reset(seed=0, options={"state": np.random.default_rng(0).uniform(-0.9, 0.9, (COUNT, n))})
    assert info["shield_plan_length"].any()
    many.env.step(np.zeros((COUNT, m), np.float32))
    untouched = np.ones(COUNT, np.bool_)
    if goes_on == "step":
        *_, info = many.step(push)
    else:
        untouched[0] = False
        _, info = many.reset(options={"reset_mask": ~untouched})
    assert not info["shield_plan_length"][untouched].any()
    assert not info["shield_guaranteed"][untouched].any()


def test_a_start_in_the_box_is_decided_to_the_last_digit():
    plant = case("batch reactor", "overtaking")[0]
    row = plant.box_rows[2] / np.linalg.norm(plant.box_rows[2])
    inward, outward = 1.0 - 1e-9, 1.0 + 1e-9
    for scale, inside in ((inward, True), (outward, False)):
        reached = scale / abs(plant.box_rows[2] @ row)
        assert starts_in_box(plant, reached * row) is inside
        shape = np.diag(np.full(plant.n, 1e-4)) + (reached**2 - 1e-4) * np.outer(row, row)
        assert Ellipsoid(shape).support(plant.box_rows[2]) == pytest.approx(scale, abs=1e-12)
        assert starts_in_box(plant, Ellipsoid(shape)) is inside


def test_an_estimate_proves_the_box_only_with_room_for_its_error():
    plant, horizon, _, contract = case("batch reactor", "overtaking")
    shield = SafetyFilter(certificate_of(plant, contract), plant, "lookahead", horizon=horizon)
    shape = 0.01 * np.eye(plant.n)
    errors = shield.errors_of(shape)
    row = plant.box_rows[0] / (plant.box_rows[0] @ plant.box_rows[0])  # |c_0 x| = 1 on it
    left = 1.0 - Ellipsoid(shape).support(plant.box_rows[0])
    assert shield.lookahead.knows_in_box((left - 1e-6) * row, errors)
    assert not shield.lookahead.knows_in_box((left + 1e-6) * row, errors)
    indefinite = shield.errors_of(shape + 0.02 * np.eye(plant.n)[::-1])
    assert not shield.lookahead.knows_in_box(0.0 * row, indefinite)


def test_a_projected_input_leaves_nothing_of_an_earlier_plan(monkeypatch):
    plant, horizon, _, contract = case("cruise", "bursts")
    shield = SafetyFilter(certificate_of(plant, contract), plant, "lookahead", horizon=horizon)

    def nothing_found(estimates, *rest):
        count = len(estimates)
        return Plans(np.full((count, horizon, plant.m), np.nan), np.zeros(count, np.int64), np.full(count, np.inf))

    monkeypatch.setattr(shield.lookahead.planner, "find", nothing_found)
    rng, shape, stored = np.random.default_rng(0), shield.certificate.error_shapes[0], np.zeros((2, plant.m))
    kept, reach = 0, np.sqrt(np.diag(shield.certificate.L))
    for _ in range(100):
        x_hat, u = reach * rng.uniform(-1.0, 1.0, plant.n), plant.u_max * rng.choice([-1.0, 1.0], plant.m)
        errors, padded = shield.errors_of(shape).batch(), shield.lookahead.as_stored(stored)[..., None]
        alone, batch = (
            shield.decide(x_hat, shape, u, stored),
            shield.decide_columns(x_hat[:, None], errors, u[:, None], padded),
        )
        np.testing.assert_array_equal(alone.input, batch.input[:, 0])
        if alone.reason == "projected":
            kept += 1
            assert len(alone.plan) == 0
            assert np.isnan(batch.plan).all()
    assert kept > 10


def test_who_writes_into_a_decision_does_not_change_what_is_stored():
    plant, horizon, network, contract = case("batch reactor", "overtaking")
    env = NCSEnv(plant, network, contract=contract, initial_set=box_ellipsoid(plant, 0.95))
    shield = SafetyShield(env, certificate_of(plant, contract), "lookahead", horizon=horizon)
    written = 0
    for seed in range(20):
        shield.reset(seed=seed)
        for _ in range(4):
            decision = shield._monitored.decide(plant.u_max)
            if len(decision.plan):
                stored = shield._monitored._stored.copy()
                decision.plan[:] = -plant.u_max
                np.testing.assert_array_equal(shield._monitored._stored, stored)
                written += not np.array_equal(stored, decision.plan)
    assert written > 5
