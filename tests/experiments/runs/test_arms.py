"""Names of arms, and the control loops that their agents are trained and evaluated in."""

import pytest

from agents.hyperparams import DEFAULTS, with_changes
from agents.loop import CostPenalty, LagrangianSettings, LoopConfig
from benchmarks.suite import NETWORK_TASKS
from experiments.baselines.filters import EstimateFilter
from experiments.baselines.tuned import tuned_training
from experiments.commands.compare import CompareSettings
from experiments.runs.arms import Arm, is_shield, run_of_arm
from experiments.runs.loops import certificate_of
from shields import VectorSafetyShield


@pytest.fixture(scope="module")
def run_of(certificate):
    loop = LoopConfig(env="ncs_gym/TruckTrailerCruise-v0")
    return lambda name, **settings: run_of_arm(CompareSettings(**settings), loop, certificate, name, 0)


def layers(env):
    """Classes of the wrappers, from outside."""
    found = []
    while hasattr(env, "env"):
        found.append(type(env))
        env = env.env
    return found


@pytest.mark.parametrize(
    ("name", "mode", "policy"),
    [
        ("unshielded", None, "trained"),
        ("lagrangian", None, "trained"),
        ("shielded:switch", "switch", "trained"),
        ("psf+penalty", "psf", "trained"),
        ("lookahead", "lookahead", "trained"),
        ("SAC lookahead at test", "lookahead", "trained"),
        ("mpc:20+psf:tube", "psf:tube", "mpc:20"),
        ("shield at test", "boundary", "trained"),
        ("shielded+penalty", "boundary", "trained"),
        ("zero input", None, "zero input"),
        ("K x_hat+shielded", "boundary", "K x_hat"),
        ("random+shielded:project", "project", "random"),
        ("untrained+trusting", "trusting", "untrained"),
    ],
)
def test_name_says_which_filter_and_which_policy(name, mode, policy):
    arm = Arm.of(name, "boundary")
    assert (arm.name, arm.mode, arm.policy) == (name, mode, policy)
    assert is_shield(arm.mode) == (mode is not None and mode.partition(":")[0] not in ("trusting", "psf"))
    assert Arm.of(name.replace(" ", "-"), "boundary") == arm


@pytest.mark.parametrize("env_id", [f"ncs_gym/{task}" for task in NETWORK_TASKS])
@pytest.mark.parametrize("arm", ["unshielded", "trusting:20", "shielded", "penalized", "lagrangian"])
def test_arm_of_the_study_is_trained_with_what_was_tuned_for_it(env_id, arm):
    loop = LoopConfig(env=env_id)
    certificate = certificate_of(loop)
    own = tuned_training(env_id, arm)
    assert own
    common, tuned = (
        run_of_arm(CompareSettings(env=env_id, tuned_arms=tuned), loop, certificate, arm, 0) for tuned in (False, True)
    )
    assert common.settings == DEFAULTS["PPO"]
    assert tuned.settings == with_changes(DEFAULTS["PPO"], own["hyperparams"])
    if arm == "penalized":
        assert tuned.training_loop.violation_penalty == own["violation_penalty"]
    if arm == "lagrangian":
        assert tuned.training_loop.lagrangian == LagrangianSettings(**own.get("lagrangian", {}))


def test_weight_of_a_penalty_may_be_part_of_the_name(run_of):
    weights = {name: run_of(name, violation_penalty=3.0) for name in ("penalized", "penalized:0.1", "penalized:1e-2")}
    assert [run.training_loop.violation_penalty for run in weights.values()] == [3.0, 0.1, 0.01]
    assert {run.arm for run in weights.values()} == set(weights)


def test_lookahead_alone_takes_the_horizon(run_of):
    planning = run_of("lookahead", arms=("lookahead",), horizon=4)
    assert (planning.loop.shield.mode, planning.loop.shield.horizon) == ("lookahead", 4)
    assert run_of("shielded", arms=("lookahead",), horizon=4).loop.shield.horizon is None
    assert planning.key != run_of("lookahead", arms=("lookahead",), horizon=5).key


def test_filter_at_test_is_not_there_in_training(run_of):
    for name, kind in (("shield at test", VectorSafetyShield), ("trusting at test", EstimateFilter)):
        run = run_of(name)
        assert layers(run.training_loop.vector(2)) == []
        assert layers(run.loop.vector(2)) == [kind]
    for name in ("shielded", "trusting", "psf"):
        run = run_of(name)
        assert layers(run.training_loop.vector(2)) == layers(run.loop.vector(2)) != []


def test_lagrangian_has_its_settings_and_starts_at_its_multiplier(run_of):
    settings = LagrangianSettings(multiplier=0.5, cost_limit=2.0)
    run = run_of("lagrangian", lagrangian=settings)
    assert run.training_loop.lagrangian == settings
    envs = run.training_loop.vector(2)
    assert (layers(envs), envs.penalty) == ([CostPenalty], 0.5)
    assert layers(run.loop.vector(2)) == []
    assert run.key != run_of("lagrangian").key
    assert run_of("unshielded", lagrangian=settings).training_loop.lagrangian is None


@pytest.mark.cases(1)
@pytest.mark.parametrize("name", ["trusting", "shield at test", "lagrangian", "lqr+trusting"])
def test_every_arm_plays(run_of, name):
    tiny = dict(n_envs=2, n_steps=64, batch_size=64, n_epochs=1, policy_kwargs=dict(net_arch=[8, 8]))
    result = run_of(name, steps=256, episodes=2, hyperparams=tiny).execute(lambda steps: None)
    assert (result.arm, len(result.episodes)) == (name, 2)
    assert result.train_steps == (0 if name.startswith("lqr") else 256)
    assert (result.episodes[0].guaranteed, result.episodes[1].guaranteed) == (2 * (name[:6] == "shield",))
