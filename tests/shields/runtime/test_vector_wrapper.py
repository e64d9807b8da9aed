from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import VectorWrapper
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics

from ncs_gym import NCSVectorEnv
from shields import Decision, SafetyShield, VectorSafetyShield
from shields.runtime.guarantee import (
    OTHER_STEPS,
)
from shields.runtime.vector_wrapper import overridden
from tests import arrays
from tests.certificates import certificate_of
from tests.shields.attacks.cases import CHANNELS, TRUCKS, harmful

KEYS = {
    "shield_intervened",
    "input_proposed",
    "shield_correction",
    "shield_margin",
    "shield_guaranteed",
    "shield_reason",
    "episode_interventions",
}


def test_error_shapes_that_the_environment_forgets_and_meets_again_change_nothing():
    class Forgetful(NCSVectorEnv):
        @property
        def error_shapes(self):
            table, numbers = super().error_shapes
            present, again = np.unique(numbers, return_inverse=True)
            return SimpleNamespace(shapes=table.shapes[present]), again

    runs = []
    for kind in (NCSVectorEnv, Forgetful):
        env = kind(6, plant=TRUCKS["4000 kg"], channel=CHANNELS["overtaking"], max_episode_steps=30)
        shield, rng = VectorSafetyShield(env, certificate_of(env.plant)), np.random.default_rng(0)
        infos = [shield.reset(seed=0)[1]]
        infos += [shield.step(rng.uniform(-1, 1, (6, 1)))[4] for _ in range(60)]
        runs.append(infos)
    for one, other in zip(*runs, strict=True):
        for key, value in one.items():
            arrays.assert_equal(value, other[key])


@pytest.mark.parametrize(
    ("given", "kept"), [(np.float32, np.float32), (np.float64, np.float64), (np.int64, np.float64)]
)
def test_overridden_actions_are_numbers_of_the_callers_kind(given, kept):
    decided = Decision(np.array([[1.0, 3.0]]), np.array([True, False]), *np.zeros((4, 2)))
    actions = overridden(np.array([[1], [1]], given), decided, TRUCKS["4000 kg"])
    assert actions.dtype == kept
    np.testing.assert_array_equal(actions, [[0.25], [1.0]])


def test_steps_behind_the_shields_back_end_the_proof():
    env = VectorSafetyShield(gym.make_vec("ncs_gym/TruckTrailerCruise-v0", num_envs=2))
    env.reset(seed=0)
    env.env.step(np.ones((2, 1), np.float32))
    *_, info = env.step(np.ones((2, 1), np.float32))
    assert not info["shield_guaranteed"].any()
    env.reset()
    assert env.step(np.ones((2, 1), np.float32))[4]["shield_guaranteed"].all()
    with pytest.raises(ValueError, match="actions"):
        env.step(np.full((2, 1), np.nan))
    assert env.step(np.ones((2, 1), np.float32))[4]["shield_guaranteed"].all()


def outwards(shield, info):
    return np.sign(info["estimate"] @ (shield.certificate.M @ shield.unwrapped.plant.B))


def assert_honest(shield, info):
    """No environment is called safe that is not."""
    levels = np.einsum("ei,ij,ej->e", info["state"], shield.certificate.M, info["state"])
    assert (levels[info["shield_guaranteed"]] <= 1.0).all()


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_user_who_changes_what_was_returned_changes_no_decision(mode):
    plant = TRUCKS["4000 kg"]
    settings = {"disturbance": harmful(plant), "max_episode_steps": 30, "autoreset_mode": mode}
    shield, twin = (VectorSafetyShield(NCSVectorEnv(20, plant=plant, **settings), certificate_of(plant)) for _ in "ab")
    _, info = shield.reset(seed=0)
    twin.reset(seed=0)
    for _ in range(60):
        actions = outwards(shield, info)
        for array in info.values():
            if isinstance(array, np.ndarray) and array.dtype != object:
                array[:] = 0
        _, _, _, _, info = shield.step(actions)
        assert_honest(shield, info)
        assert info["shield_guaranteed"].all()
        for key, value in twin.step(actions.copy())[4].items():
            if not key.endswith(("final_info", "final_obs")):
                np.testing.assert_array_equal(info[key], value)


