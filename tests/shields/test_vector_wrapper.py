import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import VectorActionWrapper, VectorObservationWrapper, VectorWrapper
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics

from ncs_gym import Channel, ChannelContract, LinearPlant, NCSVectorEnv, SphereDisturbance, batch_reactor, truck_trailer
from shields import CertificateError, SafetyFilter, SafetyShield, VectorSafetyShield
from shields.runtime import guarantee as proof
from shields.runtime import routine, vector_wrapper
from shields.runtime.filter import MARGIN, MODES, Decision
from shields.runtime.guarantee import ProofTracker, starts_inside
from shields.runtime.tracking import Knowledge, compare_clocks, track
from shields.runtime.vector_filter import REASONS, Decisions, VectorFilter, overridden
from shields.runtime.vector_wrapper import WHY
from tests.attacks import CHANNELS, RANDOM, TRUCKS, certificate_of, harmful

KEYS = {
    "shield_intervened",
    "input_proposed",
    "shield_correction",
    "shield_margin",
    "shield_guaranteed",
    "shield_reason",
    "episode_interventions",
}


def random_shapes(rng, plant, count):
    """Error shapes of all sizes, some flat, some unusable."""
    certified = certificate_of(plant).Sigma
    factor = np.linalg.cholesky(certified)
    shapes = []
    for _ in range(count):
        inner = rng.standard_normal((plant.n, plant.n)) * np.exp(rng.uniform(-4.0, 1.0))
        inner[:, 0] *= rng.choice([1.0, 1e-8])
        shape = factor @ inner @ inner.T @ factor.T
        shapes.append(0.5 * (shape + shape.T))
    shapes[0] = np.zeros_like(certified)
    shapes[1] = np.full_like(certified, np.nan)
    shapes[2] = -certified
    return np.array(shapes)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("plant", [*TRUCKS.values(), *RANDOM.values()], ids=[*TRUCKS, *RANDOM])
def test_decisions_equal_those_of_the_scalar_filter(plant, mode):
    safety_filter = SafetyFilter(certificate_of(plant), plant, mode)
    batch, rng, count = VectorFilter(safety_filter), np.random.default_rng(0), 400
    estimates = certificate_of(plant).safe_set.sample_boundary(rng, count) * rng.uniform(0, 1.3, (count, 1))
    estimates[3], estimates[4], estimates[5] = 1e200, np.nan, 0.0
    shapes = random_shapes(rng, plant, 60)[rng.integers(60, size=count)]
    proposed = rng.uniform(-1, 1, (count, plant.m)) * plant.u_max
    proposed[::7] = plant.u_max
    # Some propose just what the fallback would do.
    proposed[::11] = [
        np.zeros(plant.m) if not np.isfinite(x).all() else safety_filter.fallback_input(x) for x in estimates[::11]
    ]
    numbers = np.array([batch.book.number(shape) for shape in shapes])
    found = batch.decide(np.ascontiguousarray(estimates.T), numbers, np.ascontiguousarray(proposed.T))
    seen = set()
    for e in range(count):
        one = safety_filter.decide(estimates[e], shapes[e], proposed[e])
        seen.add(one.reason)
        assert REASONS[found.reason[e]] == one.reason
        np.testing.assert_allclose(found.inputs[:, e], one.input, rtol=3e-7, atol=1e-12)
        assert (found.intervened[e], found.passed[e], found.fallback[e]) == (one.intervened, one.passed, one.fallback)
        np.testing.assert_allclose(found.margin[e], one.margin, atol=1e-6 if one.reason == "projected" else 1e-12)
    assert {"safe", "invalid"} <= seen
    assert seen & {"projected", "fallback", "unsafe"}


@pytest.mark.parametrize("name", ["4000 kg", "n=4 m=3 p=2"])
def test_the_test_is_passed_with_the_margin_of_the_scalar_filter(name):
    plant = (TRUCKS | RANDOM)[name]
    certificate = certificate_of(plant)
    safety_filter = SafetyFilter(certificate, plant, "switch")
    batch, shape = VectorFilter(safety_filter), 0.1 * certificate.Sigma
    number, u = np.array([batch.book.number(shape)]), 0.01 * plant.u_max
    edge = certificate.safe_set.extreme_point(np.ones(plant.n))
    low, high = 0.0, 50.0
    for _ in range(60):  # to the last estimate at which it passes
        middle = 0.5 * (low + high)
        passed = REASONS[batch.decide((middle * edge)[:, None], number, u[:, None]).reason[0]] == "safe"
        low, high = (middle, high) if passed else (low, middle)
    assert 0.0 < low < 49.0
    assert MARGIN <= safety_filter.test.at(low * edge, shape).judge(u.tolist())[0] <= 1.01 * MARGIN


