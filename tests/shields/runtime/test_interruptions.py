"""What is interrupted, at any line, has not happened, or its guarantee has ended."""

from copy import deepcopy
from functools import cache, partial

import clarabel
import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import Channel, Ellipsoid, NCSEnv, NCSVectorEnv, Packet, truck_trailer
from shields import SafeLoop, SafetyShield, VectorSafetyShield
from shields.runtime.backup_plans.plan_search import Planner, PlanProgram, Plans
from shields.runtime.safe_loop import NOT_STARTED
from shields.runtime.safety_filter import MODES
from tests.certificates import certificate_of
from tests.interruptions import interrupt, places
from tests.shields.attacks.cases import box_ellipsoid, plan_case

PLANT = truck_trailer(mass=4000.0)
UPLINK = Channel(loss=0.3, quantization_step=0.01, delay=1, jitter=1)
DOWNLINKS = {"ideal": None, "late": Channel(loss=0.5, max_consecutive_losses=1, delay=1)}
# Steps that are compared after an interruption, and of the many lines of a call the part that is tried.
GOES_ON, STRIDE = 6, 31
COUNT = 3
KEYS = ("state", "estimate", "error_shape", "input", "input_committed", "shield_margin", "shield_reason")


def setting(mode):
    """Where episodes start, and how far plans reach, in a mode: plans are needed outside S alone."""
    S = certificate_of(PLANT).safe_set
    start = box_ellipsoid(PLANT, 0.95) if mode == "lookahead" else Ellipsoid(0.8 * S.shape_matrix)
    return start, 4 if mode == "lookahead" else None


def policy(mode, info):
    """Full throttle outwards; mode "monitor", which would let it through, is proposed next to nothing."""
    size = 0.01 if mode == "monitor" else 1.0
    return (size * np.sign(info["estimate"] @ (PLANT.A.T @ PLANT.weight @ PLANT.B))).astype(np.float32)


def ready(make, mode):
    """A shield a few steps into an episode that is guaranteed; in mode "lookahead" with plans stored."""
    for seed in range(200):
        shield = make()
        _, info = shield.reset(seed=seed)
        for _ in range(2):
            *_, info = shield.step(policy(mode, info))
        planned = mode != "lookahead" or np.max(info["shield_plan_length"]) > 1
        if planned and np.all(info["shield_guaranteed"]):
            return shield, policy(mode, info)
    raise AssertionError("no such episode")


@cache
def case(kind, mode, downlink, **settings):
    start, horizon = setting(mode)
    given = {"plant": PLANT, "channel": UPLINK, "downlink": DOWNLINKS[downlink], "disturbance": "adversarial"}
    given |= {"initial_set": start} | settings
    if kind == "scalar":
        make = lambda: SafetyShield(NCSEnv(**given), certificate_of(PLANT), mode, horizon=horizon)  # noqa: E731
    else:
        make = lambda: VectorSafetyShield(NCSVectorEnv(COUNT, **given), certificate_of(PLANT), mode, horizon=horizon)  # noqa: E731
    return ready(make, mode)


def played(shield, actions):
    """The infos of some steps."""
    infos = []
    for action in actions:
        *_, info = shield.step(action)
        infos.append(info)
    return infos


def same(one, other):
    return all(np.array_equal(one[key], other[key], equal_nan=one[key].dtype != object) for key in KEYS)


def as_arrays(info):
    return {key: np.asarray(info[key], object if key == "shield_reason" else None) for key in KEYS}


def all_same(some, others):
    return all(same(as_arrays(one), as_arrays(other)) for one, other in zip(some, others, strict=True))


def assert_inside(shield, info):
    """What is guaranteed is true."""
    guaranteed, states = np.atleast_1d(info["shield_guaranteed"]), np.atleast_2d(info["state"])
    inside = np.abs(states @ shield.filter.plant.box_rows.T).max(axis=1) <= 1.0
    if shield.filter.mode != "lookahead":
        inside &= shield.certificate.safe_set.gauge(states) <= 1.0
    assert inside[guaranteed].all()


