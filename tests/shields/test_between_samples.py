"""Shields whose box counts between samples, too: proved by both verifiers, attacked on a fine grid by another route."""

from __future__ import annotations

from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from scipy.linalg import expm

from ncs_gym import Channel, Packet, truck_trailer
from ncs_gym.network.downlink import downlink_protocol
from shields import Certificate, Infeasible, verify
from shields.polytope import Polytope
from shields.runtime.backup_plans import PlanTest, Prediction
from shields.runtime.guard import GuaranteeMonitor
from shields.runtime.safety_filter import Decision
from shields.runtime.set_test import ellipsoid_test
from shields.runtime.starts import starts_known
from tests.certificates import certificate_of
from tests.plants import named, swinging
from tests.product import altered, belief, library_plant, safe_loop, safety_filter, sampled_plant, staying
from tests.second_verifier.verify import verify_again
from tests.verdicts import verified

IDS = {"TruckTrailerCruise": 8, "BatchReactor": 4}
FINE = 200


@cache
def found(name, points=None):
    """Plant and certificates, with ellipsoid and with polytope, of a registered environment."""
    env = gym.make(f"ncs_gym/{name}-v0").unwrapped
    plant = altered(env.plant, between_samples=points)
    return plant, *(certificate_of(plant, env.certificate_contract, kind) for kind in ("ellipsoid", "polytope"))


@cache
def fine_rows(name):
    """Rows of the box on x and u at FINE + 1 times of a step, by scipy, shape (FINE + 1, k, n + m)."""
    plant = found(name)[0]
    n, m = plant.n, plant.m
    G = np.concatenate([plant.continuous_model, np.zeros((m, n + m))])
    return plant.box_rows @ np.array([expm(G * (plant.dt * i / FINE))[:n] for i in range(FINE + 1)])


def worst_between(name, x, u):
    """The largest |c x(tau)| on a fine grid of a step, for the disturbance that is worst at each time; x is (n, N)."""
    plant = found(name)[0]
    reach = np.array([plant.nominal_disturbance.support(row) for row in plant.box_rows])
    return (np.abs(fine_rows(name) @ np.concatenate([x, u])) + reach[:, None]).max()


@pytest.mark.parametrize("name", IDS)
def test_both_verifiers_prove_ellipsoid_and_polytope(name):
    plant, plain, wide = found(name, IDS[name])
    assert isinstance(wide.safe_set, Polytope)
    assert plain.between_samples == wide.between_samples == IDS[name]
    assert verified(plain, plant).valid
    assert verified(wide, plant).valid
    for judge in (verify, verify_again):
        names = [condition.name for condition in judge(wide, plant).conditions]
        assert sum(each.startswith("(G)") for each in names) == len(plant.box_rows)
        assert sum(each.startswith("(PB)") for each in names) == len(plant.box_rows) * IDS[name]
    assert plain.provenance["share_of_box"] < found(name)[1].provenance["share_of_box"]
    assert wide.provenance["share_of_box"] < found(name)[2].provenance["share_of_box"]


@pytest.mark.cases(2)
@pytest.mark.parametrize("name", IDS)
@pytest.mark.parametrize("kind", [1, 2])
@pytest.mark.parametrize("mode", ["project", "switch"])
def test_no_state_between_samples_is_outside_and_without_it_some_are(name, kind, mode):
    rng, worst = np.random.default_rng(1), {}
    for points in (None, IDS[name]):
        loop = found(name, points)
        plant, certificate = loop[0], loop[kind]
        shield, most = safety_filter(certificate, plant, mode=mode), 0.0
        for shape in certificate.error_shapes[[0, -1]]:
            x = certificate.safe_set.sample_boundary(rng, 3000).T * rng.choice([1.0, 1.0, 0.9], 3000)
            e = rng.standard_normal((plant.n, 3000))
            e = np.linalg.cholesky(shape) @ (e / np.linalg.norm(e, axis=0))
            proposed = plant.u_max[:, None] * rng.choice([-1.0, 1.0, 0.3], (plant.m, 3000))
            errors = shield.errors_of_many(shape[None]).of(np.zeros(3000, np.int64))
            decided = shield.decide_columns(x + e, errors, proposed)
            assert len(np.unique(decided.reason)) == {"project": 3, "switch": 2}[mode]
            most = max(most, worst_between(name, x, decided.input))
        worst[points] = most
    assert worst[IDS[name]] <= 1.0
    assert worst[None] > 1.0


