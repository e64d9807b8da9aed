"""Filters that take the estimate for the truth: what they keep, what they lose, and that they promise nothing."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from agents.evaluation import evaluate
from agents.loop import LoopConfig, ShieldSettings
from experiments.baselines.controllers import controller
from experiments.baselines.filters import FILTERS, CertaintyEquivalentFilter, EstimateFilterSettings, PredictiveFilter
from ncs_gym.envs.env import ncs_env
from tests.certificates import certificate_of, metric
from tests.plants import delayed
from tests.product import safety_filter, synthesize
from tests.shields.polytope.limits import PLANTS
from tests.shields.polytope.limits import certificate as limited

CRUISE = "ncs_gym/TruckTrailerCruise-v0"
NEVER = np.zeros(1, np.bool_)


@pytest.fixture(scope="module")
def trusting(certificate, loaded):
    return CertaintyEquivalentFilter(certificate, loaded)


@pytest.fixture(scope="module")
def cases(certificate, loaded):
    """Estimates inside and around S, and inputs within the limits."""
    rng = np.random.default_rng(0)
    estimates = certificate.safe_set.sample_boundary(rng, 400) * rng.uniform(0.0, 1.1, (400, 1))
    return estimates, rng.uniform(-1.0, 1.0, (400, 1)) * loaded.largest_input


def played(certificate, **filters):
    """The regulator on the cruise, always with the same seed."""
    loop = LoopConfig(env=CRUISE, **filters)
    policy = controller("lqr", ncs_env(loop.single()), certificate.fallback, 0)
    return evaluate(loop, policy, 20, 7, certificate.safe_set).episodes


def test_trusting_filter_is_caught_leaving_the_safe_set_and_the_shield_is_not(certificate):
    trusted = played(certificate, filter=EstimateFilterSettings("trusting", certificate))
    shielded = played(certificate, shield=ShieldSettings(certificate))
    assert sum(episode.times_safe_set > 1.0 for episode in trusted) >= 3
    assert sum(episode.violation_steps for episode in trusted) >= 3
    assert max(episode.times_safe_set for episode in shielded) <= 1.0
    assert sum(episode.violation_steps for episode in shielded) == 0
    overridden = [sum(each.interventions for each in episodes) for episodes in (trusted, shielded)]
    assert 0.8 * overridden[1] < overridden[0] <= overridden[1]
    assert not any(episode.guaranteed for episode in trusted)
    assert all(episode.guaranteed for episode in shielded)


def tank(env_id="ncs_gym/CSTR-v0"):
    loop = LoopConfig(env=env_id)
    env = ncs_env(loop.single())
    return loop, env, certificate_of(env.plant, env.contract)


def violating(loop, certificate, name, episodes=40, **settings):
    """Violating episodes of a regulator behind a filter."""
    loop = replace(loop, filter=EstimateFilterSettings(name, certificate))
    policy = controller("lqr", ncs_env(loop.single()), certificate.fallback, 0)
    return sum(
        each.violation_steps > 0 for each in evaluate(loop.with_kwargs(**settings), policy, episodes, 7).episodes
    )


@pytest.mark.slow
def test_filter_with_the_tube_of_our_error_sets_keeps_the_box_under_attack():
    loop, env, certificate = tank()
    attack = {"noise": "extreme", "disturbance": "adversarial", "channel": replace(env.channel, loss=1.0)}
    assert violating(loop, certificate, "psf:tube", **attack) == 0
    assert violating(loop, certificate, "psf", **attack) > 10


def test_margin_is_of_what_states_are_off_by_and_not_of_past_inputs():
    plant = delayed(2)
    certificate, rng, angles = certificate_of(plant), np.random.default_rng(0), np.arange(0.0, 7.0, 0.05)
    estimates = rng.uniform(0.5, 1.0, (400, 1)) * certificate.safe_set.sample_boundary(rng, 400)
    off = np.linalg.cholesky(np.linalg.inv(plant.weight)[:2, :2]) @ [np.cos(angles), np.sin(angles)]
    off = 0.1 * np.vstack([off, np.zeros((2, len(angles)))])

    def level(u):
        """The largest x'Mx of the next state, with the margin around it, of each estimate."""
        places = (plant.A @ estimates.T + plant.B @ u.T)[:, :, None] + off[:, None]
        return np.einsum("isk,ij,jsk->sk", places, metric(certificate), places).max(axis=1)

    bearable = np.min([level(np.full((400, 1), u)) for u in np.linspace(-0.8, 0.8, 41)], axis=0) < 0.98
    largest = {}
    for name in ("trusting", "trusting:10"):
        for proposed in (np.full((400, 1), -0.8), np.full((400, 1), 0.8)):
            u = FILTERS[name](certificate, plant)(estimates, proposed, np.zeros(400, np.bool_))
            largest[name] = max(largest.get(name, 0.0), level(u)[bearable].max())
    assert largest["trusting:10"] <= 1.0 + 1e-9 < largest["trusting"]