def test_rounding_counts_as_in_the_scalar_filter():
    # Estimates that A annihilates, so far out that rounding shows, and errors that nearly fill the safe set.
    A = np.array([[0.5, -0.3], [0.25, -0.15]])
    plant = LinearPlant(A=A, B=np.ones((2, 1)), C=np.eye(2), u_max=1.0, dt=0.1, gamma=1e-6)
    certificate = certificate_of(plant)
    safety_filter = SafetyFilter(certificate, plant)
    batch, test = VectorFilter(safety_filter), safety_filter.test
    u = np.zeros(1)

    def margins(estimate, shape):
        found = batch.decide(estimate[:, None].copy(), np.array([batch.book.number(shape)]), u[:, None])
        return found.margin[0], safety_filter.margin(estimate, shape, u)

    for size in (1e5, 1e6, 1e7):
        estimate = size * np.array([3.0, 5.0])
        loss = test.rounding * float(test.columns @ np.abs(estimate))
        assert margins(estimate, 1e-4 * certificate.Sigma) == pytest.approx(
            (margins(0.0 * estimate, 1e-4 * certificate.Sigma)[1] - loss,) * 2, abs=0.1 * loss
        )
    low, high = 0.0, 1e6
    for _ in range(60):  # to a radius too small for weights
        middle = 0.5 * (low + high)
        low, high = (middle, high) if 1.0 - test._in_space(np.zeros(2), middle * np.eye(2)).h > 5e-6 else (low, middle)
    assert margins(np.zeros(2), low * np.eye(2)) == pytest.approx((0.0, 0.0), abs=1e-12)


def drive(env, steps, policy):
    """Steps a shielded vector environment; checks every key against scalar filters and trackers."""
    shield, inner = env, env.unwrapped
    safety_filter = SafetyFilter(shield.certificate, inner.plant, shield.filter.mode)
    trackers = [ProofTracker(safety_filter) for _ in range(env.num_envs)]
    _, info = env.reset(seed=0)
    inside = starts_inside(shield.certificate, inner.single.initial_set)
    counts = np.zeros(env.num_envs, int)
    rows = [{key: value[e] for key, value in info.items()} for e in range(env.num_envs)]
    for tracker, row in zip(trackers, rows, strict=True):
        tracker.start(inside, True, row)
    totals = {"interventions": 0, "guaranteed": 0, "reasons": set()}
    for _ in range(steps):
        actions = policy(info)
        episodes = inner.episodes.copy()
        decisions = [
            safety_filter.decide(row["estimate"], row["error_shape"], u)
            for row, u in zip(rows, inner.inputs_of(actions).T, strict=True)
        ]
        *_, info = env.step(actions)
        rows = [{key: value[e] for key, value in info.items()} for e in range(env.num_envs)]
        for e, (tracker, row, decision) in enumerate(zip(trackers, rows, decisions, strict=True)):
            if inner.episodes[e] != episodes[e]:
                tracker.start(inside, True, row)
                counts[e] = 0
                assert not row["shield_intervened"]
                assert not row["input_proposed"].any()
                margin = safety_filter.margin(row["estimate"], row["error_shape"], np.zeros(inner.plant.m))
                assert row["shield_margin"] == pytest.approx(margin, abs=1e-12)
            else:
                tracker.step(decision, True, row)
                counts[e] += decision.intervened
                assert row["shield_intervened"] == decision.intervened
                np.testing.assert_allclose(row["input"], decision.input, rtol=3e-7, atol=1e-9)
                assert row["shield_margin"] == pytest.approx(decision.margin, abs=1e-6)
            assert row["shield_reason"] == tracker.reason
            assert row["shield_guaranteed"] == (not tracker.reason)
            assert row["episode_interventions"] == counts[e]
        totals["interventions"] += int(info["shield_intervened"].sum())
        totals["guaranteed"] += int(info["shield_guaranteed"].sum())
        totals["reasons"] |= set(info["shield_reason"].tolist())
    return totals


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", ["TruckTrailerCruise", "BatchReactor"])
def test_infos_equal_those_of_scalar_shields(name, mode):
    env = VectorSafetyShield(gym.make_vec(f"ncs_gym/{name}-v0", num_envs=6, max_episode_steps=60), mode=mode)
    rng = np.random.default_rng(1)

    def policy(info):
        return np.sign(rng.uniform(-1, 1, (6, env.unwrapped.plant.m)) + 0.8).astype(np.float32)

    totals = drive(env, 150, policy)
    assert totals["interventions"] > 0
    assert totals["guaranteed"] > 0