@pytest.mark.parametrize("moved", [True, False])
def test_interrupted_step_promises_nothing_until_a_reset(moved):
    class Breaks(VectorWrapper):
        broken = False

        def step(self, actions):
            result = self.env.step(actions) if moved or not self.broken else None
            if self.broken:
                raise KeyboardInterrupt
            return result

    inner = Breaks(gym.make_vec("ncs_gym/TruckTrailerCruise-v0", num_envs=2))
    env, actions = VectorSafetyShield(inner), np.ones((2, 1), np.float32)
    env.reset(seed=0)
    assert env.step(actions)[4]["shield_guaranteed"].all()
    inner.broken = True
    with pytest.raises(KeyboardInterrupt):
        env.step(actions)
    inner.broken = False
    assert set(env.step(actions)[4]["shield_reason"]) == {OTHER_STEPS}
    assert env.reset(seed=0)[1]["shield_guaranteed"].all()


def test_last_steps_behind_the_shields_back_promise_nothing():
    plant = TRUCKS["4000 kg"]
    env = NCSVectorEnv(50, plant=plant, disturbance=harmful(plant), max_episode_steps=30, autoreset_mode="SameStep")
    shield = VectorSafetyShield(env, certificate_of(plant))
    _, info = shield.reset(seed=0)
    for _ in range(28):
        _, _, _, _, info = shield.step(outwards(shield, info))
    env.step(outwards(shield, info))
    _, _, _, truncated, info = shield.step(outwards(shield, info))
    assert truncated.all()
    assert not info["final_info"]["shield_guaranteed"].any()
    _, _, _, _, info = shield.step(outwards(shield, info))
    assert not info["shield_guaranteed"].any()


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize(
    "rewrite",
    [lambda info: {key: value[::-1] for key, value in info.items() if isinstance(value, np.ndarray)}, lambda info: {}],
    ids=["turned round", "nothing"],
)
def test_no_rewritten_info_changes_a_decision_or_the_guarantee(mode, rewrite):
    class Rewrites(VectorWrapper):
        def reset(self, **options):
            observation, info = self.env.reset(**options)
            return observation, rewrite(info)

        def step(self, actions):
            *rest, info = self.env.step(actions)
            return *rest, rewrite(info)

    plant, shields = TRUCKS["4000 kg"], []
    for layer in (VectorWrapper, Rewrites):
        env = NCSVectorEnv(20, plant=plant, disturbance=harmful(plant), max_episode_steps=30, autoreset_mode=mode)
        shields.append(VectorSafetyShield(layer(env), certificate_of(plant)))
        shields[-1].reset(seed=0)
    for _ in range(60):
        one, other = (shield.step(np.ones((20, 1), np.float32))[4] for shield in shields)
        assert one["shield_guaranteed"].all()
        for key in KEYS:
            np.testing.assert_array_equal(one[key], other[key])


def test_works_under_gymnasiums_vector_wrappers():
    env = gym.make_vec("ncs_gym/TruckTrailerCruise-v0", num_envs=3, max_episode_steps=20)
    env = NormalizeObservation(RecordEpisodeStatistics(VectorSafetyShield(env)))
    env.reset(seed=0)
    episodes = 0
    for _ in range(50):
        *_, info = env.step(env.action_space.sample())
        episodes += int(info.get("_episode", np.zeros(3)).sum())
        assert info["shield_guaranteed"].all()
    assert episodes == 6


def test_scalar_shields_in_gymnasiums_sync_environment_still_work():
    env = gym.make_vec("ncs_gym/TruckTrailerCruise-v0", num_envs=2, vectorization_mode="sync", wrappers=[SafetyShield])
    env.reset(seed=0)
    assert env.step(np.ones((2, 1), np.float32))[4]["shield_guaranteed"].all()