@pytest.mark.parametrize("name", ["trusting", "psf:tube"])
def test_no_filter_speaks_of_a_guarantee(name, certificate):
    envs = EstimateFilterSettings(name, certificate)(gym.make_vec(CRUISE, num_envs=2))
    _, info = envs.reset(seed=0)
    *_, after = envs.step(np.ones((2, 1), np.float32))
    for keys in (info, after):
        assert {"shield_intervened", "input_proposed", "shield_correction"} <= set(keys)
        assert not {"shield_guaranteed", "shield_reason"} & set(keys)


def test_trusting_filter_decides_as_the_shield_without_an_error(certificate, loaded, trusting, cases):
    shield, nothing = safety_filter(certificate, loaded), np.zeros((2, 2))
    applied = trusting(*cases, np.zeros(400, np.bool_))
    for estimate, proposed, chosen in zip(*cases, applied, strict=True):
        np.testing.assert_array_equal(chosen, shield.decide(estimate, nothing, proposed).input)
    assert 20 < np.count_nonzero(applied != cases[1]) < 380


@pytest.mark.cases(1)
@pytest.mark.parametrize("kind", ["ellipsoid", "polytope", "two ends"])
def test_predictive_filter_finds_the_closest_input_with_a_nominal_plan(kind, certificate, loaded):
    """Two steps, by trying inputs on a grid."""
    plant = loaded
    if kind == "polytope":
        certificate = synthesize(loaded, contract=certificate.contract)
        assert hasattr(certificate.safe_set, "rows")
    elif kind == "two ends":
        plant, certificate = PLANTS["angle"], limited("angle")
    predictive, grid = PredictiveFilter(certificate, plant, horizon=2), np.linspace(*plant.input_ends[:, 0], 401)
    rng, found = np.random.default_rng(3), 0
    first, second = (each.ravel()[:, None] for each in np.meshgrid(grid, grid, indexing="ij"))
    (low, high), widths = plant.own_limits, plant.half_widths
    for _ in range(80):
        estimate = rng.uniform(low - 0.3 * widths, high + 0.3 * widths)
        proposed = rng.uniform(*plant.input_ends)
        one = plant.A @ estimate + first @ plant.B.T
        two = one @ plant.A.T + second @ plant.B.T
        fine = (plant.constraint_values(one.T) <= 0.0).all(axis=0)
        fine &= certificate.safe_set.gauge(two) <= 1.0
        if fine.any():
            best = np.abs(first[fine] - proposed).min()
            chosen = predictive(estimate[None], proposed[None], ~NEVER)[0]
            assert abs(abs(chosen - proposed).item() - best) <= 0.03
            found += best > 0.1
    assert found >= 5