def test_reasons_of_broken_proofs_equal_those_of_scalar_shields():
    env = NCSVectorEnv(
        8,
        plant=batch_reactor(),
        channel=Channel(loss=0.6, quantization_step=1e-3),
        contract=ChannelContract(2, 1e-3),
        max_episode_steps=40,
        disturbance=lambda rng, plant, nominal: 4.0 * plant.disturbance.sample_boundary(rng),
        allow_assumption_violation=True,
    )
    shielded = VectorSafetyShield(env, mode="monitor")
    rng = np.random.default_rng(0)
    totals = drive(shielded, 100, lambda info: rng.uniform(-1, 1, (8, 2)))
    assert len(totals["reasons"]) >= 4


def test_proofs_break_and_recover_as_scalar_trackers_do_whatever_is_reported():
    plant, count, rng = TRUCKS["4000 kg"], 200, np.random.default_rng(0)
    shield = VectorSafetyShield(NCSVectorEnv(count, plant=plant), certificate_of(plant))
    safety_filter, Sigma = shield.filter, shield.certificate.Sigma
    shapes = [0.2 * Sigma, Sigma, 1.1 * Sigma, -Sigma, 1e5 * np.eye(2)]
    numbers = np.array([shield._batch.book.number(shape) for shape in shapes])
    trackers = [ProofTracker(safety_filter) for _ in range(count)]
    knowledge = Knowledge(np.zeros(count, np.int64), *np.zeros((2, count), np.bool_))
    reason, seen, kinds = np.empty(count, np.int64), set(), [0.3, 1.0, 1.5, 1e7, np.nan]
    for step in range(12):
        rare = lambda share: rng.random(count) < share  # noqa: E731
        restarted = rare(0.1) if step else np.ones(count, np.bool_)
        once, passed, fallback, known, alarm = ~rare(0.03), rare(0.7), rare(0.7), rare(0.5), rare(0.03)
        drawn = rng.choice(5, count, p=[0.5, 0.3, 0.14, 0.03, 0.03])
        sizes = rng.choice(kinds, count, p=[0.3, 0.3, 0.34, 0.03, 0.03])
        estimate = (shield.certificate.safe_set.sample_boundary(rng, count) * sizes[:, None]).T.copy()
        decided, inputs = np.zeros((1, count)), rare(0.03)[None] * 1.0
        wrong = track(
            shield._ground, shield._batch.book.seen, numbers[drawn], knowledge, restarted, once,
            decided, passed, fallback, known, inputs, estimate, alarm, reason,
        )  # fmt: skip
        for e, tracker in enumerate(trackers):
            info = {"estimate": estimate[:, e], "error_shape": shapes[drawn[e]], "input": inputs[:, e]}
            info["assumption_violated"] = bool(alarm[e])
            if restarted[e]:
                tracker.start(bool(known[e]), bool(once[e]), info)
            else:
                decision = Decision(decided[:, e], False, bool(passed[e]), bool(fallback[e]), 0.0, "")
                tracker.step(decision, bool(once[e]), info)
            assert WHY[reason[e]] == tracker.reason
        assert wrong == np.count_nonzero(reason)
        seen |= set(WHY[reason])
    assert seen == {"", *(proof.ALARM, proof.OTHER_INPUT, proof.OTHER_STEPS, proof.LARGE_ERROR, proof.FAR_OUT),
                    proof.UNUSABLE, proof.NOT_KNOWN_INSIDE}  # fmt: skip


@pytest.mark.parametrize("next_tick", [True, False])
def test_one_step_is_one_of_the_environments_own_clock(next_tick):
    episodes_before, steps_before = np.array([1, 1, 1, 1, 1, 1]), np.array([5, 5, 5, 9, 9, 9])
    episodes, steps = np.array([1, 1, 1, 2, 3, 2]), np.array([6, 7, 5, 0, 0, 1])
    restarted, once = np.empty((2, 6), np.bool_)
    assert compare_clocks(episodes, steps, episodes_before, steps_before, next_tick, restarted, once) == 3
    np.testing.assert_array_equal(restarted, [False, False, False, True, True, True])
    np.testing.assert_array_equal(once, np.array([True, False, False, True, False, False]) & next_tick)


