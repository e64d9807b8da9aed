from dataclasses import replace

import numpy as np
import pytest

from agents import tuned_hyperparams
from agents.hyperparams import complete_hyperparams
from agents.loop import LoopConfig
from experiments.analysis.episodes import arm_summary, episodes_table, paired_differences
from experiments.commands.compare import CompareSettings, shortened
from experiments.runs.arms import full_names, require_arms, run_of_arm
from experiments.runs.training_run import RunResult
from tests.experiments.results import episode

ALL_ARMS = ("unshielded", "monitor", "penalized", "shielded", "shielded:switch+penalty", "shielded:boundary")


CRUISE = "ncs_gym/TruckTrailerCruise-v0"


def runs_of(certificate, **change):
    settings, loop = CompareSettings(**change), LoopConfig(env=CRUISE)
    names = settings.arms + settings.baselines
    return [run_of_arm(settings, loop, certificate, name, i) for i in range(settings.seeds) for name in names]


def test_runs_with_equal_numbers_are_paired_across_arms_and_differ_from_each_other(certificate):
    seeds: dict = {}
    for run in runs_of(certificate, arms=ALL_ARMS):
        seeds.setdefault(run.index, set()).add((run.training_seed, run.evaluation_seed))
    assert {len(pairs) for pairs in seeds.values()} == {1}
    assert all(0 <= run.training_seed < 2**31 for run in runs_of(certificate, seed=2**63))
    flat = [number for pairs in seeds.values() for pair in pairs for number in pair]
    assert len(set(flat)) == len(flat) == 6


def test_a_smoke_run_evaluates_the_pretrained_agent_unless_something_else_is_asked_for():
    short = shortened(CompareSettings(smoke=True))
    assert short.arms == ("unshielded", "shielded", "pretrained", "pretrained+shielded")  # the arms that are drawn
    own = shortened(CompareSettings(smoke=True, arms=("shielded",), baselines=("lqr",)))
    assert (own.arms, own.baselines) == (("shielded",), ("lqr",))
    without = shortened(CompareSettings(smoke=True, env="plants:plants/Own-v0"))
    assert (without.arms, without.baselines) == (("unshielded", "shielded"), CompareSettings().baselines)
    assert shortened(CompareSettings()) == CompareSettings()


def test_each_arm_has_its_shield_and_its_penalties(certificate):
    chosen = runs_of(
        certificate, arms=ALL_ARMS, seeds=1, mode="switch", intervention_penalty=0.3, violation_penalty=2.0
    )
    loops = {run.arm: run.training_loop for run in chosen}
    modes = {name: loop.shield.mode for name, loop in loops.items() if loop.shield}
    switched = dict.fromkeys(("shielded", "shielded:switch+penalty", "lqr+shielded"), "switch")
    assert modes == switched | {"monitor": "monitor", "shielded:boundary": "boundary"}
    penalized = {name for name, loop in loops.items() if loop.shield and loop.shield.penalty == 0.3}
    assert penalized == {"shielded:switch+penalty"}
    assert {name for name, loop in loops.items() if loop.violation_penalty == 2.0} == {"penalized"}


def test_several_algorithms_train_every_arm_and_name_their_rows(certificate):
    settings = CompareSettings(algorithms=("PPO", "SAC"), hyperparams={"n_envs": 3})
    names = full_names(("unshielded", "lqr", "PPO-lagrangian", "shielded"), settings)
    arms = ("PPO unshielded", "SAC unshielded", "lqr", "PPO lagrangian", "PPO shielded", "SAC shielded")
    assert names == arms
    settings, loop = settings.completed, LoopConfig(env=CRUISE)
    require_arms(settings, loop, names)
    runs = {name: run_of_arm(settings, loop, certificate, name, 0) for name in names}
    for name in (*arms[:2], *arms[3:]):
        algorithm = name[:3]
        expected = complete_hyperparams(algorithm, tuned_hyperparams(CRUISE, algorithm)) | {"n_envs": 3}
        assert (runs[name].algorithm, runs[name].settings, runs[name].arm) == (algorithm, expected, name)
    assert len({run.steps for run in runs.values()}) == 1
    assert runs["SAC shielded"].loop.shield
    assert not runs["SAC unshielded"].loop.shield
    results = [replace(result([1.0], [0]), arm=name) for name in names]
    rows = episodes_table(results, algorithm="PPO").set_index("arm")["algorithm"]
    assert rows.to_dict() == {name: "SAC" if name.startswith("SAC") else "PPO" for name in names}


