import pickle
import warnings
from functools import partial
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import (
    FrameStackObservation,
    NormalizeObservation,
    RecordEpisodeStatistics,
    RescaleAction,
    StickyAction,
    TimeLimit,
)
from stable_baselines3.common.env_checker import check_env as check_env_sb3
from stable_baselines3.common.monitor import Monitor

from ncs_gym import AdversarialDisturbance, Channel, Ellipsoid, NCSEnv
from shields import SafetyShield
from shields.runtime.guarantee import (
    ALARM,
    FAR_OUT,
    LARGE_ERROR,
    NOT_KNOWN_INSIDE,
    OTHER_INPUT,
    OTHER_STEPS,
)
from tests.certificates import with_proof

CRUISE = "ncs_gym/TruckTrailerCruise-v0"
KEYS = {
    "shield_intervened": bool,
    "input_proposed": np.ndarray,
    "shield_correction": float,
    "shield_margin": float,
    "shield_guaranteed": bool,
    "shield_reason": str,
    "episode_interventions": int,
    "episode_guaranteed": float,
}


def shielded(certificate, mode="project", penalty=0.0, **kwargs) -> SafetyShield:
    return SafetyShield(gym.make(CRUISE, **kwargs), certificate, mode=mode, penalty=penalty)


def play(env, policy, steps=200, **reset):
    """All infos of one episode, the reset's first."""
    infos = [env.reset(**reset)[1]]
    for _ in range(steps):
        *_, truncated, info = env.step(policy(infos[-1]))
        infos.append(info)
        if truncated:
            break
    return infos


def full(info):
    return np.ones(1, np.float32)


def test_checkers_pass_on_the_shielded_environment(certificate):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*is different from the unwrapped version.*")
        check_env(SafetyShield(gym.make(CRUISE).unwrapped, certificate))
        check_env_sb3(SafetyShield(gym.make(CRUISE).unwrapped, certificate))


def test_info_gains_the_same_keys_and_types_always(certificate):
    plain = gym.make(CRUISE).reset(seed=0)[1]
    for info in play(shielded(certificate), full, seed=0):
        assert set(info) == set(plain) | set(KEYS)
        assert {key: type(info[key]) for key in KEYS} == KEYS
        assert info["shield_correction"] == pytest.approx(np.linalg.norm(info["input"] - info["input_proposed"]))
        assert info["shield_guaranteed"] is (info["shield_reason"] == "")


@pytest.mark.parametrize("mode", ["project", "switch", "boundary"])
def test_full_throttle_is_overridden_and_stays_inside(certificate, mode):
    infos = play(shielded(certificate, mode), full, seed=0)
    assert infos[-1]["episode_interventions"] == sum(info["shield_intervened"] for info in infos) > 50
    assert infos[-1]["is_success"] == 1.0
    assert all(info["shield_guaranteed"] for info in infos)
    assert max(info["state"] @ certificate.M @ info["state"] for info in infos) <= 1.0
    bare = play(gym.make(CRUISE), full, seed=0)
    assert bare[-1]["is_success"] == 0.0


def test_idle_shield_is_the_identity_bit_for_bit(certificate):
    actions = np.random.default_rng(0).uniform(-0.05, 0.05, (200, 1)).astype(np.float32)
    plain, shield = gym.make(CRUISE), shielded(certificate)
    first, second = plain.reset(seed=1), shield.reset(seed=1)
    np.testing.assert_array_equal(first[0], second[0])
    for action in actions:
        one, other = plain.step(action), shield.step(action)
        np.testing.assert_array_equal(one[0], other[0])
        assert one[1:4] == other[1:4]
        for key, value in one[4].items():
            np.testing.assert_array_equal(value, other[4][key])
        assert not other[4]["shield_intervened"]


def test_a_copy_of_the_callers_own_action_is_passed_on(certificate):
    seen = []

    class Spy(gym.Wrapper):
        def step(self, action):
            seen.append(action)
            return self.env.step(action)

    env = SafetyShield(Spy(gym.make(CRUISE)), certificate)
    env.reset(seed=0)
    for kind in (np.float32, np.float64):
        action = np.array([0.01], kind)
        env.step(action)
        np.testing.assert_array_equal(seen[-1], action)
        assert seen[-1].dtype == kind
        assert not np.shares_memory(seen[-1], action)
    for _ in range(5):
        env.step(np.ones(1, np.float32))
    assert all(env.action_space.contains(a) for a in seen[2:])