def test_steps_behind_the_shields_back_are_seen_once_every_pattern_is_known(monkeypatch):
    plant, returned = TRUCKS["4000 kg"], []
    env = NCSVectorEnv(4, plant=plant, disturbance=harmful(plant), max_episode_steps=200)
    shield = VectorSafetyShield(env, certificate_of(plant))

    def recorded(*arguments):
        returned.append(routine.follow(*arguments))
        return returned[-1]

    monkeypatch.setattr(vector_wrapper, "follow", recorded)
    shield.reset(seed=0)
    for _ in range(60):
        assert shield.step(np.zeros((4, 1)))[4]["shield_guaranteed"].all()
    assert returned[-1] == 0  # nothing new: the compiled routine did everything
    env.step(np.zeros((4, 1)))
    assert not shield.step(np.zeros((4, 1)))[4]["shield_guaranteed"].any()
    assert returned[-1] == 4


def test_start_on_the_boundary_of_the_safe_set_is_known_in_batches_too():
    plant, certificate = TRUCKS["4000 kg"], certificate_of(TRUCKS["4000 kg"])
    shield = VectorSafetyShield(NCSVectorEnv(2, plant=plant), certificate)
    edge = certificate.safe_set.extreme_point(np.array([1.0, 0.4]))
    for factor in (1 - 1e-12, 1 + 1e-9):
        assert (shield.reset(options={"state": factor * edge})[1]["shield_guaranteed"] == (factor < 1.0)).all()


def test_book_of_shapes_grows_and_knows_the_widest_of_them():
    plant = TRUCKS["4000 kg"]
    safety_filter, Sigma = SafetyFilter(certificate_of(plant), plant), certificate_of(plant).Sigma
    book = VectorFilter(safety_filter).book
    shapes = [Sigma * share for share in np.linspace(0.1, 0.9, 300)]
    assert [book.number(shape) for shape in [*shapes, shapes[7]]] == [*range(300), 7]
    np.testing.assert_allclose(book.widest, np.sqrt(np.diag(shapes[-1])))
    for k in (0, 255, 256, 299):
        fresh = VectorFilter(safety_filter).book
        fresh.number(shapes[k])
        np.testing.assert_array_equal(book.outlooks[:, k], fresh.outlooks[:, 0])
        np.testing.assert_array_equal(book.seen[:, k], fresh.seen[:, 0])
    book.number(1.1 * Sigma)
    assert np.isinf(book.widest).all()


def test_margins_are_those_of_no_input_even_where_it_does_not_pass():
    plant = TRUCKS["4000 kg"]
    safety_filter, shape = SafetyFilter(certificate_of(plant), plant), 0.1 * certificate_of(plant).Sigma
    batch, rng = VectorFilter(safety_filter), np.random.default_rng(0)
    estimates = 1.5 * certificate_of(plant).safe_set.sample_boundary(rng, 50)
    found = batch.margins(np.ascontiguousarray(estimates.T), np.full(50, batch.book.number(shape)))
    expected = [safety_filter.margin(estimate, shape, np.zeros(1)) for estimate in estimates]
    np.testing.assert_allclose(found, expected, atol=1e-12)
    assert min(expected) < -0.1


@pytest.mark.parametrize(
    ("given", "kept"), [(np.float32, np.float32), (np.float64, np.float64), (np.int64, np.float64)]
)
def test_overridden_actions_are_numbers_of_the_callers_kind(given, kept):
    decisions = Decisions(np.array([[1.0, 3.0]]), np.array([True, False]), *np.zeros((4, 2)))
    actions = overridden(np.array([[1], [1]], given), decisions, np.array([4.0]))
    assert actions.dtype == kept
    np.testing.assert_array_equal(actions, [[0.25], [1.0]])