def check_wrapper(kind, mode, downlink, call, stride, goes_on=GOES_ON, **settings):
    """Interrupts a call at many lines; returns how often it was as if nothing, and how often the guarantee ended."""
    shield, action = case(kind, mode, downlink, **settings)
    return check(shield, action, call, stride, goes_on)


def check(shield, action, call, stride, goes_on=GOES_ON, within=()):
    """The same for a shield that is given."""
    begun = {
        "step": lambda env: env.step(action),
        "reset": lambda env: env.reset(seed=5),
        "reset of some": lambda env: env.reset(seed=5, options={"reset_mask": np.arange(COUNT) == 1}),
    }[call]
    further = [action] * goes_on
    before, after, fresh = deepcopy(shield), deepcopy(shield), deepcopy(shield)
    begun(after)
    expected = [played(before, further), played(after, further)]
    anew = [fresh.reset(seed=7)[1], *played(fresh, further)]
    counts = {"as if nothing": 0, "ended": 0, "refused": 0}
    for place in places(partial(begun, deepcopy(shield)), stride, *within):
        env = deepcopy(shield)
        if not interrupt(place, partial(begun, env)):
            continue
        try:
            infos = played(env, further)
        except gym.error.ResetNeeded:
            counts["refused"] += 1
        else:
            for info in infos:
                assert_inside(env, info)
            if any(np.any(info["shield_guaranteed"]) for info in infos):
                assert any(all_same(infos, each) for each in expected), f"line {place} of {call}"
                counts["as if nothing"] += 1
            else:
                counts["ended"] += 1
        assert all_same([env.reset(seed=7)[1], *played(env, further)], anew), "a reset does not make good for it"
    return counts


# One representative of each mode; the slow test takes all of them, line by line.
REPRESENTATIVES = [
    ("scalar", "project", "late", "step"),
    ("scalar", "lookahead", "late", "step"),
    ("scalar", "boundary", "ideal", "reset"),
    ("vector", "lookahead", "ideal", "step"),
    ("vector", "switch", "late", "step"),
    ("vector", "boundary", "ideal", "reset"),
    ("vector", "monitor", "late", "reset of some"),
]


@pytest.mark.cases(3)
@pytest.mark.parametrize(("kind", "mode", "downlink", "call"), REPRESENTATIVES)
def test_interrupted_call_of_a_shield_ends_the_guarantee_or_has_not_happened(kind, mode, downlink, call):
    counts = check_wrapper(kind, mode, downlink, call, STRIDE)
    assert counts["refused"] > 0
    assert counts["ended" if kind == "vector" or call == "reset" else "as if nothing"] > 0