@pytest.mark.cases(2)
@pytest.mark.parametrize("name", ["angle", "rates", "coupled"])
@pytest.mark.parametrize("margin", [0.0, 0.2])
def test_predictive_filter_keeps_limits_with_two_ends_and_of_states_and_inputs_together(name, margin):
    plant, certificate = PLANTS[name], limited(name)
    predictive, rng, raw = (
        PredictiveFilter(certificate, plant, margin=margin),
        np.random.default_rng(1),
        np.zeros(plant.n),
    )
    state, reached, alone = np.zeros(plant.n), [], []
    for k in range(160):
        if k % 20 == 0:
            proposed = np.where(rng.random(plant.m) < 0.5, *plant.input_ends)
        u = predictive(state[None], proposed[None], np.array([k == 0]))[0]
        assert ((plant.input_ends[0] <= u) & (u <= plant.input_ends[1])).all()
        after = plant.A @ state + plant.B @ u
        reached.append(plant.worst_constraint_values(state, u, after).max())
        state, raw = after, plant.A @ raw + plant.B @ proposed
        alone.append(plant.constraint_values(raw).max())
    assert max(alone) > 0.05
    assert -margin - 0.1 < max(reached) <= -margin + 1e-5


def test_tubes_are_not_for_limits_of_states_and_inputs_together():
    with pytest.raises(ValueError, match="a tube knows no limits of states and inputs together"):
        PredictiveFilter(limited("coupled"), PLANTS["coupled"], tube=True)


def test_predictive_filter_applies_the_rest_of_its_plan_and_then_the_gain(certificate, loaded):
    predictive = PredictiveFilter(certificate, loaded, horizon=3)
    inside, outside, zero = np.zeros((1, 2)), 5.0 * loaded.half_widths[None], np.zeros((1, 1))
    lost = np.clip(outside @ certificate.K.T, -loaded.largest_input, loaded.largest_input)
    np.testing.assert_array_equal(predictive(outside, zero, ~NEVER), lost)
    pushed = np.full((1, 1), 0.5)
    np.testing.assert_array_equal(predictive(inside, pushed, ~NEVER), pushed)
    state, plan = loaded.B @ pushed[0], []
    for _ in range(2):
        plan.append(certificate.K @ state)
        state = loaded.A @ state + loaded.B @ plan[-1]
    for planned in (*plan, lost[0]):
        np.testing.assert_allclose(predictive(outside, zero, NEVER)[0], planned, atol=1e-15)
    predictive(inside, pushed, NEVER)
    np.testing.assert_array_equal(predictive(outside, zero, ~NEVER), lost)  # another episode


@pytest.mark.parametrize("autoreset", ["NextStep", "SameStep"])
def test_what_is_not_changed_is_passed_on_bit_for_bit(autoreset, certificate):
    def steps(wrap):
        envs = wrap(gym.make_vec(CRUISE, num_envs=3, max_episode_steps=5, autoreset_mode=autoreset))
        envs.reset(seed=4)
        return [envs.step(np.full((3, 1), 0.1, np.float32)) for _ in range(14)]

    for bare, behind in zip(
        steps(lambda envs: envs), steps(EstimateFilterSettings("trusting", certificate)), strict=True
    ):
        np.testing.assert_array_equal(bare[0], behind[0])
        np.testing.assert_array_equal(bare[1], behind[1])
        np.testing.assert_array_equal(behind[4]["shield_correction"], 0.0)
        assert not behind[4]["shield_intervened"].any()


def test_every_override_has_its_penalty_and_a_step_that_only_resets_none(certificate):
    both = []
    for penalty in (0.0, 2.0):
        filtered = EstimateFilterSettings("trusting", certificate, penalty)
        envs = filtered(gym.make_vec(CRUISE, num_envs=2, max_episode_steps=3))
        envs.reset(seed=1, options={"state": 0.95 * np.linalg.cholesky(certificate.safe_set.shape_matrix)[:, 0]})
        both.append([envs.step(np.full((2, 1), action)) for action in (1.0, 1.0, 1.0, -1.0)])
    overridden = np.array([info["shield_intervened"] for *_, info in both[1]])
    np.testing.assert_allclose([free[1] - paid[1] for free, paid in zip(*both, strict=True)], 2.0 * overridden)
    assert overridden[:3].any()
    assert not overridden[3].any()


def test_only_an_environment_with_an_estimate_can_be_filtered(certificate):
    with pytest.raises(ValueError, match="needs an NCSVectorEnv"):
        EstimateFilterSettings("psf", certificate)(gym.make_vec("CartPole-v1", num_envs=1))
