"""Shields whose box counts between samples, too: proved by both verifiers, attacked on a fine grid by another route."""

from __future__ import annotations

from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from scipy.linalg import expm

from ncs_gym import ChannelContract
from shields import Certificate, Infeasible, silence_of, verify
from shields.polytope import Polytope
from shields.runtime.starts import starts_known
from tests.certificates import certificate_of
from tests.plants import named, with_radii
from tests.product import altered, safety_filter, sampled_plant, synthesize
from tests.second_verifier.verify import verify_again
from tests.verdicts import verified

IDS = {"TruckTrailerCruise": 8, "BatchReactor": 4}
FINE = 200


@cache
def found(name, points=None):
    """Plant and certificate of a registered environment."""
    env = gym.make(f"ncs_gym/{name}-v0").unwrapped
    plant = altered(env.plant, between_samples=points)
    return plant, certificate_of(plant, env.certificate_contract, "polytope")


@cache
def fine_rows(name):
    """Rows of the box on x and u at FINE + 1 times of a step, by scipy, shape (FINE + 1, k, n + m)."""
    plant = found(name)[0]
    n, m = plant.n, plant.m
    G = np.concatenate([plant.model.continuous, np.zeros((m, n + m))])
    return plant.box @ np.array([expm(G * (plant.dt * i / FINE))[:n] for i in range(FINE + 1)])


def worst_between(name, x, u):
    """The largest |c x(tau)| on a fine grid of a step, for the disturbance that is worst at each time; x is (n, N)."""
    plant = found(name)[0]
    reach = np.array([plant.nominal_disturbance.support(row) for row in plant.box])
    return (np.abs(fine_rows(name) @ np.concatenate([x, u])) + reach[:, None]).max()


@pytest.mark.parametrize("name", IDS)
def test_both_verifiers_prove_a_polytope_and_an_ellipsoid_is_refused(name):
    plant, wide = found(name, IDS[name])
    assert isinstance(wide.safe_set, Polytope)
    assert verified(wide, plant).valid
    for judge in (verify, verify_again):
        names = [condition.name for condition in judge(wide, plant).conditions]
        assert sum(each.startswith("(PM)") for each in names) == len(plant.box) * (IDS[name] - 1)
    assert wide.safe_set.high[: len(plant.box)].tolist() == plant.kept_ends[1].tolist()
    at_samples = certificate_of(found(name)[0], wide.contract, "ellipsoid")
    for judge in (verify, verify_again):
        named = {each.name: each.holds for each in judge(at_samples, plant).conditions}
        assert not named["S: an ellipsoid is kept only around zero, within symmetric limits"]
    with pytest.raises(ValueError, match="only a polytope is sought"):
        synthesize(plant, contract=wide.contract, safe_set="ellipsoid")


@pytest.mark.cases(2)
@pytest.mark.parametrize("name", IDS)
@pytest.mark.parametrize("mode", ["project", "switch"])
def test_no_state_between_samples_is_outside_and_without_it_some_are(name, mode):
    rng, worst = np.random.default_rng(1), {}
    for points in (None, IDS[name]):
        plant, certificate = found(name, points)
        shield, most = safety_filter(certificate, plant, mode=mode), 0.0
        for shape in certificate.error_shapes[[0, -1]]:
            x = certificate.safe_set.sample_boundary(rng, 3000).T * rng.choice([1.0, 1.0, 0.9], 3000)
            e = rng.standard_normal((plant.n, 3000))
            e = np.linalg.cholesky(shape) @ (e / np.linalg.norm(e, axis=0))
            proposed = plant.largest_input[:, None] * rng.choice([-1.0, 1.0, 0.3], (plant.m, 3000))
            errors = shield.errors_of_many(shape[None]).of(np.zeros(3000, np.int64))
            decided = shield.decide_columns(x + e, errors, proposed)
            assert len(np.unique(decided.reason)) == {"project": 3, "switch": 2}[mode]
            most = max(most, worst_between(name, x, decided.input))
        worst[points] = most
    assert worst[IDS[name]] <= 1.0
    assert worst[None] > 1.0


def test_certificate_says_when_its_claim_holds_and_its_file_keeps_it(tmp_path):
    wide, without = found("TruckTrailerCruise", 8)[1], found("TruckTrailerCruise")[1]
    assert "The safe box counts at all times, at 8 of each step" in " ".join(str(wide).split())
    assert "at all times" not in str(without)
    wide.save(tmp_path / "wide.json")
    assert Certificate.load(tmp_path / "wide.json") == wide


def test_before_the_first_decision_behind_a_downlink_times_between_samples_count():
    plant, wide = found("BatchReactor", 4)
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


def test_limits_that_bind_within_a_step_are_named_like_those_of_the_box():
    plant, contract = named("servo, at all times")
    with pytest.raises(Infeasible, match=r"those that bind: \|x2\| <= 4, \|x1\| <= 0.2\)"):
        synthesize(with_radii(plant, 1.3), contract=contract)


@pytest.mark.parametrize("factor", [0.99, 1.02])
def test_what_a_certificate_says_to_be_tolerated_is_so(factor):
    plant, contract = named("servo, at all times")
    scale = synthesize(plant, contract=contract).provenance["tolerated_scale"]
    larger = with_radii(plant, factor * scale)
    if factor < 1.0:
        assert verified(synthesize(larger, contract=contract), larger).valid
    else:
        with pytest.raises(Infeasible):
            synthesize(larger, contract=contract)


def test_silence_counts_from_states_in_the_box_where_ways_count():
    """From an estimate in half of S the first state may be so near its limit that it is beyond it before the sample."""
    plant = sampled_plant(
        ([[-np.log(10.0)]], [[0.01 * np.log(10.0)]], [[1.0]], [[0.0]]),
        1.0,
        **{"box": [1.0], "u_max": 1.0, "disturbance_bound": [0.38], "sensor_bound": 0.35, "initial_bound": [0.4]},
        between_samples=4,
    )
    certificate = synthesize(plant, contract=ChannelContract(2))
    assert 0.5 * certificate.safe_set.high[0] + np.sqrt(certificate.Sigma[0, 0]) > plant.kept_ends[1, 0]
    assert silence_of(certificate, plant).at_half == 0
