"""The picture: what it shows is looked for in its pixels."""

import copy
import pickle
import subprocess
import sys
import warnings
from dataclasses import replace
from functools import cache

import gymnasium as gym
import numpy as np
import pygame
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordVideo
from stable_baselines3.common.env_util import make_vec_env

from ncs_gym import Annotation, Channel, Ellipsoid, LinearPlant
from ncs_gym.registration import ENVIRONMENTS, needing_extras
from ncs_gym.rendering import PacketRecord, theme
from ncs_gym.rendering.episode_record import RECENT_STEPS
from ncs_gym.rendering.renderer import _Picture
from shields import SafetyShield, synthesize
from tests.plants import random_plant

CRUISE = "ncs_gym/TruckTrailerCruise-v0"
DRAWN = [env_id for env_id in ENVIRONMENTS if env_id not in needing_extras()]
OWN = [env_id for env_id in DRAWN if "Linear" not in env_id]
SAFE_SET = Ellipsoid(4.0 * np.eye(2))


def make(env_id=CRUISE, render_mode="rgb_array", **settings):
    if env_id == "ncs_gym/LinearNCS-v0":
        settings.setdefault("plant", random_plant(0, 3, 2, 2))
    return gym.make(env_id, render_mode=render_mode, **settings)


@cache
def resting_record():
    """The truck at rest, before its first step."""
    env = make().unwrapped
    env.reset(seed=0, options={"state": np.zeros(2)})
    return replace(env.renderer.frame_record(), estimate=np.zeros(2), error_shape=1e-6 * np.eye(2))


def record(state=(0.0, 0.0), **changes):
    """A frame that shows nothing but a state, and what changes it."""
    state = np.array(state, dtype=float)
    violated = bool((np.abs(state) > 2.0).any())
    return replace(
        resting_record(), **{"state": state, "estimate": state, "violated": violated, "path": state[None]} | changes
    )


@pytest.fixture(scope="module")
def picture(loaded):
    return _Picture(loaded, scale=1)


def pixels_of(picture, frame):
    return picture.draw(frame).pixels()


def count(pixels, color, rect, off=24):
    """How many pixels of a rectangle are close to a color."""
    x, y, w, h = (round(value) for value in rect)
    part = pixels[y : y + h, x : x + w].astype(int)
    return int((np.abs(part - np.array(color)).max(axis=-1) <= off).sum())


def changed(first, second, rect):
    x, y, w, h = (round(value) for value in rect)
    return int((first != second)[y : y + h, x : x + w].any(axis=-1).sum())


@pytest.mark.parametrize("env_id", DRAWN)
def test_every_environment_draws_frames_that_follow_it(env_id):
    env = make(env_id)
    env.reset(seed=0)
    frames = [env.render()]
    for _ in range(3):
        env.step(env.action_space.sample())
        frames.append(env.render())
    for frame in frames:
        assert frame.shape == (theme.HEIGHT, theme.WIDTH, 3)
        assert frame.dtype == np.uint8
    np.testing.assert_array_equal(env.render(), frames[-1])
    for rect in (theme.HEADER, theme.PLANT_VIEW, theme.PLANE, theme.PANEL):
        assert changed(frames[0], frames[-1], rect) > 0
    assert frames[-1].flags.writeable


@pytest.mark.parametrize("env_id", ["ncs_gym/CartPole-v0", "ncs_gym/BatchReactor-v0"])
def test_gymnasiums_checker_renders_without_a_warning(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(env_id).unwrapped)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (2, 5), (12, 2)])
def test_plants_of_any_size_are_drawn(n, m):
    env = make("ncs_gym/LinearNCS-v0", plant=random_plant(0, n, m), channel=Channel(loss=0.3, jitter=3))
    env.reset(seed=0)
    env.unwrapped.annotate(Annotation(safe_set=Ellipsoid(np.eye(n)), label="project"))
    env.step(env.action_space.sample())
    assert count(env.render(), theme.SAFE_FILL, theme.PLANE) > 1000


def test_oblique_limits_are_drawn_as_they_are():
    common = {"A": 0.5 * np.eye(2), "B": np.ones((2, 1)), "u_max": 1.0, "dt": 0.1, "gamma": 1e-4}
    plant = LinearPlant(box=np.array([[1.0, 1.0], [1.0, -1.0]]), **common)
    env = make("ncs_gym/LinearNCS-v0", plant=plant).unwrapped
    env.reset(seed=0)
    frame, plane = env.render(), env.renderer._picture._plane
    points = np.array([(0.85, 0.1), (-0.1, -0.85), (0.6, 0.6), (-0.6, 0.55)])  # inside, inside, outside, outside
    colors = [tuple(frame[round(y), round(x)]) for x, y in plane.pixels_of(points)]
    assert colors == [theme.PAPER, theme.PAPER, theme.DANGER_FILL, theme.DANGER_FILL]


