"""Pictures: what they show is looked for in their pixels, drawn from the data of a frame."""

import copy
import pickle
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pygame
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordVideo
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecVideoRecorder

from ncs_gym import Channel, Ellipsoid
from ncs_gym.registration import ENVIRONMENTS, needing_extras
from ncs_gym.rendering import Annotation, theme
from ncs_gym.rendering.episode_record import PacketRecord
from ncs_gym.rendering.renderer import PhasePlane
from tests.plants import random_plant
from tests.product import safety_shield

CRUISE, REACTOR = "ncs_gym/TruckTrailerCruise-v0", "ncs_gym/BatchReactor-v0"
DRAWN = [env_id for env_id in ENVIRONMENTS if env_id not in needing_extras()]


def make(env_id=CRUISE, render_mode="rgb_array", **settings):
    if env_id == "ncs_gym/LinearNCS-v0":
        settings.setdefault("plant", random_plant(0, 3, 2, 2))
    return gym.make(env_id, render_mode=render_mode, **settings)


def part_of(pixels, rect):
    x, y, w, h = (round(value) for value in rect)
    return pixels[y : y + h, x : x + w].astype(int)


def count(pixels, color, rect, off=24):
    """How many pixels of a rectangle are close to a color."""
    return int((np.abs(part_of(pixels, rect) - np.array(color)).max(axis=-1) <= off).sum())


def changed(first, second, rect):
    return int((part_of(first, rect) != part_of(second, rect)).any(axis=-1).sum())


def steps_of(env, count, action=0.0):
    """The infos of some steps with the same action."""
    return [env.step(np.full(env.action_space.shape, action, np.float32))[4] for _ in range(count)]


@pytest.mark.cases(2)
@pytest.mark.parametrize("env_id", DRAWN)
def test_every_environment_draws_frames_that_follow_it(env_id):
    env = make(env_id)
    env.reset(seed=0)
    frames = [env.render()]
    env.action_space.seed(0)
    for _ in range(6):  # behind a downlink inputs are late; gentle ones end no episode
        env.step(0.3 * env.action_space.sample())
        frames.append(env.render())
    for frame in frames:
        assert frame.shape == (theme.HEIGHT, theme.WIDTH, 3)
        assert frame.dtype == np.uint8
    np.testing.assert_array_equal(env.render(), frames[-1])
    for rect in (theme.HEADER, theme.PLANT_VIEW, theme.PLANE, theme.PANEL):
        assert changed(frames[0], frames[-1], rect) > 0
    assert frames[-1].flags.writeable


def test_gymnasiums_checker_renders_without_a_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(REACTOR).unwrapped)
        envs = make_vec_env(CRUISE, n_envs=2, seed=0)
        envs.reset()
        assert envs.render().shape == (2 * theme.HEIGHT, theme.WIDTH, 3)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (12, 2)])
def test_plants_of_any_size_are_drawn_and_what_a_shield_does(n, m):
    env = make("ncs_gym/LinearNCS-v0", plant=random_plant(0, n, m), channel=Channel(loss=0.3, jitter=3))
    env.reset(seed=0)
    acting = {"proposed": 9.0 * np.ones(m), "intervened": True, "interventions": 1, "protects": n > 1}
    note = Annotation(safe_set=Ellipsoid(np.eye(n)), label="project", **acting)
    *_, info = env.step(env.action_space.sample())
    env.unwrapped.renderer.episode.add(info, None, None, note)
    frame = env.render()
    assert count(frame, theme.SAFE_FILL, theme.PLANE) > 1000
    assert (count(frame, theme.SHIELD, theme.HEADER) > 2000) is (n > 1)


def test_plan_is_drawn_through_the_states_that_follow_from_its_inputs(loaded):
    env = make()
    env.reset(seed=0, options={"state": np.zeros(2)})
    episode, frames = env.unwrapped.renderer.episode, []
    episode.estimate = np.zeros(2)
    for plan in (None, np.empty((0, 1)), np.array([[2.0], [2.0]])):
        episode.annotation = Annotation(safe_set=Ellipsoid(4.0 * np.eye(2)), label="lookahead", plan=plan)
        frames.append(env.render())
    assert [count(each, theme.PLAN, theme.PLANE) > 5 for each in frames] == [False, False, True]
    np.testing.assert_allclose(episode.planned_states[2], loaded.A @ loaded.B[:, 0] * 2.0 + loaded.B[:, 0] * 2.0)
    for x, y in PhasePlane(loaded).pixels_of(episode.planned_states[1:]):
        assert count(frames[2], theme.PLAN, theme.Rect(x - 2, y - 2, 4, 4)) > 4


