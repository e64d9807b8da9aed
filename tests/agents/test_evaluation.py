import copy
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import VectorWrapper

from agents.evaluation import evaluate
from agents.loop import LoopConfig, ShieldSettings
from ncs_gym import Channel, Ellipsoid
from shields import certificate_for
from shields.synthesis.polytope_certificates import with_polytope
from tests.certificates import certificate_of, metric

CRUISE = LoopConfig(env="ncs_gym/TruckTrailerCruise-v0")
SHORT = CRUISE.with_kwargs(max_episode_steps=50)


def zero(observations, infos):
    return np.zeros((len(observations), 1), np.float32)


def throttle(observations, infos):
    return np.ones((len(observations), 1), np.float32)


@pytest.fixture
def shield(certificate):
    return ShieldSettings(certificate)


def test_it_counts_what_a_plain_loop_counts(certificate, monkeypatch):
    make_vec, seeds = gym.make_vec, []

    class Noting(VectorWrapper):
        def reset(self, *, seed=None, options=None):
            seeds.append(seed)
            return self.env.reset(seed=seed, options=options)

    monkeypatch.setattr(gym, "make_vec", lambda *given, **settings: Noting(make_vec(*given, **settings)))
    played = evaluate(CRUISE, throttle, 8, 100, safe_set=certificate.safe_set, on_progress=(reported := []).append)
    assert sum(reported) == 8 * 200
    envs = make_vec(CRUISE.env, num_envs=8)
    plant = envs.unwrapped.plant
    _, info = envs.reset(seed=seeds[0])
    states, estimates, total = [info["state"]], [info["estimate"]], np.zeros(8)
    for _ in range(200):
        _, rewards, _, _, info = envs.step(np.ones((8, 1), np.float32))
        total += rewards
        states.append(info["state"])
        estimates.append(info["estimate"])
    states, estimates = np.array(states), np.array(estimates)
    for e, record in enumerate(played.episodes):
        assert (record.index, record.steps) == (e, 200)
        assert record.episode_return == pytest.approx(total[e])
        assert record.violation_steps == (np.abs(states[1:, e] @ plant.box.T).max(axis=1) > 1.0).sum() > 0
        assert record.estimate_violation_steps == (np.abs(estimates[1:, e] @ plant.box.T).max(axis=1) > 1.0).sum()
        assert record.times_safe_set == pytest.approx(np.sqrt(max(x @ metric(certificate) @ x for x in states[:, e])))
        assert not record.guaranteed


def test_environments_without_a_vector_one_are_played_alike(shield, monkeypatch):
    spec = copy.deepcopy(gym.spec(CRUISE.env))
    spec.id, spec.vector_entry_point = "Scalar-v0", None
    monkeypatch.setitem(gym.registry, "Scalar-v0", spec)
    loop = LoopConfig(env="Scalar-v0", kwargs={"max_episode_steps": 60}, shield=shield)
    for record in evaluate(loop, throttle, 2, 0, shield.certificate.safe_set).episodes:
        assert (record.steps, record.violation_steps, record.guaranteed) == (60, 0, True)


def test_it_is_guaranteed_behind_a_shield_and_leaves_penalties_out(shield):
    penalized = replace(shield, penalty=1.0)
    free, other = (
        evaluate(replace(SHORT, shield=each, violation_penalty=each.penalty), throttle, 3, 0, Ellipsoid(np.eye(2)))
        for each in (shield, penalized)
    )
    assert free.episodes == other.episodes
    assert all(each.guaranteed and each.violation_steps == 0 < each.interventions for each in free.episodes)