def test_certificate_says_when_its_claim_holds_and_its_file_keeps_it(tmp_path):
    _, plain, wide = found("TruckTrailerCruise", 8)
    _, without, _ = found("TruckTrailerCruise")
    assert "in the safe box at all times" in str(plain)
    assert "at the sampling instants" in str(without)
    assert without.document["certificate"]["between_samples"] is None
    wide.save(tmp_path / "wide.json")
    assert Certificate.load(tmp_path / "wide.json") == wide


@pytest.mark.parametrize("horizon", [1, 4])
def test_plans_are_certified_only_if_every_time_between_samples_is_inside(horizon):
    plant, plain, _ = found("TruckTrailerCruise", 8)
    prediction = Prediction(ellipsoid_test(plain.safe_set.shape_matrix, plant), horizon)
    without = Prediction(ellipsoid_test(plain.safe_set.shape_matrix, found("TruckTrailerCruise")[0]), horizon)
    rng, shape = np.random.default_rng(0), 0.5 * plain.error_shapes[0]
    estimates = rng.uniform(-2.0, 2.0, (2000, 2))
    plans = rng.uniform(-4.0, 4.0, (2000, 1, horizon, 1))
    verdicts = []
    for each in (prediction, without):
        test = PlanTest(each, 1e-9)
        verdicts.append(test.certified(estimates, test.tightenings_of(np.tile(shape, (2000, 1, 1))), plans)[:, 0])
    assert (verdicts[0] <= verdicts[1]).all()
    assert verdicts[0].sum() < verdicts[1].sum()
    reach = np.array([plant.disturbance.support(row) for row in plant.box_rows])
    for length in range(1, horizon + 1):
        center, A, disturbed, worst = estimates.T, np.eye(2), np.zeros((FINE + 1, 2)), np.zeros(2000)
        for i in range(length):
            u = plans[:, 0, i].T
            rows = fine_rows("TruckTrailerCruise")[..., :2]
            error = np.sqrt(np.einsum("tkn,nm,tkm->tk", rows @ A, shape, rows @ A))
            values = np.abs(fine_rows("TruckTrailerCruise") @ np.concatenate([center, u]))
            # At the first sampling instant the state is what it is.
            part = slice(FINE // 8 if i == 0 else 0, FINE + 1)
            worst = np.maximum(worst, (values + (error + disturbed + reach)[..., None])[part].max(axis=(0, 1)))
            disturbed = disturbed @ np.eye(2) + np.sqrt(
                np.einsum("tkn,nm,tkm->tk", rows @ A, plant.disturbance.shape_matrix, rows @ A)
            )
            center, A = plant.A @ center + plant.B @ u, A @ plant.A
        assert worst[verdicts[0][:, length - 1]].max() <= 1.0


def test_before_the_first_decision_behind_a_downlink_times_between_samples_count():
    plant, _, wide = found("BatchReactor", 4)
    shield, zero = safety_filter(wide, plant), np.zeros((2, 1))
    assert all(known.in_safe_set for known in starts_known(shield, np.zeros(4), 1))
    counts = {True: 0, False: 0}
    for x in 0.9999 * wide.safe_set.sample_boundary(np.random.default_rng(0), 300):
        assert starts_known(shield, x, 0)[0].in_safe_set  # the first input is decided
        first, second = starts_known(shield, x, 1)
        # From the last point of the grid on it is the next sample that has to be inside.
        known = first.in_safe_set and second.in_safe_set
        counts[first.in_safe_set] += 1
        if known:
            assert worst_between("BatchReactor", x[:, None], zero) <= 1.0
    assert min(counts.values()) > 10


def test_at_all_times_assumes_that_disturbances_within_a_step_respect_its_bound():
    """A torque constant over each step keeps the bound of a step, and does more in the middle of half a period."""
    A, B, dt, torque = np.array([[0.0, 1.0], [-1.0, -0.4]]), np.array([[0.0], [1.0]]), 3.1, 0.3
    G = np.pad(np.hstack([A, B]), ((0, 1), (0, 0)))
    times = [expm(G * tau)[:2] for tau in np.linspace(0.0, dt, 60)]
    plant = sampled_plant(
        (A, B, np.eye(2), np.zeros((2, 1))),
        dt=dt,
        box=[1.5, 1.0],
        u_max=0.5,
        disturbance_bound=(times[-1][:, 2:], [torque]),
        sensor_bound=1e-4,
        initial_bound=1e-3,
        between_samples=32,
    )
    assert "by any time within a step" in " ".join(plant.assumptions)
    loop, x = safe_loop(certificate_of(plant, safe_set="polytope"), plant, Channel(), on_unproved="ignore"), np.zeros(2)
    rng, within, at_samples = np.random.default_rng(1), 0.0, 0.0
    loop.start(x)
    for step in range(800):
        loop.receive([Packet(step, x.copy(), loop.episode)] if step else [])
        assert loop.guaranteed
        u = loop.decide(rng.choice([-1.0, 1.0]) * plant.u_max).input[0]
        pushed = {
            d: max(np.abs(plant.box_rows @ (each @ [*x, u + d])).max() for each in times) for d in (-torque, torque)
        }
        x = times[-1] @ [*x, u + rng.choice([-torque, torque])]
        within, at_samples = max(within, *pushed.values()), max(at_samples, np.abs(plant.box_rows @ x).max())
    assert at_samples < 1.0 < within


def test_a_passed_test_does_not_prove_a_step_that_began_where_nothing_did():
    tiny = 1e-12 * np.eye(2)
    settings = {"process_noise_cov": 0.0 * tiny, "initial_cov": tiny, "measurement_noise_cov": tiny, "gamma": 1e-8}
    plant = library_plant(truck_trailer, mass=1000.0, dt=0.2, between_samples=2, **settings)
    loop = safe_loop(certificate_of(plant, safe_set="polytope"), plant, channel=Channel(), on_unproved="ignore")
    x = np.array([1.9999946541265599, 0.27376498913178876])  # in the box, out of what the proof begins with
    loop.start(x)
    loop.receive()
    assert not loop.guaranteed
    decision = loop.decide(-4.0)
    assert decision.proved
    G = np.concatenate([plant.continuous_model, np.zeros((1, 3))])
    joint = np.concatenate([x, decision.input])
    times = np.linspace(0.0, plant.dt, 401)
    assert max(np.abs(plant.box_rows @ expm(G * each)[:2] @ joint).max() for each in times) > 1.001
    loop.receive()
    assert not loop.guaranteed  # of this step
    loop.decide(0.0)
    loop.receive()
    assert loop.guaranteed


def test_a_step_that_nothing_proved_is_not_proved_by_where_it_led():
    plant = swinging(damping=0.4, u_max=0.95)
    switch = safety_filter(certificate_of(plant, safe_set="polytope"), plant, "switch")
    monitor = GuaranteeMonitor(switch, downlink_protocol(Channel(delay=1), None))
    small = staying(switch.errors_of(plant.initial_error.shape_matrix))
    large = switch.errors_of(np.diag([0.16, 9.0]))
    seen = belief(np.zeros(2))
    passed = Decision(np.zeros(1), False, True, False, 1.0, "", np.empty((0, 1)))
    fallback = passed._replace(proved=False, fallback=True)
    state = monitor.cover(monitor.start(True, seen, small), [(True, seen, small)])
    held = []
    for decision, errors in ((passed, large), (fallback, small), (passed, small), (passed, small), (passed, small)):
        held.append(not monitor.reasons(state))
        state = monitor.advance(state, decision, True, True, seen, errors)
    assert held == [True, False, False, False, True]


def test_limits_that_bind_within_a_step_are_named_like_those_of_the_box():
    with pytest.raises(Infeasible, match=r"those that bind: \|x2\| <= 4\)"):
        certificate_of(*named("servo, at all times"))