def test_coupling_turns_red_near_its_limit(picture):
    band = theme.Rect(195, 150, 60, 35)
    red = [count(pixels_of(picture, record((stretch, 0.0))), theme.DANGER, band) for stretch in (0.0, 1.0, 1.95, -1.95)]
    mark = 20  # pixels of the limit's dashed mark at most
    assert red[0] < mark
    assert red[1] < mark
    assert min(red[2:]) > mark + 100


def test_numbers_are_red_only_beyond_their_limit_and_a_state_beyond_the_axes_is_said_to_be():
    env = make("ncs_gym/BatchReactor-v0").unwrapped
    env.reset(seed=0)
    limit, picture = env.plant.half_widths[0], _Picture(env.plant, scale=1)

    def red_of(position):
        state = np.array([position, 0.0, 0.0, 0.0])
        frame = replace(env.renderer.frame_record(), state=state, estimate=state, path=state[None], violated=False)
        pixels, bar = pixels_of(picture, frame), picture._drawing._bar(0)
        number = theme.Rect(bar.right + 6, bar.y, 70, 14)
        corner = theme.Rect(theme.PLANE.right - 150, theme.PLANE.y + 2, 146, 16)
        return count(pixels, theme.DANGER, number), count(pixels, theme.DANGER, corner)

    near, beyond, far = (red_of(fraction * limit) for fraction in (0.97, 1.02, 3.0))
    assert near[0] == 0
    assert min(beyond[0], far[0]) > 20
    assert near[1] == beyond[1] < 5
    assert far[1] > 100


def test_coupling_stretches(picture):
    fronts = []
    for stretch in (-1.0, 0.0, 1.0):
        row = pixels_of(picture, record((stretch, 0.0)))[150].astype(int)
        fronts.append(np.flatnonzero(np.abs(row - np.array(theme.BODYWORK)).max(axis=-1) < 24).max())
    assert fronts[1] - fronts[0] == pytest.approx(fronts[2] - fronts[1], abs=1)
    assert fronts[1] - fronts[0] == pytest.approx(31, abs=1)


def test_dashed_outline_stands_where_the_estimate_is(picture):
    right, off = record(), record(estimate=np.array([1.0, 0.0]))
    beyond = theme.Rect(485, 100, 60, 85)
    assert count(pixels_of(picture, right), theme.ESTIMATE, beyond) == 0
    assert count(pixels_of(picture, off), theme.ESTIMATE, beyond) > 50


def test_error_ellipse_has_the_size_of_the_bound(picture):
    areas = [
        count(pixels_of(picture, record(error_shape=size**2 * np.eye(2))), theme.ERROR_FILL, theme.PLANE, off=6)
        for size in (0.5, 1.0)
    ]
    pixels_per_unit = theme.PLANE.w * theme.PLANE.h / 6.0**2
    assert areas == pytest.approx([np.pi * 0.25 * pixels_per_unit, np.pi * pixels_per_unit], rel=0.2)


def test_packets_show_whether_they_are_on_time_late_or_lost(picture):
    line = theme.Rect(250, theme.PACKET_LINE - 26, 280, 50)
    at = {"step": 4, "input": np.zeros(1)}
    empty = pixels_of(picture, record(**at))
    seen = {}
    for name, packet in (("new", PacketRecord(4, 4)), ("late", PacketRecord(3, 5)), ("lost", PacketRecord(4, None))):
        frame = pixels_of(picture, record(**at, packets=(packet,)))
        seen[name] = [count(frame, color, line) for color in (theme.ESTIMATE, theme.LATE, theme.DANGER)]
        assert changed(empty, frame, line) > 100
    assert seen["new"][0] > 80
    assert seen["new"][1:] == [0, 0]
    assert seen["late"][1] > 80
    assert seen["lost"][2] > 80
    assert seen["late"][2] == seen["lost"][1] == 0


def test_packets_travel(picture):
    line = theme.Rect(0, theme.PACKET_LINE - 3, theme.WIDTH, 6)
    places = []
    for step in (10, 11, 12):
        frame = pixels_of(picture, record(step=step, packets=(PacketRecord(9, 13),)))
        x, y, w, h = (round(value) for value in line)
        part = frame[y : y + h, x : x + w].astype(int)
        places.append(np.nonzero(np.abs(part - np.array(theme.LATE)).max(axis=-1) < 24)[1].mean())
    assert places[0] + 20 < places[1] < places[2] - 20


