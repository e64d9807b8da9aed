from dataclasses import replace
from pathlib import Path

import pytest

from agents.evaluation import Episode
from agents.settings import PPOSettings
from experiments.compare import _check, _prepare, _units
from experiments.settings import CompareSettings
from experiments.summary import summarize_arm, way_covered
from experiments.unit import UnitResult


def units(certificate, **change):
    return _units(replace(CompareSettings(out=Path("out")), **change), certificate)


def test_runs_with_equal_numbers_are_paired_across_arms_and_differ_from_each_other(certificate):
    seeds: dict = {}
    for unit in units(certificate):
        seeds.setdefault(unit.index, set()).add((unit.training_seed, unit.evaluation_seed))
    assert {len(pairs) for pairs in seeds.values()} == {1}
    flat = [number for pairs in seeds.values() for pair in pairs for number in pair]
    assert len(set(flat)) == len(flat) == 6


def test_another_seed_draws_everything_anew(certificate):
    first, second = ({unit.training_seed for unit in units(certificate, seed=seed)} for seed in (0, 1))
    assert not first & second


@pytest.mark.parametrize("seed", [0, 10**9, 2**63])
def test_any_seed_is_usable(certificate, seed):
    for unit in units(certificate, seed=seed):
        assert 0 <= unit.training_seed < 2**31
        assert 0 <= unit.evaluation_seed < 2**31


def test_mode_and_penalty_reach_the_shield_of_the_shielded_arm_only(certificate):
    for unit in units(certificate, mode="switch", penalty=0.3):
        if unit.arm == "shielded":
            assert (unit.shielding.mode, unit.shielding.penalty) == ("switch", 0.3)
            assert unit.shielding.certificate is certificate
        else:
            assert unit.shielding is None


def test_settings_reach_every_run(certificate):
    for unit in units(certificate, steps=7, episodes=9, ppo=PPOSettings(envs=3)):
        assert (unit.steps, unit.episodes, unit.ppo.envs) == (7, 9, 3)


def result(returns, violations, interventions=0):
    episodes = [
        Episode(i, 10, r, v, interventions, True, 0.5) for i, (r, v) in enumerate(zip(returns, violations, strict=True))
    ]
    return UnitResult("arm", 0, 100, 4, 20, [], episodes, None)


def test_summary_of_an_arm_adds_up():
    summary = summarize_arm([result([1.0, 3.0], [0, 2], 5), result([5.0, 7.0], [0, 0], 5)], fixed_policy=False)
    assert summary["train_steps"] == 200
    assert summary["train_violation_steps"] == 8
    assert summary["train_intervention_rate"] == 0.2
    assert summary["eval_violating_episodes"] == 1
    assert summary["eval_violation_steps"] == 2
    assert summary["eval_return_mean"] == 4.0
    assert summary["intervention_rate"] == 0.5
    assert summary["eval_return_by_run"] == [2.0, 6.0]
    assert summary["eval_return_ci95"][1] - 4.0 == pytest.approx(12.706 * 2.0, rel=1e-3)  # t with one degree of freedom


def test_interval_of_a_fixed_policy_is_over_episodes():
    runs = [result([1.0, 3.0], [0, 0]), result([5.0, 7.0], [0, 0])]
    fixed = summarize_arm(runs, fixed_policy=True)["eval_return_ci95"]
    assert fixed[1] - 4.0 == pytest.approx(3.182 * 2.582 / 2, rel=1e-3)


def test_way_covered_is_zero_at_the_zero_input_and_one_at_the_unshielded_agent():
    def covered(shielded):
        means = {"unshielded": -5.0, "shielded": shielded, "zero input": -65.0}
        named = {name: {"eval_return_mean": mean} for name, mean in means.items()}
        return way_covered({"arms": named, "references": named})

    assert [covered(value) for value in (-65.0, -5.0, -20.0)] == [0.0, 1.0, 0.75]


def test_earlier_results_are_removed_and_nothing_else(tmp_path):
    kept = ["models/mine", "notes", "tensorboard/other"]
    for name in (*kept, "models/shielded-0", "models/unshielded-2", "tensorboard/shielded-1"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "summary.json").write_text("{}")
    _prepare(tmp_path)
    left = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")}
    assert left == {*kept, "models", "tensorboard", "figures"}


@pytest.mark.parametrize(
    "change", [{"runs": 0}, {"steps": -1}, {"episodes": 0}, {"jobs": 0}, {"seed": -1}, {"penalty": -0.1}]
)
def test_settings_out_of_range_are_refused(change):
    with pytest.raises(ValueError, match=f"--{next(iter(change))} must be"):
        _check(replace(CompareSettings(), **change))