def test_shortcut_is_taken_only_where_nothing_is_in_doubt():
    hold, move_once = (getattr(loop, "py_func", loop) for loop in (routine._hold, routine._move_once))
    reach, widest, none = np.array([10.0, 20.0]), np.array([1.0, 2.0]), np.zeros(3, np.bool_)
    ones, estimate = np.ones((2, 3)), np.array([[9.0, 0.0, -9.0], [18.0, 0.0, -18.0]])

    def holds(broken=0, passed=True, applied=1.0, shift=0.0, alarm=False, e=2):
        """Whether all proofs hold with something else in environment e."""
        changed = [np.zeros(3, np.int64), ~none, ones.copy(), estimate.copy(), none.copy()]
        changed[0][e], changed[1][e], changed[2][1, e], changed[4][e] = broken, passed, applied, alarm
        changed[3][1, e] += shift
        broken, passed, applied, seen, alarm = changed
        return hold(reach, widest, broken, ones, passed, applied, seen, alarm)

    assert holds()
    for doubt in (
        {"broken": 3},
        {"passed": False},
        {"applied": 0.5},
        {"shift": -0.1},
        {"shift": np.nan},
        {"alarm": True},
    ):
        assert not holds(**doubt), doubt
    assert not holds(shift=0.1, e=0)
    assert holds(shift=1.0, e=1)
    first, then = np.array([1, 1]), np.array([5, 6])
    assert move_once(first, then + 1, first, then)
    for episodes, steps in (
        (first, then),
        (first, then + first * 2),
        (first * [1, 2], then + 1),
        (first + 1, then + 1),
    ):
        assert not move_once(episodes, steps, first, then)


@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("mode", ["project", "switch", "boundary"])
def test_no_policy_leaves_the_safe_set(mode, channel):
    plant = TRUCKS["4000 kg"]
    env = NCSVectorEnv(500, plant=plant, channel=CHANNELS[channel], disturbance=harmful(plant), max_episode_steps=100)
    shield = VectorSafetyShield(env, certificate_of(plant), mode)
    _, info = shield.reset(seed=0)
    rng, levels, overridden = np.random.default_rng(0), [], 0
    for step in range(200):
        outwards = np.sign(info["estimate"] @ (shield.certificate.M @ plant.B))
        actions = outwards if step % 2 else rng.uniform(-1, 1, (500, 1))
        _, _, _, _, info = shield.step(actions)
        levels.append(np.einsum("ei,ij,ej->e", info["state"], shield.certificate.M, info["state"]).max())
        assert info["shield_guaranteed"].all()
        overridden += int(info["shield_intervened"].sum())
    assert 0.5 < max(levels) <= 1.0
    assert 0 < overridden < 200 * 500


def test_same_step_autoreset_reports_the_last_step_in_final_info():
    settings = {"num_envs": 5, "max_episode_steps": 7}
    shields = [
        VectorSafetyShield(gym.make_vec("ncs_gym/TruckTrailerCruise-v0", autoreset_mode=mode, **settings), penalty=1.0)
        for mode in ("SameStep", "Disabled")
    ]
    for shield in shields:
        shield.reset(seed=0)
    for _ in range(7):
        same, plain = (shield.step(np.ones((5, 1), np.float32)) for shield in shields)
    np.testing.assert_array_equal(same[1], plain[1])
    final = same[4]["final_info"]
    for key, value in plain[4].items():
        np.testing.assert_array_equal(final[key], value)
    assert not same[4]["shield_intervened"].any()
    assert not same[4]["episode_interventions"].any()
    assert same[4]["shield_guaranteed"].all()


def test_penalty_is_subtracted_per_intervention_but_not_for_a_reset():
    rewards = []
    for penalty in (0.0, 3.0):
        env = VectorSafetyShield(
            gym.make_vec("ncs_gym/TruckTrailerCruise-v0", num_envs=4, max_episode_steps=10), penalty=penalty
        )
        env.reset(seed=0)
        run = [env.step(np.ones((4, 1), np.float32)) for _ in range(25)]
        rewards.append(np.array([step[1] for step in run]))
        counts = np.array([step[4]["shield_intervened"] for step in run])
    np.testing.assert_allclose(rewards[0] - rewards[1], 3.0 * counts)
    assert counts.any()
    assert not counts[10].any()


