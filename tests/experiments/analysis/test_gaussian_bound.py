"""What `ncs compare --noise gaussian` says: episodes that left the safe set, next to the bound on their probability."""

from dataclasses import replace

import numpy as np
import pytest

from agents.results import Episode
from experiments.analysis.episodes import arm_summaries, arm_summary
from experiments.analysis.statistics import clopper_pearson, gaussian_sentences, gaussian_summary, rounded_up
from experiments.commands.compare import findings_of, gaussian_noise_of
from experiments.runs.arms import run_of_arm
from experiments.runs.loops import certificate_of, loop_config
from experiments.runs.training_run import RunResult
from experiments.settings import CompareSettings
from ncs_gym import Channel, bound_violation_probability, register_plant
from tests.product import linear_plant

# Its safe box is 2 % wider than the bound of its noise: a draw that leaves its ellipsoid by more makes the state leave.
DECLARED = {
    **{"A": 0.01 * np.eye(2), "B": [[1e-3], [0.0]], "u_max": 1.0, "dt": 0.1, "delta": 2e-3},
    **{"process_noise_cov": 0.1 * np.eye(2), "sensor_bound": 1e-3, "initial_bound": 1e-3},
}
RADIUS = np.sqrt(linear_plant(box=[1.0, 1.0], **DECLARED).disturbance.shape_matrix[0, 0])
PLANT, CHANNEL, STEPS = linear_plant(box=2 * [1.02 * RADIUS], **DECLARED), Channel(loss=0.3), 60
register_plant("Tests/Tight-v0", PLANT, channel=CHANNEL, max_episode_steps=STEPS)


def episode(level):
    return Episode(0, 200, 0.0, 0, 0, 0, True, level)


def summary_of_episodes(episodes):
    run = RunResult("shielded", 0, 0, 0, 0, [], episodes)
    return arm_summary([run], "project", fixed_policy=False)


def test_episodes_outside_the_safe_set_are_counted_with_their_exact_interval():
    episodes = [episode(level) for level in (0.2, 1.0, 1.0 + 1e-9, 7.0, float("nan"))]
    summary = gaussian_summary(0.25, 200, {"shielded": summary_of_episodes(episodes)})
    assert summary["arms"]["shielded"] == {"episodes": 5, "episodes_outside_set": 3, "rate_ci95": clopper_pearson(3, 5)}
    (sentence,) = gaussian_sentences(summary)
    assert "3 of 5 evaluation episodes [14.66, 94.73 %]" in sentence
    assert "at most 0.25 for an episode of 200 steps" in sentence
    assert "says nothing" in gaussian_sentences(summary | {"bound_violation_probability": 1.0})[-1]


@pytest.mark.parametrize(
    ("bound", "text"), [(301e-9, "3.1e-07"), (0.25, "0.25"), (0.2501, "0.26"), (1.0, "1"), (0.0, "0")]
)
def test_printed_bound_is_no_smaller_than_the_bound(bound, text):
    assert rounded_up(bound) == text
    assert float(text) >= bound


@pytest.fixture(scope="module")
def setup():
    loop = loop_config("Tests/Tight-v0", noise="gaussian")
    return loop, certificate_of(loop, safe_set="ellipsoid")


@pytest.mark.slow
def test_comparison_under_gaussian_noise_plays_it_and_states_the_bound(setup):
    settings = CompareSettings(env="Tests/Tight-v0", noise="gaussian", episodes=600)
    run = replace(run_of_arm(settings, *setup, "shielded", 0), policy_kind="zero input")
    assert run.loop.single().unwrapped.noise == run.loop.vector(2).unwrapped.single.noise == "gaussian"
    bounded = replace(run, loop=run.loop.with_kwargs(noise=None))
    assert run.key != bounded.key
    result = run.execute(lambda steps: None)
    arms = arm_summaries([result, replace(result, arm="monitor")], "project")
    summary = gaussian_noise_of(*setup, arms)
    assert (
        summary["bound_violation_probability"]
        == bound_violation_probability(PLANT, CHANNEL, STEPS)
        == pytest.approx(STEPS * 2e-3)
    )
    arm = summary["arms"]["shielded"]
    assert 0.5 < arm["episodes_outside_set"] / arm["episodes"] / summary["bound_violation_probability"] <= 1.0
    assert list(summary["arms"]) == ["shielded"]
    assert max(each.times_safe_set for each in bounded.execute(lambda steps: None).episodes) <= 1.0


def test_proof_is_not_said_to_have_held_under_gaussian_noise():
    arm = {"shielded": True, "eval_violation_rate_ci95": [0.0, 0.1], "guaranteed_episodes": 3, "eval_episodes": 4}
    arm |= {"mode": "project", "times_safe_set": 1.2, "eval_violating_episodes": 0, "intervention_rate": 0.1}
    arm["train_intervention_rate"] = 0.1
    summary = {"arms": {"shielded": arm}, "references": {}, "paired_differences": {"baseline": "", "arms": {}}}
    assert "the proof held in 3 of 4" in findings_of(summary)[0]
    assert "no broken assumption was seen in 3 of 4" in findings_of(summary | {"gaussian_noise": {}})[0]