@pytest.mark.parametrize(("arm", "algorithms"), [("SAC-shielded", ("PPO",)), ("TD3 unshielded", ("PPO", "SAC"))])
def test_an_arm_of_another_algorithm_is_refused(arm, algorithms):
    with pytest.raises(ValueError, match="must be one of several in --algorithms"):
        require_arms(CompareSettings(algorithms=algorithms), LoopConfig(env=CRUISE), [arm])


def result(returns, violations, interventions=0, index=0):
    episodes = [
        episode(i, r, v, 2 * v, interventions) for i, (r, v) in enumerate(zip(returns, violations, strict=True))
    ]
    return RunResult("arm", index, 100, 4, 20, [], episodes)


def test_summary_of_an_arm_adds_up():
    summary = arm_summary(
        [result([1.0, 3.0], [0, 2], 5), result([5.0, 7.0], [0, 0], 5, index=1)], None, fixed_policy=False
    )
    assert summary["train_steps"] == 200
    assert summary["train_violation_steps"] == 8
    assert summary["train_intervention_rate"] == 0.2
    assert summary["eval_violating_episodes"] == 1
    assert summary["eval_violation_steps"] == 2
    assert summary["eval_estimate_violation_steps"] == 4
    assert summary["eval_return_mean"] == 4.0
    assert summary["intervention_rate"] == 0.5
    assert summary["eval_return_by_run"] == [2.0, 6.0]
    assert summary["eval_return_ci95"][1] - 4.0 == pytest.approx(12.706 * 2.0, rel=1e-3)  # t with one degree of freedom


def test_paired_differences_are_those_of_runs_with_equal_index():
    unshielded = [result([0.0, 2.0], [1, 1]), result([10.0, 12.0], [1, 0], index=1)]
    shielded = [result([7.0, 9.0], [0, 0], index=1), result([-1.0, 1.0], [0, 0])]
    runs = [replace(run, arm="unshielded") for run in unshielded] + [replace(run, arm="shielded") for run in shielded]
    difference = paired_differences(episodes_table(runs), "unshielded")["shielded"]
    assert difference["return_mean"] == -2.0  # of -1 and -3
    assert difference["return_ci95"][1] + 2.0 == pytest.approx(12.706, rel=1e-3)
    assert difference["return_bootstrap_ci95"] == [-3.0, -1.0]
    assert difference["violating_episodes"] == -3
    assert difference["violating_episodes_by_run"] == [-2, -1]


def test_policies_that_are_the_same_in_all_runs_are_paired_by_episodes():
    plain = [result([0.0, 2.0], [1, 0]), result([10.0, 13.0], [0, 0], index=1)]
    other = [result([1.0, 4.0], [0, 0]), result([11.0, 17.0], [0, 0], index=1)]
    runs = [replace(run, arm="lqr") for run in plain] + [replace(run, arm="lqr+shielded") for run in other]
    by_episodes = paired_differences(episodes_table(runs), "lqr")["lqr+shielded"]
    half = 3.18245 * np.std([1.0, 2.0, 1.0, 4.0], ddof=1) / 2.0
    np.testing.assert_allclose(by_episodes["return_ci95"], [2.0 - half, 2.0 + half], rtol=1e-3)
    assert by_episodes["return_ci95_over"] == "episodes"
    learned = [replace(run, arm="shielded") if run.arm == "lqr+shielded" else run for run in runs]
    by_runs = paired_differences(episodes_table(learned), "lqr")["shielded"]
    assert (by_runs["return_mean"], by_runs["return_ci95_over"]) == (2.0, "runs")
    assert by_runs["return_ci95"][1] == pytest.approx(2.0 + 12.706 * 0.5, rel=1e-3)
