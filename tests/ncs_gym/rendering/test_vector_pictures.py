"""Vector environments draw the environment that was chosen, with what their shield does in it."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers.vector import RecordVideo
from stable_baselines3.common.vec_env import VecVideoRecorder

from agents import SB3VecEnv
from shields import SafetyShield, VectorSafetyShield
from tests.certificates import certificate_of

CRUISE = "ncs_gym/TruckTrailerCruise-v0"
pytest.importorskip("pygame")


def vector(**settings):
    return gym.make_vec(CRUISE, num_envs=3, render_mode="rgb_array", **settings)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_chosen_environment_is_drawn_as_a_single_one_would_be(mode):
    env = vector(rendered_env=2, max_episode_steps=11, autoreset_mode=mode)
    shield = VectorSafetyShield(env, certificate_of(env.unwrapped.plant))
    single = SafetyShield(gym.make(CRUISE, render_mode="rgb_array"), shield.certificate)
    _, info = shield.reset(seed=0)
    single.reset(options={"state": info["state"][2]})
    assert shield.render()[0].shape == single.render().shape
    for _ in range(30):
        info = shield.step(np.ones((3, 1)))[-1]
        record = env.unwrapped.single.renderer.frame_record()
        np.testing.assert_array_equal(record.state, info["state"][2])
        assert record.step == env.unwrapped.steps[2]
        assert record.annotation.interventions == info["episode_interventions"][2]
        sent = [packet.stamp for packet in record.packets]
        assert sent == [step for step in range(1, record.step + 1) if step % 2 == 0]
    assert len(shield.render()) == 3


def test_recorders_of_gymnasium_and_stable_baselines3_take_it(tmp_path):
    pytest.importorskip("moviepy")
    env = RecordVideo(
        vector(), str(tmp_path / "one"), step_trigger=lambda step: step == 0, video_length=3, record_first_only=True
    )
    env.reset(seed=0)
    for _ in range(5):
        env.step(env.action_space.sample())
    env.close()
    recorder = VecVideoRecorder(SB3VecEnv(vector()), str(tmp_path / "two"), lambda step: step == 0, video_length=3)
    recorder.reset()
    for _ in range(5):
        recorder.step(np.zeros((3, 1), np.float32))
    recorder.close()
    assert list((tmp_path / "one").glob("*.mp4"))
    assert list((tmp_path / "two").glob("*.mp4"))