def test_steps_that_were_proved_are_counted_where_the_contract_breaks():
    infos = []
    channel = Channel(loss=0.8, max_consecutive_losses=30)
    env = gym.make("ncs_gym/CartPole-v0").unwrapped
    shield = ShieldSettings(certificate_for(env.plant, env.certificate_contract), on_unproved="ignore")
    loop = LoopConfig(env="ncs_gym/CartPole-v0", kwargs={"channel": channel, "max_episode_steps": 80}, shield=shield)

    def noting(observations, info):
        infos.append(info)
        return throttle(observations, info)

    played = evaluate(loop, noting, 4, 0).episodes
    before_the_last = sum(int(info["shield_guaranteed"][0]) for info in infos[1:])
    assert played[0].proved - before_the_last in (0, 1)
    assert 0 < sum(each.proved for each in played) < sum(each.steps for each in played)


def test_levels_are_those_of_the_set_that_the_shield_keeps(certificate, loaded):
    """The polytope is larger: states of it are outside the ellipsoid, and never count as outside of what is kept."""
    wide = with_polytope(certificate, loaded)
    loop = LoopConfig(env=CRUISE.env, shield=ShieldSettings(wide))
    kept = evaluate(loop, throttle, 5, 0, wide.safe_set).episodes
    measured_by_the_ellipsoid = evaluate(loop, throttle, 5, 0, certificate.safe_set).episodes
    assert all(record.guaranteed and record.times_safe_set <= 1.0 for record in kept)
    assert max(record.times_safe_set for record in measured_by_the_ellipsoid) > 1.0


def test_arms_have_common_random_numbers(shield):
    bare = evaluate(SHORT, zero, 5, 7).episodes
    shielded = evaluate(replace(SHORT, shield=shield), zero, 5, 7).episodes
    assert [record.episode_return for record in bare] == [record.episode_return for record in shielded]
    others = evaluate(SHORT, zero, 5, 8).episodes
    assert not {record.episode_return for record in bare} & {record.episode_return for record in others}


def test_episode_that_ends_early_changes_nothing_for_the_others():
    env = "ncs_gym/CartPole-v0"
    inner = gym.make(env).unwrapped
    loop = LoopConfig(env=env, shield=ShieldSettings(certificate_of(inner.plant, inner.contract), "project"))

    def push_the_first(observations, infos):
        actions = np.zeros((len(observations), 1), np.float32)
        actions[0] = 1.0
        return actions

    bare = LoopConfig(env=env)
    pushed, quiet = (evaluate(bare, policy, 4, 0).episodes for policy in (push_the_first, zero))
    assert pushed[0].steps < 200
    assert pushed[0].violation_steps == 1
    assert [(r.steps, r.episode_return) for r in pushed[1:]] == [(r.steps, r.episode_return) for r in quiet[1:]]
    assert all(r.steps == 200 and r.guaranteed for r in evaluate(loop, push_the_first, 4, 0).episodes)


def test_more_episodes_than_are_played_side_by_side_are_played_in_parts():
    short = LoopConfig(env=CRUISE.env, kwargs={"max_episode_steps": 2})
    played = evaluate(short, zero, 1003, 0)
    assert [record.index for record in played.episodes] == list(range(1003))
    assert len({record.episode_return for record in played.episodes}) == 1003


@pytest.mark.parametrize("mode", ["SameStep", "NextStep", "Disabled"])
def test_last_steps_of_episodes_count_whatever_the_autoreset(mode):
    usual, others = (
        evaluate(CRUISE.with_kwargs(max_episode_steps=3, **more), throttle, 6, 0, Ellipsoid(np.eye(2)))
        for more in ({}, {"autoreset_mode": mode})
    )
    assert sum(each.violation_steps for each in usual.episodes) > 3
    assert usual.episodes == others.episodes


def test_episodes_without_an_end_are_not_evaluated():
    loop = LoopConfig(env="ncs_gym/TruckTrailer-v0", kwargs={"max_episode_steps": -1})
    with pytest.raises(ValueError, match="no max_episode_steps, without which an evaluation may not end"):
        evaluate(loop, lambda seen, _: np.zeros((len(seen), 1), np.float32), 1, 0)