def test_outline_of_a_set_is_around_its_projection_and_touches_it():
    shield = safety_shield(gym.make("ncs_gym/CartPole-v0"))
    plant, polytope = shield.unwrapped.plant, shield.certificate.safe_set
    corners = PhasePlane(plant)._outline(polytope)
    directions = np.zeros((8, 4))
    directions[:, [2, 3]] = np.column_stack([np.cos(np.arange(8)), np.sin(np.arange(8))])
    tight = (directions[:, [2, 3]] @ corners.T).max(axis=1) / polytope.support(directions)
    assert (tight >= 1.0 - 1e-9).all()
    assert (tight <= 1.01).all()


def test_packets_are_lost_and_late_as_the_channel_says():
    def packets(channel, steps=12):
        env = make(channel=channel).unwrapped
        env.reset(seed=0)
        steps_of(env, steps)
        return list(env.renderer.episode.packets)

    assert packets(Channel(on_request=True)) == []
    assert packets(Channel(send_period=3)) == [PacketRecord(k, k) for k in (3, 6, 9, 12)]
    assert packets(Channel(delay=2)) == [PacketRecord(k, k + 2) for k in range(1, 13)]
    assert packets(Channel(loss=1.0)) == [PacketRecord(k, None) for k in range(1, 13)]
    mixed = packets(Channel(loss=0.5, jitter=3))
    assert any(each.arrival is None for each in mixed)
    assert len({each.arrival - each.stamp for each in mixed if each.arrival is not None}) > 1


def test_drawing_does_not_change_the_episode_nor_writing_into_an_info_the_picture():
    runs, frames = [], []
    for mode, spoiled in ((None, False), ("rgb_array", False), ("rgb_array", True)):
        env = make(render_mode=mode)
        infos = [env.reset(seed=4)[1]]
        for _ in range(10):
            infos += steps_of(env, 1, 1.0)
            frames += [env.render()] if mode else []
            runs.append([np.copy(value) for value in infos[-1].values()])
            for key in ("state", "estimate", "error_shape", "input") if spoiled else ():
                infos[-1][key][:] = 1.0
    for one, other, third in zip(runs[:10], runs[10:20], runs[20:], strict=True):
        for values in zip(one, other, third, strict=True):
            np.testing.assert_array_equal(values[0], values[1])
            np.testing.assert_array_equal(values[0], values[2])
    np.testing.assert_array_equal(frames[:10], frames[10:])


def test_recorders_of_gymnasium_and_stable_baselines3_write_files(tmp_path):
    settings = {"video_length": 3}
    env = RecordVideo(make(), str(tmp_path / "one"), **settings)
    env.reset(seed=0)
    steps_of(env, 4)
    env.close()
    assert next((tmp_path / "one").glob("*.mp4")).stat().st_size > 1000
    many = make_vec_env(CRUISE, n_envs=2, seed=0)
    recorder = VecVideoRecorder(many, str(tmp_path / "sb3"), lambda step: step == 0, **settings)
    recorder.reset()
    for _ in range(4):
        recorder.step(np.zeros((2, 1), np.float32))
    recorder.close()
    assert list((tmp_path / "sb3").glob("*.mp4"))


def test_human_mode_shows_every_step_and_closes(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = make(render_mode="human")
    env.reset(seed=0)
    first = pygame.surfarray.array3d(pygame.display.get_surface())
    assert first.shape == (theme.WIDTH, theme.HEIGHT, 3)
    env.step(np.ones(1, np.float32))
    assert (pygame.surfarray.array3d(pygame.display.get_surface()) != first).any()
    assert env.render() is None
    env.close()
    assert not pygame.display.get_init()
    env.reset()
    assert pygame.display.get_init()
    env.close()


@pytest.mark.slow
def test_images_need_no_display_and_leave_the_driver_alone(monkeypatch):
    monkeypatch.delenv("SDL_VIDEODRIVER", raising=False)
    code = """if True:
        import os, sys
        import gymnasium as gym, ncs_gym
        env = gym.make("ncs_gym/TruckTrailer-v0", render_mode="rgb_array")
        env.reset(seed=0)
        assert "pygame" not in sys.modules
        env.render()
        assert not sys.modules["pygame"].display.get_init()
        assert "SDL_VIDEODRIVER" not in os.environ
    """
    subprocess.run([sys.executable, "-c", code], check=True)


def test_missing_pygame_is_one_sentence_and_only_for_who_draws(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    env = make()
    env.reset(seed=0)
    env.step(np.zeros(1, np.float32))
    with pytest.raises(gym.error.DependencyNotInstalled, match=r"needs pygame-ce: in .* -e '\.\[render\]'$"):
        env.render()


def test_drawn_environments_can_be_copied_and_pickled():
    env = make().unwrapped
    env.reset(seed=0)
    frame = env.render()
    for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        np.testing.assert_array_equal(twin.render(), frame)