def test_packets_are_lost_and_late_as_the_channel_says():
    def packets(channel, steps=12):
        env = make(channel=channel).unwrapped
        env.reset(seed=0)
        for _ in range(steps):
            env.step(np.zeros(1, np.float32))
        return list(env.renderer.frame_record().packets)

    assert packets(Channel(send_period=3)) == [PacketRecord(k, k) for k in (3, 6, 9, 12)]
    assert packets(Channel(delay=2)) == [PacketRecord(k, k + 2) for k in range(1, 13)]
    assert packets(Channel(loss=1.0)) == [PacketRecord(k, None) for k in range(1, 13)]
    mixed = packets(Channel(loss=0.5, jitter=3))
    assert any(each.arrival is None for each in mixed)
    assert len({each.arrival - each.stamp for each in mixed if each.arrival is not None}) > 1


def test_arrivals_are_those_of_the_infos():
    env = make(channel=Channel(loss=0.4, delay=1, jitter=2))
    env.reset(seed=3)
    arrived = [k for k in range(1, 31) if env.step(np.zeros(1, np.float32))[4]["packet_arrived"]]
    packets = env.unwrapped.renderer.frame_record().packets
    assert sorted({each.arrival for each in packets if each.arrival is not None and each.arrival <= 30}) == arrived


def test_phase_plane_shows_the_safe_set_and_its_absence(picture):
    note = Annotation(safe_set=SAFE_SET, label="project")
    with_set, without = pixels_of(picture, record(annotation=note)), pixels_of(picture, record())
    area = np.pi * 4.0 * theme.PLANE.w * theme.PLANE.h / 36.0
    assert count(with_set, theme.SAFE_FILL, theme.PLANE, off=6) == pytest.approx(area, rel=0.15)
    assert count(without, theme.SAFE_FILL, theme.PLANE, off=6) == 0
    smaller = pixels_of(picture, record(annotation=Annotation(safe_set=Ellipsoid(np.eye(2)), label="project")))
    assert count(smaller, theme.SAFE_FILL, theme.PLANE, off=6) == pytest.approx(area / 4.0, rel=0.2)


def test_intervention_shows_in_the_header_and_at_the_input(picture):
    quiet = Annotation(safe_set=SAFE_SET, label="project", proposed=np.array([4.0]))
    acting = replace(quiet, intervened=True, interventions=1)
    frames = [pixels_of(picture, record(step=1, input=np.array([1.0]), annotation=note)) for note in (quiet, acting)]
    bar = theme.Rect(theme.PANEL.x, theme.PANEL.y + 16, theme.PANEL.w, 16)
    beyond = theme.Rect(bar.right - bar.w / 4, bar.y, bar.w / 4, bar.h)  # between the applied input and the proposed
    for rect in (theme.HEADER, bar):
        assert count(frames[1], theme.SHIELD, rect) > count(frames[0], theme.SHIELD, rect) + 100
    assert count(frames[0], theme.SHIELD, beyond) == 0
    assert count(frames[1], theme.SHIELD, beyond) > 60
    assert count(frames[1], theme.SHIELD_FILL, theme.PLANT_VIEW, off=4) > 10_000
    watching = pixels_of(picture, record(step=1, input=np.array([4.0]), annotation=replace(acting, protects=False)))
    assert count(watching, theme.SHIELD_FILL, theme.PLANT_VIEW, off=4) == 0


def test_stored_plan_is_drawn_from_the_estimate_and_named_in_the_legend(picture, loaded):
    note = Annotation(safe_set=SAFE_SET, label="lookahead", plan=np.empty((0, 1)))
    frames = [record(annotation=replace(note, plan=plan)) for plan in (None, note.plan, np.array([[2.0], [2.0]]))]
    shown = [pixels_of(picture, frame) for frame in frames]
    assert [count(each, theme.PLAN, theme.PLANE) > 5 for each in shown] == [False, False, True]
    assert [count(each, theme.PLAN, theme.PANEL) > 5 for each in shown] == [False, True, True]
    states = frames[2].planned_states
    assert states.shape == (3, 2)
    np.testing.assert_allclose(states[2], loaded.A @ loaded.B[:, 0] * 2.0 + loaded.B[:, 0] * 2.0)
    for x, y in picture._plane.pixels_of(states[1:]):
        assert count(shown[2], theme.PLAN, theme.Rect(x - 2, y - 2, 4, 4)) > 4
    assert len(frames[0].planned_states) == len(frames[1].planned_states) == 0


