"""Limits of states and inputs together: rates, coupled inputs, outputs with feedthrough."""

from __future__ import annotations

import copy
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from scipy.optimize import linprog

from ncs_gym import Channel, Ellipsoid, contract_of
from shields import Infeasible, verify
from tests.certificates import certificate_of
from tests.product import (
    altered,
    safe_loop,
    safety_shield,
    sampled_plant,
    synthesize,
)
from tests.shields.polytope.limits import (
    CHANNEL,
    CONTRACT,
    MIXED,
    MODEL,
    ONE_INPUT,
    PLANTS,
    QUIET,
    certificate,
)
from tests.verdicts import verified


@pytest.mark.parametrize("name", MIXED)
def test_fallback_keeps_every_limit_from_every_state_by_linear_programs(name):
    plant, found = PLANTS[name], certificate(name)
    P, K, n = found.safe_set, found.K, plant.n
    faces = [(g, high) for g, high in zip(P.rows, P.high, strict=True) if np.isfinite(high)]
    faces += [(-g, -low) for g, low in zip(P.rows, P.low, strict=True) if np.isfinite(low)]
    A_ub, b_ub = np.array([g for g, _ in faces]), np.array([end for _, end in faces])
    for row, low, high in zip(plant.mixed_rows, *plant.mixed_ends, strict=True):
        f, g = row[:n] + row[n:] @ K, row[n:]
        constant = g @ (found.resting_input - K @ found.resting_state)
        reach = max(Ellipsoid(shape).support(g @ K) for shape in found.error_shapes)
        for sign, end in ((1.0, high), (-1.0, -low)):
            best = linprog(-sign * f, A_ub=A_ub, b_ub=b_ub, bounds=(None, None))
            assert best.status == 0
            assert -best.fun + sign * constant + reach <= end + 1e-9


@pytest.mark.cases(2)
@pytest.mark.parametrize("name", MIXED)
def test_closer_limits_and_changed_multipliers_are_refused_by_both_engines(name):
    plant, found = PLANTS[name], certificate(name)
    closer = altered(plant, mixed_ends=0.3 * plant.mixed_ends)
    claimed = replace(found, fingerprint=closer.fingerprint)
    P, first = found.safe_set, len(found.safe_set.rows) + plant.m
    upper, lower = P.multipliers.copy(), P.lower_multipliers.copy()
    upper[first, np.abs(upper[first]).argmax()] += 0.5
    lower[first, np.abs(lower[first]).argmax()] -= 0.5
    forged = [(replace(found, safe_set=replace(P, multipliers=upper, lower_multipliers=lower)), plant)]
    few = replace(P, multipliers=P.multipliers[:first], lower_multipliers=P.lower_multipliers[:first])
    forged += [(claimed, closer), (replace(found, safe_set=few), plant)]
    for each, claims in forged:
        assert not verified(each, claims).valid


@pytest.mark.cases(1)
@pytest.mark.parametrize("mode", ["project", "lookahead"])
def test_limit_of_rates_is_kept_behind_a_downlink(mode):
    plant = PLANTS["rates"]
    downlink = Channel(loss=0.3, max_consecutive_losses=2)
    settings = {"plant": plant, "channel": CHANNEL, "contract": CONTRACT, "downlink": downlink}
    env = gym.make("ncs_gym/LinearNCS-v0", disturbance="adversarial", **settings)
    both = replace(CONTRACT, max_age=CONTRACT.max_age + contract_of(downlink).max_age)
    shield = safety_shield(env, certificate_of(plant, both, "polytope"), mode)
    rng, guaranteed = np.random.default_rng(0), 0
    for seed in range(3):
        _, info = shield.reset(seed=seed)
        for _ in range(60):
            before = info["input"]
            _, _, _, _, info = shield.step(rng.choice([-1.0, 1.0], 1).astype(np.float32))
            if info["shield_guaranteed"]:
                assert info["cost"] == 0.0
                assert np.abs(info["input"] - before).max() <= 0.3
            guaranteed += info["shield_guaranteed"]
    assert guaranteed > 120


@pytest.mark.parametrize("name", ["rates", "rates of a late input"])
def test_proposal_beyond_the_rate_becomes_the_closest_one_that_keeps_it(name):
    plant, found = PLANTS[name], certificate(name)
    loop = safe_loop(found, plant, Channel(), mode="lookahead")
    loop.start(np.zeros(plant.n))
    loop.receive()
    for proposed in plant.input_ends[::-1]:
        decision = copy.deepcopy(loop).decide(proposed)
        assert decision.input == pytest.approx(0.3 * np.sign(proposed), abs=1e-3)


def test_only_a_polytope_is_sought_and_a_limit_that_nothing_keeps_has_a_reason():
    with pytest.raises(ValueError, match="only a polytope is sought"):
        synthesize(PLANTS["coupled"], safe_set="ellipsoid")
    unstable = sampled_plant(
        ([[3.0]], [[1.0]], [[1.0]], 0), 0.1, state_limits=(-1.0, 1.0), input_limits=(-3.0, 3.0), du_max=1e-3,
        disturbance_bound=0.05, **QUIET,
    )  # fmt: skip
    with pytest.raises(Infeasible, match=r"bind: \|u1 - u1 of 1 step ago\|"):
        synthesize(unstable, contract=CONTRACT)


def test_limits_count_beside_times_between_samples():
    plant = sampled_plant(
        MODEL, 0.1, between_samples=4, mixed_limits=[([-0.5, -1.0], [1.0], -0.6, 0.4)], **ONE_INPUT, **QUIET
    )
    found = certificate_of(plant, CONTRACT, "polytope")
    assert verified(found, plant).valid
    names = [condition.name[:4] for condition in verify(found, plant).conditions]
    assert names.count("(PM)") == 1 + 3 * len(plant.box)