@pytest.mark.parametrize("mode", ["project", "monitor"])
def test_penalty_is_paid_per_intervention_only(certificate, mode):
    free, paid = shielded(certificate, mode), shielded(certificate, mode, penalty=0.5)
    free.reset(seed=0)
    paid.reset(seed=0)
    for _ in range(30):
        _, reward, *_, info = free.step(full(None))
        _, other, *_ = paid.step(full(None))
        assert other == pytest.approx(reward - 0.5 * info["shield_intervened"])


def test_monitor_is_the_unshielded_environment_bit_for_bit(certificate):
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.2, 1.2, (200, 1))  # float64 and beyond the limits: passed on as they are
    bare, watched = gym.make(CRUISE), shielded(certificate, mode="monitor")
    np.testing.assert_array_equal(bare.reset(seed=3)[0], watched.reset(seed=3)[0])
    counted, doubted = 0, False
    for action in actions:
        expected, (*result, info) = bare.step(action), watched.step(action)
        np.testing.assert_array_equal(expected[0], result[0])
        assert expected[1:4] == tuple(result[1:])
        np.testing.assert_array_equal(info["input"], info["input_proposed"])
        assert info["shield_correction"] == 0.0
        counted += info["shield_intervened"]
        assert info["episode_interventions"] == counted
        doubted |= info["shield_reason"] == NOT_KNOWN_INSIDE
    assert 10 < counted < 150
    assert doubted


def test_monitor_keeps_the_proof_while_nothing_unsafe_is_proposed(certificate):
    env = shielded(certificate, mode="monitor", disturbance=AdversarialDisturbance(certificate.M))
    gain = certificate.K / env.filter.plant.u_max[:, None]
    infos = play(env, lambda info: gain @ info["estimate"], seed=0)
    assert all(info["shield_guaranteed"] for info in infos)
    assert infos[-1]["episode_interventions"] == 0


@pytest.mark.parametrize("action", [np.array([np.nan]), np.zeros(2), None, "left", ["0.1"], [10**400], np.array([1j])])
def test_bad_action_raises_before_anything_moves(certificate, action):
    env = shielded(certificate)
    env.reset(seed=0)
    before = env.unwrapped.steps
    with pytest.raises(ValueError, match="the action must be finite"):
        env.step(action)
    assert env.unwrapped.steps == before


@pytest.mark.parametrize(
    "outer",
    [
        lambda env: RescaleAction(env, np.float32(-0.5), np.float32(0.5)),
        lambda env: FrameStackObservation(env, 3),
        NormalizeObservation,
        RecordEpisodeStatistics,
        Monitor,
        lambda env: TimeLimit(env, 50),
        lambda env: StickyAction(env, 0.5),
    ],
)
def test_wrappers_outside_work(certificate, outer):
    env = outer(shielded(certificate))
    env.reset(seed=0)
    for _ in range(40):
        *_, info = env.step(env.action_space.sample())
        assert info["shield_guaranteed"]


def test_wrappers_that_only_look_may_be_inside(certificate):
    env = SafetyShield(RecordEpisodeStatistics(NormalizeObservation(gym.make(CRUISE))), certificate)
    assert all(info["shield_guaranteed"] for info in play(env, full, seed=0))


def test_spec_recreates_the_shielded_environment(certificate):
    env = gym.make(shielded(certificate, "switch", 0.25).spec)
    assert isinstance(env, SafetyShield)
    assert (env.filter.mode, env.penalty) == ("switch", 0.25)


def test_shielded_environment_survives_pickling(certificate):
    env = shielded(certificate)
    play(env, full, 20, seed=0)
    twin = pickle.loads(pickle.dumps(env))
    for _ in range(20):
        np.testing.assert_array_equal(env.step(full(None))[4]["state"], twin.step(full(None))[4]["state"])


# The proof and its assumptions, each broken on purpose.


def test_start_outside_the_safe_set_is_reported_and_recovers(certificate):
    env = shielded(certificate)
    infos = play(env, lambda info: np.zeros(1, np.float32), 60, seed=0, options={"state": [2.2, 0.0]})
    assert infos[0]["shield_reason"] == NOT_KNOWN_INSIDE
    for info in infos:
        if info["shield_guaranteed"]:
            assert info["state"] @ certificate.M @ info["state"] <= 1.0
    assert infos[-1]["shield_guaranteed"]


def test_start_on_the_boundary_of_the_safe_set_is_known(certificate):
    edge = (1 - 1e-12) * certificate.safe_set.extreme_point(np.array([1.0, 0.4]))
    infos = play(
        shielded(certificate, disturbance=AdversarialDisturbance(certificate.M)), full, options={"state": edge}
    )
    assert all(info["shield_guaranteed"] for info in infos)
    assert max(info["state"] @ certificate.M @ info["state"] for info in infos) <= 1.0