def test_partial_resets_keep_what_is_known_of_the_others():
    env = VectorSafetyShield(gym.make_vec("ncs_gym/TruckTrailerCruise-v0", num_envs=3, autoreset_mode="Disabled"))
    _, info = env.reset(seed=0)
    assert set(info) >= KEYS
    for _ in range(20):
        *_, info = env.step(np.ones((3, 1), np.float32))
    counts = info["episode_interventions"]
    assert counts.any()
    _, info = env.reset(options={"reset_mask": np.array([False, True, False]), "state": np.array([9.0, 9.0])})
    np.testing.assert_array_equal(info["episode_interventions"][[0, 2]], counts[[0, 2]])
    assert info["episode_interventions"][1] == 0
    np.testing.assert_array_equal(info["shield_guaranteed"], [True, False, True])
    assert "not known to be in the safe set" in info["shield_reason"][1]
    *_, info = env.step(np.ones((3, 1), np.float32))
    np.testing.assert_array_equal(info["shield_guaranteed"][[0, 2]], True)


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
    env = NCSVectorEnv(20, plant=plant, disturbance=harmful(plant), max_episode_steps=30, autoreset_mode=mode)
    shield = VectorSafetyShield(env, certificate_of(plant))
    _, info = shield.reset(seed=0)
    for _ in range(60):
        actions = outwards(shield, info)
        for array in info.values():
            if isinstance(array, np.ndarray) and array.dtype != object:
                array[:] = 0
        _, _, _, _, info = shield.step(actions)
        assert_honest(shield, info)
        assert info["shield_guaranteed"].all()


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


@pytest.mark.parametrize(
    ("key", "change"),
    [
        ("estimate", lambda x: x[:, :1]),
        ("estimate", lambda x: np.column_stack([x, x])),
        ("estimate", lambda x: x[:10]),
        ("estimate", lambda x: None),
        ("estimate", lambda x: x.astype(object)),
        ("input", lambda x: x[:, :0]),
        ("input", lambda x: x[:3]),
        ("input", lambda x: [*x.tolist(), [1j]]),
        ("assumption_violated", lambda x: x[:3]),
        ("assumption_violated", lambda x: "no"),
    ],
)
def test_infos_of_the_wrong_shape_or_kind_promise_nothing(key, change):
    class Broken(VectorWrapper):
        def step(self, actions):
            *rest, info = self.env.step(actions)
            return *rest, info | {key: change(info[key])}

    plant = TRUCKS["4000 kg"]
    env = Broken(NCSVectorEnv(20, plant=plant, disturbance=harmful(plant)))
    shield = VectorSafetyShield(env, certificate_of(plant))
    shield.reset(seed=0)
    for _ in range(30):
        *_, info = shield.step(np.ones((20, 1), np.float32))
        assert not info["shield_guaranteed"].any()


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


def test_wrong_uses_are_refused():
    class Scaled(VectorActionWrapper):
        def actions(self, actions):
            return 0.5 * actions

    class Plain(VectorObservationWrapper):
        def observations(self, observations):
            return observations

    env = gym.make_vec("ncs_gym/TruckTrailerCruise-v0", num_envs=2)
    with pytest.raises(ValueError, match="inside Scaled"):
        VectorSafetyShield(Scaled(env))
    with pytest.raises(ValueError, match="inside VectorSafetyShield"):
        VectorSafetyShield(VectorSafetyShield(env))
    with pytest.raises(ValueError, match="wrappers="):
        VectorSafetyShield(gym.make_vec("ncs_gym/TruckTrailerCruise-v0", num_envs=2, vectorization_mode="sync"))
    with pytest.raises(ValueError, match="mode must be"):
        VectorSafetyShield(env, mode="off")
    with pytest.raises(ValueError, match="penalty"):
        VectorSafetyShield(env, penalty=-1.0)
    with pytest.raises(ValueError, match="certificate must be"):
        VectorSafetyShield(env, certificate="file")
    with pytest.raises(CertificateError):
        VectorSafetyShield(env, certificate_of(truck_trailer()))
    with pytest.raises(gym.error.ResetNeeded):
        VectorSafetyShield(Plain(env)).step(np.zeros((2, 1)))


def test_scalar_shields_in_gymnasiums_sync_environment_still_work():
    env = gym.make_vec("ncs_gym/TruckTrailerCruise-v0", num_envs=2, vectorization_mode="sync", wrappers=[SafetyShield])
    env.reset(seed=0)
    assert env.step(np.ones((2, 1), np.float32))[4]["shield_guaranteed"].all()


def test_sphere_disturbance_and_shared_certificate():
    certificate = certificate_of(TRUCKS["4000 kg"])
    envs = [NCSVectorEnv(2, plant=TRUCKS["4000 kg"], disturbance=SphereDisturbance()) for _ in range(2)]
    shields = [VectorSafetyShield(env, certificate) for env in envs]
    for shield in shields:
        shield.reset(seed=1)
    one, other = (shield.step(np.ones((2, 1)))[4] for shield in shields)
    np.testing.assert_array_equal(one["input"], other["input"])