def test_shield_tells_the_picture_what_it_has_in_store(loaded):
    certificate = synthesize(loaded, safe_set="ellipsoid")  # in a polytope hardly a plan is needed
    env = SafetyShield(make(), certificate, mode="lookahead", horizon=3)
    env.reset(seed=0)
    assert env.unwrapped.renderer.frame_record().annotation.plan.shape[0] == 0
    lengths = set()
    for _ in range(30):
        *_, info = env.step(np.ones(1, np.float32))
        record = env.unwrapped.renderer.frame_record()
        assert len(record.annotation.plan) == info["shield_plan_length"]
        lengths.add(info["shield_plan_length"])
    assert max(lengths) > 0
    other = SafetyShield(make())
    other.reset(seed=0)
    assert other.unwrapped.renderer.frame_record().annotation.plan is None


def test_path_and_interventions_are_drawn(picture):
    path = np.array([(-1.5, -1.0), (1.5, -1.0)])
    frames = [pixels_of(picture, record(path=path, interventions=np.array([False, acted]))) for acted in (False, True)]
    assert changed(pixels_of(picture, record()), frames[0], theme.PLANE) > 150
    assert count(frames[0], theme.SHIELD, theme.PLANE) == 0
    assert count(frames[1], theme.SHIELD, theme.PLANE) > 15


def test_violation_shows(picture):
    safe, over = pixels_of(picture, record()), pixels_of(picture, record((2.5, 0.0), violations=1))
    assert count(safe, theme.DANGER, theme.HEADER) == 0
    assert count(over, theme.DANGER, theme.HEADER) > 1000
    assert count(over, theme.DANGER_FILL, theme.PLANT_VIEW, off=4) > 10_000


def test_states_far_outside_are_drawn_at_the_edge(picture):
    far = np.array([1e9, -1e9])
    frame = pixels_of(picture, record((1e9, -1e9), estimate=far, error_shape=1e30 * np.eye(2), path=far[None]))
    assert count(frame, theme.DANGER, theme.Rect(theme.PLANE.right - 20, theme.PLANE.bottom - 20, 20, 20)) > 20


def test_annotation_lasts_one_step():
    env = make().unwrapped
    note = Annotation(safe_set=SAFE_SET, label="project")
    env.annotate(note)
    env.reset(seed=0)
    assert env.renderer.frame_record().annotation is note
    env.step(np.zeros(1, np.float32))
    assert env.renderer.frame_record().annotation is None
    env.annotate(note)
    for expected in (note, None):
        env.step(np.zeros(1, np.float32))
        assert env.renderer.frame_record().annotation is expected


def test_frame_shows_the_recent_steps_of_this_episode_only():
    env = make()
    env.reset(seed=0)
    for _ in range(2 * RECENT_STEPS):
        env.step(np.zeros(1, np.float32))
    assert len(env.unwrapped.renderer.frame_record().path) == RECENT_STEPS
    env.reset()
    assert len(env.unwrapped.renderer.frame_record().path) == 1
    assert not env.unwrapped.renderer.frame_record().packets


def test_drawing_does_not_change_the_episode():
    runs = []
    for mode in (None, "rgb_array"):
        env = make(render_mode=mode)
        env.reset(seed=4)
        infos = []
        for _ in range(20):
            infos.append(env.step(np.ones(1, np.float32))[4])
            if mode:
                env.render()
        runs.append(np.concatenate([np.ravel(value) for info in infos for value in info.values()]))
    np.testing.assert_array_equal(*runs)


def test_writing_into_an_info_does_not_change_the_picture():
    env = make()
    frames = []
    for spoiled in (False, True):
        for info in (env.reset(seed=0)[1], env.step(np.ones(1, np.float32))[4]):
            if spoiled:
                for key in ("state", "estimate", "error_shape", "input"):
                    info[key][:] = 1.0
        frames.append(env.render())
    np.testing.assert_array_equal(*frames)


def test_record_video_writes_a_file(tmp_path):
    env = RecordVideo(make(), str(tmp_path / "videos"), video_length=5)
    env.reset(seed=0)
    for _ in range(6):
        env.step(np.zeros(1, np.float32))
    env.close()
    (file,) = tmp_path.glob("videos/*.mp4")
    assert file.stat().st_size > 1000


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


def test_rendering_without_a_mode_warns_and_before_reset_raises():
    env = make(render_mode=None).unwrapped
    with pytest.warns(UserWarning, match="without a render mode"):
        assert env.render() is None
    with pytest.raises(gym.error.ResetNeeded):
        make().unwrapped.render()


def test_sb3_makes_environments_that_can_be_drawn_without_a_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        envs = make_vec_env(CRUISE, n_envs=2, seed=0)
        envs.reset()
        assert envs.render().shape == (2 * theme.HEIGHT, theme.WIDTH, 3)


def test_drawn_environments_can_be_copied_and_pickled():
    env = make().unwrapped
    env.reset(seed=0)
    frame = env.render()
    for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        np.testing.assert_array_equal(twin.render(), frame)
