"""Episodes under Gaussian noise that left the safe set, next to the bound on their probability."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.analysis.episodes import arm_summaries
from experiments.commands.compare import CompareSettings
from experiments.runs.arms import run_of_arm
from experiments.runs.loops import certificate_of, loop_config
from ncs_gym import Channel, register_plant
from ncs_gym.network.gaussian_bound import bound_violation_probability
from tests.product import linear_plant

# Its safe box is 2 % wider than the bound of its noise: a draw that leaves its ellipsoid by more makes the state leave.
DECLARED = {
    **{"A": 0.01 * np.eye(2), "B": [[1e-3], [0.0]], "u_max": 1.0, "dt": 0.1, "delta": 2e-3},
    **{"process_noise_cov": 0.1 * np.eye(2), "sensor_bound": 1e-3, "initial_bound": 1e-3},
}
RADIUS = np.sqrt(linear_plant(box=[1.0, 1.0], **DECLARED).disturbance.shape_matrix[0, 0])
PLANT, CHANNEL, STEPS = linear_plant(box=2 * [1.02 * RADIUS], **DECLARED), Channel(loss=0.3), 60
register_plant("Tests/Tight-v0", PLANT, channel=CHANNEL, max_episode_steps=STEPS)


@pytest.fixture(scope="module")
def setup():
    loop = loop_config("Tests/Tight-v0", noise="gaussian")
    return loop, certificate_of(loop, safe_set="ellipsoid")


@pytest.mark.slow
def test_episodes_leave_the_safe_set_no_more_often_than_the_bound_says(setup):
    settings = CompareSettings(env="Tests/Tight-v0", episodes=600)
    run = replace(run_of_arm(settings, *setup, "shielded", 0), policy_kind="zero input")
    assert run.loop.single().unwrapped.noise == run.loop.vector(2).unwrapped.single.noise == "gaussian"
    bounded = replace(run, loop=run.loop.with_kwargs(noise=None))
    assert run.key != bounded.key
    arm = arm_summaries([run.execute(lambda steps: None)], "project")["shielded"]
    bound = bound_violation_probability(PLANT, CHANNEL, STEPS)
    assert bound == pytest.approx(STEPS * 2e-3)
    assert 0.5 < arm["eval_episodes_outside_set"] / arm["eval_episodes"] / bound <= 1.0
    assert max(each.times_safe_set for each in bounded.execute(lambda steps: None).episodes) <= 1.0