@pytest.mark.parametrize("stride", [9, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", ["scalar", "vector"])
def test_interrupted_step_in_which_a_stored_input_is_applied_skips_none(kind, stride, monkeypatch):
    plant, horizon, channel, contract = plan_case("batch reactor", "constant delay")
    given = {"channel": channel, "contract": contract, "initial_set": box_ellipsoid(plant, 0.95)}
    if kind == "scalar":
        shield = SafetyShield(NCSEnv(plant, **given), certificate_of(plant, contract), "lookahead", horizon=horizon)
    else:
        env = NCSVectorEnv(1, plant=plant, **given)
        shield = VectorSafetyShield(env, certificate_of(plant, contract), "lookahead", horizon=horizon)
    lengths = np.array(0)
    for seed in range(300):
        if lengths.min() < 3:
            lengths = np.array(shield.reset(seed=seed)[1]["shield_plan_length"])
    assert lengths.min() >= 3
    nothing = lambda planner, x_hat, *_: Plans(  # noqa: E731
        np.full((len(x_hat), horizon, plant.m), np.nan), np.zeros(len(x_hat), np.int64), np.full(len(x_hat), np.inf)
    )
    monkeypatch.setattr(Planner, "find", nothing)
    monkeypatch.setattr(Planner, "beginning_with", nothing)
    monkeypatch.setattr(Planner, "beginning_alone", lambda *_: None)
    proposed = np.broadcast_to(np.float32(np.nextafter(1.0, 0.0)), shield.action_space.shape)
    counts = check(shield, proposed, "step", stride, goes_on=2, within=["shields/runtime/"])
    assert counts["as if nothing"] > 0
    assert counts["ended"] > 0


@pytest.mark.parametrize("reset", [pytest.param("NextStep", marks=pytest.mark.slow), "SameStep"])
def test_interrupted_step_that_restarts_episodes_ends_the_guarantee_or_has_not_happened(reset):
    settings = {"max_episode_steps": 3 if reset == "SameStep" else 2, "autoreset_mode": reset}
    # No longer than the next episode: the one after that is guaranteed anew.
    counts = check_wrapper("vector", "lookahead", "ideal", "step", STRIDE, goes_on=2, **settings)
    assert counts["refused"] > 0
    assert counts["ended"] > 0


@cache
def loop_case(mode, downlink):
    """A loop in mid-episode, in which something is decided, and packets of its plant."""
    _, horizon = setting(mode)
    rng = np.random.default_rng(0)
    loop = SafeLoop(certificate_of(PLANT), PLANT, UPLINK, mode, horizon, DOWNLINKS[downlink])
    for _ in range(200):
        x = box_ellipsoid(PLANT, 0.95 if mode == "lookahead" else 0.5).sample(rng)
        loop.start(x, initial_set=x)
        u = loop.decide(policy(mode, {"estimate": x}) * PLANT.u_max).input
        x = PLANT.A @ x + PLANT.B @ (0.0 * u if loop.input_delay else u)
        loop.receive([Packet(1, PLANT.H @ x, loop.episode)])
        if loop.guaranteed and (mode != "lookahead" or loop.plan_length > 0):
            return loop
    raise AssertionError("no such episode")


def told(loop):
    """What a loop says of itself."""
    values = [loop.guaranteed, loop.reason, loop.plan_length, loop.steps, loop.episode, loop.measurement_age]
    return [*values, loop.discarded, loop.estimate.tolist(), loop.error_shape.tolist(), str(loop)]


def rest(loop):
    """What a loop does from a received step on: mostly failed proposals, which ask for what is stored."""
    done = []
    for proposed in (None, None, PLANT.u_max, None, -PLANT.u_max, None):
        decision = loop.decide(proposed)
        done += [decision.input.tolist(), decision.reason, decision.plan.tolist(), loop.command().inputs.tolist()]
        loop.receive([Packet(loop.steps, loop.estimate, loop.episode)])
        guaranteed, reason, length, steps, _, age, discarded, *seen, _ = told(loop)  # without the number of the episode
        done += [guaranteed, reason, length, steps, age, discarded, *seen]
    return done


CALLS = {
    "decide": (lambda loop: None, lambda loop: loop.decide(PLANT.u_max)),
    "decide nothing": (lambda loop: None, lambda loop: loop.decide(None)),
    "receive": (
        lambda loop: loop.decide(None),
        lambda loop: loop.receive([Packet(loop.steps, loop.estimate, loop.episode), Packet(-5, loop.estimate, 0)]),
    ),
    "start": (lambda loop: None, lambda loop: loop.start(np.zeros(PLANT.n))),
}


def check_loop(call, mode, downlink, stride):
    """Interrupts a call of a loop at many lines: it has not begun or is done, or the loop is stopped."""
    before, begun = CALLS[call]
    twin, stopped = deepcopy(loop_case(mode, downlink)), 0
    before(twin)
    expected, anew = told(twin), deepcopy(twin)
    anew.start(np.zeros(PLANT.n))
    whole = deepcopy(twin)
    begun(whole)  # what is remembered makes later calls shorter
    done = told(whole)
    for place in places(partial(begun, deepcopy(twin)), stride):
        loop = deepcopy(twin)
        if not interrupt(place, partial(begun, loop)):
            continue
        if loop.reason == NOT_STARTED:
            stopped += 1
            assert not loop.guaranteed
            for refused in (loop.receive, partial(loop.decide, None), loop.command):
                with pytest.raises(RuntimeError, match="call"):
                    refused()
        else:
            assert told(loop) in (expected, done), f"line {place} of {call}"
        loop.start(np.zeros(PLANT.n))
        assert told(loop)[:4] == told(anew)[:4], f"line {place} of {call}"
    assert stopped > 3
    loop.decide(None)
    anew.decide(None)
    assert loop.command().inputs.tolist() == anew.command().inputs.tolist()
    for each in (loop, anew):
        each.receive([Packet(each.steps, each.estimate, each.episode)])
    assert rest(loop) == rest(anew)


@pytest.mark.parametrize(
    ("mode", "downlink"), [("project", "ideal"), ("lookahead", "late"), ("lookahead", "ideal"), ("monitor", "late")]
)
@pytest.mark.parametrize("call", CALLS)
def test_interrupted_call_of_a_loop_stops_it_or_has_not_begun(call, mode, downlink):
    check_loop(call, mode, downlink, 7)


class StopsWhoAsks:
    """A proposal in the conversion of which Ctrl-C is pressed."""

    def __array__(self, *_, **__):
        raise KeyboardInterrupt


def test_proposal_that_is_interrupted_while_it_is_read_changes_nothing():
    loop = deepcopy(loop_case("lookahead", "ideal"))
    expected = told(loop)
    with pytest.raises(KeyboardInterrupt):
        loop.decide(StopsWhoAsks())
    assert told(loop) == expected


DATA = np.zeros(2), np.ones((4, len(PLANT.box_rows))), np.eye(2), 1.0, np.empty((4, 0)), np.zeros(1)


@pytest.mark.parametrize("raised", [type("PanicException", (BaseException,), {}), ValueError, KeyboardInterrupt])
def test_solver_that_does_not_come_to_its_end_has_no_answer_and_is_not_asked_again(monkeypatch, raised):
    planner = loop_case("lookahead", "ideal").filter.lookahead.planner
    program, made = PlanProgram(planner.test.prediction), []
    answer = program.solve(*DATA)

    class Breaking:
        def __init__(self, *_):
            made.append(self)

        def update(self, **_):
            raise raised

    program = PlanProgram(planner.test.prediction)
    with monkeypatch.context() as patch:
        patch.setattr(clarabel, "DefaultSolver", Breaking)
        for _ in range(2):
            if raised is KeyboardInterrupt:
                with pytest.raises(KeyboardInterrupt):
                    program.solve(*DATA)
            else:
                assert program.solve(*DATA) is None
    assert len(made) == 2
    np.testing.assert_array_equal(program.solve(*DATA), answer)


def test_arguments_that_do_not_fit_are_no_failure_of_the_solver():
    program = PlanProgram(loop_case("lookahead", "ideal").filter.lookahead.planner.test.prediction)
    with pytest.raises(ValueError, match="shape"):
        program.solve(DATA[0], DATA[1][:3], *DATA[2:])


@pytest.mark.slow
@pytest.mark.parametrize("downlink", DOWNLINKS)
@pytest.mark.parametrize("mode", MODES)
def test_calls_interrupted_at_every_single_line_end_the_guarantee_or_have_not_happened(mode, downlink):
    for call in ("step", "reset"):
        check_wrapper("scalar", mode, downlink, call, 1)
        check_wrapper("vector", mode, downlink, call, 1)
    check_wrapper("vector", mode, downlink, "reset of some", 1)
    for call in CALLS:
        check_loop(call, mode, downlink, 1)