def test_initial_set_that_leaves_the_safe_set_is_not_trusted(certificate):
    env = shielded(certificate, initial_set=Ellipsoid(4.5 * np.eye(2)))
    reasons = {env.reset(seed=seed)[1]["shield_reason"] for seed in range(40)}
    assert reasons == {"", NOT_KNOWN_INSIDE}


def test_too_large_disturbance_is_noticed_and_latched(certificate):
    def gust(rng, plant, nominal_next):
        return 2.0 * plant.disturbance.extreme_point(rng.standard_normal(2))

    env = shielded(certificate, disturbance=gust, allow_assumption_violation=True, channel=Channel())
    infos = play(env, full, seed=0)
    broken = [info["shield_reason"] == ALARM for info in infos]
    assert any(broken)
    assert all(broken[broken.index(True) :])


def test_changed_input_is_noticed_and_latched(certificate):
    class Meddler(gym.Wrapper):
        calls = 0

        def step(self, action):
            self.calls += 1
            return self.env.step(action * 0.9 if self.calls == 3 else action)

    infos = play(SafetyShield(Meddler(gym.make(CRUISE)), certificate), full, 10, seed=0)
    assert [info["shield_reason"] for info in infos] == [""] * 3 + [OTHER_INPUT] * 8


def test_repeated_step_is_noticed(certificate):
    class Twice(gym.Wrapper):
        def step(self, action):
            self.env.step(action)
            return self.env.step(action)

    infos = play(SafetyShield(Twice(gym.make(CRUISE)), certificate), full, 3, seed=0)
    assert [info["shield_reason"] for info in infos] == ["", OTHER_STEPS, OTHER_STEPS, OTHER_STEPS]


def test_environment_moved_behind_the_shields_back_is_noticed(certificate):
    env = shielded(certificate)
    far = {"state": [1.9, 1.8]}
    for meddle in (
        lambda: env.unwrapped.reset(options=far),
        lambda: env.unwrapped.step(full(None)),
        lambda: env.env.reset(options=far),
    ):
        env.reset(seed=0)
        meddle()
        assert env.step(full(None))[4]["shield_reason"] == OTHER_STEPS


def test_inner_wrapper_that_chooses_the_start_is_not_trusted(certificate):
    class Elsewhere(gym.Wrapper):
        def reset(self, *, seed=None, options=None):
            return self.env.reset(seed=seed, options={"state": [1.99, 1.9]})

    class WarmUp(gym.Wrapper):
        def reset(self, *, seed=None, options=None):
            self.env.reset(seed=seed)
            observation, *_, info = self.env.step(full(None))
            return observation, info

    reasons = [
        SafetyShield(layer(gym.make(CRUISE)), certificate).reset(seed=0)[1]["shield_reason"]
        for layer in (Elsewhere, WarmUp)
    ]
    assert reasons == [NOT_KNOWN_INSIDE, OTHER_STEPS]


def test_writing_into_the_infos_changes_no_decision(certificate):
    runs = []
    for vandal in (False, True):
        env = shielded(certificate)
        _, info = env.reset(seed=1)
        for _ in range(60):
            if vandal:
                for value in info.values():
                    if isinstance(value, np.ndarray):
                        value[...] = 0.0
            *_, info = env.step(full(None))
            assert info["shield_guaranteed"]
        runs.append(info["input"].copy())
    np.testing.assert_array_equal(*runs)


def forge(env):
    """Adds something to what the packets of an environment carry from now on; returns what took them before."""
    estimator = env.unwrapped.estimator
    honest = estimator.advance

    def forged(u, packets):
        honest(u, [packet._replace(measurement=packet.measurement + 0.6) for packet in packets])

    estimator.advance = forged
    return honest


def test_forged_packet_is_noticed(certificate):
    env = shielded(certificate, channel=Channel())
    env.reset(seed=0)
    forge(env)
    assert env.step(full(None))[4]["shield_reason"] == ALARM


def test_error_ellipsoid_outside_the_certified_one_is_reported(certificate, loaded):
    # A certificate for better sensors at the start, whose Sigma is smaller than the running ellipsoid may become.
    env = shielded(certificate, channel=Channel(loss=1.0))
    smaller = with_proof(certificate, Sigma=0.3 * certificate.Sigma)
    object.__setattr__(env.filter, "certificate", smaller)
    infos = play(env, full, 30, seed=0)
    assert infos[0]["shield_guaranteed"]
    assert LARGE_ERROR in {info["shield_reason"] for info in infos}


@pytest.mark.parametrize("forge", [lambda S: -S, lambda S: np.float64(0.0), lambda S: S[0], lambda S: np.nan * S])
def test_error_shape_that_is_none_proves_nothing(certificate, forge):
    infos = play(SafetyShield(Knows(gym.make(CRUISE), "table", forging(forge)), certificate), full, 5, seed=0)
    assert not any(info["shield_guaranteed"] for info in infos[2:])


def forging(forge):
    """Makes a table of error shapes one that holds other shapes."""
    forged = lambda table, number: forge(table.shape(number))  # noqa: E731
    return lambda table: SimpleNamespace(
        shapes=table.shapes, shape=partial(forged, table), is_certified=table.is_certified
    )


class Knows(gym.Wrapper):
    """Makes the innermost environment itself know something else."""

    def __init__(self, env, field, forge):
        super().__init__(env)
        self.field, self.forge = field, forge

    def step(self, action):
        result, inner = self.env.step(action), self.unwrapped
        inner._known = inner._known._replace(**{self.field: self.forge(getattr(inner._known, self.field))})
        return result


class Rewrites(gym.Wrapper):
    """Rewrites infos, at resets too."""

    def __init__(self, env, rewrite):
        super().__init__(env)
        self.rewrite = rewrite

    def reset(self, **options):
        observation, info = self.env.reset(**options)
        return observation, self.rewrite(info)

    def step(self, action):
        *result, info = self.env.step(action)
        return *result, self.rewrite(info)


def smoothing(info, memory=[]):  # noqa: B006
    memory[:] = [info["estimate"] if not memory else 0.8 * memory[0] + 0.2 * info["estimate"]]
    return info | {"estimate": memory[0]}


@pytest.mark.parametrize(
    "rewrite",
    [
        smoothing,
        lambda info: info | {"error_shape": 0.01 * info["error_shape"]},
        lambda info: {key: np.zeros_like(value) for key, value in info.items()},
        lambda info: {key: "none" for key in info},
        lambda info: {},
    ],
    ids=["smoothed estimate", "scaled error shape", "zeros", "texts", "nothing"],
)
def test_no_rewritten_info_changes_a_decision_or_the_guarantee(certificate, rewrite):
    plain, forged = shielded(certificate), SafetyShield(Rewrites(gym.make(CRUISE), rewrite), certificate)
    plain.reset(seed=0)
    forged.reset(seed=0)
    for _ in range(60):
        one, other = plain.step(full(None))[4], forged.step(full(None))[4]
        for key in KEYS:
            np.testing.assert_array_equal(one[key], other[key])
        np.testing.assert_array_equal(plain.unwrapped.known.applied, forged.unwrapped.known.applied)
    assert one["shield_guaranteed"]
    assert one["episode_violations"] == 0.0


def test_interrupted_step_is_noticed(certificate):
    class Breaks(gym.Wrapper):
        def step(self, action):
            *result, info = self.env.step(action)
            if info["episode_violations"] == 0.0 and self.env.unwrapped.steps == 3:
                raise KeyboardInterrupt
            return *result, info

    env = SafetyShield(Breaks(gym.make(CRUISE)), certificate)
    env.reset(seed=0)
    for _ in range(2):
        assert env.step(full(None))[4]["shield_guaranteed"]
    with pytest.raises(KeyboardInterrupt):
        env.step(full(None))
    assert env.step(full(None))[4]["shield_reason"] == OTHER_STEPS
    assert env.reset(seed=0)[1]["shield_guaranteed"]


def test_error_that_may_reach_far_out_proves_nothing(certificate):
    env = SafetyShield(Knows(gym.make(CRUISE), "table", forging(lambda S: 1e5 * np.eye(2))), certificate)
    env.reset(seed=0)
    assert env.step(full(None))[4]["shield_reason"] == FAR_OUT


def test_step_after_a_failed_first_reset_is_refused(certificate):
    env = SafetyShield(gym.make(CRUISE), certificate)
    with pytest.raises(ValueError, match="option"):
        env.reset(options={"bad": 1})
    with pytest.raises(gym.error.ResetNeeded):
        env.step(full(None))


def test_step_before_reset_is_refused(certificate):
    env = SafetyShield(NCSEnv(gym.make(CRUISE).unwrapped.plant), certificate)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(full(None))


def test_alarm_is_cleared_by_a_new_episode(certificate):
    env = shielded(certificate, channel=Channel())
    env.reset(seed=0)
    honest = forge(env)
    env.step(full(None))
    env.unwrapped.estimator.advance = honest
    assert env.reset()[1]["shield_guaranteed"]
