"""An exception of any kind inside a loop ends its guarantee until the next reset; what is refused changes nothing."""

import clarabel
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import VectorWrapper

from ncs_gym import Channel, Packet, truck_trailer
from shields import VectorSafetyShield
from shields.runtime.backup_plans import Prediction
from shields.runtime.backup_plans.plan_search import PlanProgram
from shields.runtime.monitored_filter import MonitoredFilter
from shields.runtime.safe_loop import NOT_STARTED
from shields.runtime.set_test import ellipsoid_test
from tests.certificates import certificate_of
from tests.product import loop_env, safe_loop, safety_shield, vector_env, vector_shield

PLANT = truck_trailer(mass=4000.0)
MODES = ["project", "lookahead"]
RAISED = [ValueError, KeyboardInterrupt, type("PanicException", (BaseException,), {})]


class Raising:
    """Raises, once it is told to, before or after what is inside has moved."""

    raised = when = None

    def _moved(self, move):
        if self.when == "before":
            raise self.raised
        moved = move()
        if self.when == "after":
            raise self.raised
        return moved

    def reset(self, **given):
        return self._moved(lambda: self.env.reset(**given))

    def step(self, action):
        return self._moved(lambda: self.env.step(action))


class RaisingOne(Raising, gym.Wrapper):
    pass


class RaisingMany(Raising, VectorWrapper):
    pass


def stopped(*_, **__):
    raise KeyboardInterrupt


def shield_of(kind, mode):
    if kind == "one":
        return safety_shield(RaisingOne(loop_env(PLANT)), certificate_of(PLANT), mode)
    return vector_shield(RaisingMany(vector_env(3, plant=PLANT)), certificate_of(PLANT), mode)


@pytest.mark.parametrize("raised", RAISED)
@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize("call", ["step", "reset"])
@pytest.mark.parametrize("kind", ["one", "many"])
def test_exception_around_an_environment_ends_the_guarantee_until_the_next_reset(kind, call, when, raised):
    shield = shield_of(kind, "project")
    assert np.all(shield.reset(seed=0)[1]["shield_guaranteed"])
    action = np.zeros(shield.action_space.shape)
    assert np.all(shield.step(action)[4]["shield_guaranteed"])
    shield.env.when, shield.env.raised = when, raised
    with pytest.raises(raised):
        shield.step(action) if call == "step" else shield.reset(seed=1)
    shield.env.when = None
    lasts = when == "before" and call == "reset"  # nothing has moved
    for _ in range(5):
        assert np.all(shield.step(action)[4]["shield_guaranteed"] == lasts)
    assert np.all(shield.reset(seed=1)[1]["shield_guaranteed"])
    assert np.all(shield.step(action)[4]["shield_guaranteed"])


@pytest.mark.parametrize("name", ["decide", "advance", "begin"])
def test_exception_in_the_shield_itself_ends_the_guarantee_until_the_next_reset(name, monkeypatch):
    shield, action = shield_of("one", "lookahead"), np.zeros(1)
    shield.reset(seed=0)
    shield.step(action)
    whole = getattr(MonitoredFilter, name)

    def done_and_stopped(*given, **named):
        whole(*given, **named)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(MonitoredFilter, name, done_and_stopped)
        with pytest.raises(KeyboardInterrupt):
            shield.reset() if name == "begin" else shield.step(action)
    assert not any(shield.step(action)[4]["shield_guaranteed"] for _ in range(5))
    shield.reset()
    assert shield.step(action)[4]["shield_guaranteed"]


def test_exception_in_a_reset_of_some_environments_ends_the_guarantee_of_these(monkeypatch):
    shield, action = shield_of("many", "lookahead"), np.zeros((3, 1))
    shield.reset(seed=0)
    shield.step(action)
    chosen = np.array([False, True, False])
    with monkeypatch.context() as patch:
        patch.setattr(VectorSafetyShield, "_start", stopped)
        with pytest.raises(KeyboardInterrupt):
            shield.reset(options={"reset_mask": chosen})
    for _ in range(5):
        np.testing.assert_array_equal(shield.step(action)[4]["shield_guaranteed"], ~chosen)
    shield.reset(options={"reset_mask": chosen})
    assert shield.step(action)[4]["shield_guaranteed"].all()


class StopsWhoAsks:
    """A proposal in the conversion of which Ctrl-C is pressed."""

    def __array__(self, *_, **__):
        raise KeyboardInterrupt


@pytest.mark.parametrize("name", ["decide", "advance", "begin"])
@pytest.mark.parametrize("mode", MODES)
def test_exception_in_a_loop_stops_it_until_the_next_start(mode, name, monkeypatch):
    loop = safe_loop(certificate_of(PLANT), PLANT, Channel(delay=1), mode)
    loop.start(np.zeros(2))
    loop.step(0.1)
    loop.receive([Packet(1, np.zeros(2))])
    with pytest.raises(KeyboardInterrupt):
        loop.decide(StopsWhoAsks())
    assert loop.guaranteed  # nothing was decided yet
    if name == "advance":
        loop.decide(0.1)

    call = {"decide": lambda: loop.decide(0.1), "advance": loop.receive, "begin": lambda: loop.start(np.zeros(2))}[name]
    with monkeypatch.context() as patch:
        patch.setattr(MonitoredFilter, name, stopped)
        with pytest.raises(KeyboardInterrupt):
            call()
    assert (loop.guaranteed, loop.reason) == (False, NOT_STARTED)
    for refused in (loop.receive, lambda: loop.decide(None), loop.command):
        with pytest.raises(RuntimeError, match="call"):
            refused()
    loop.start(np.zeros(2))
    assert loop.step(0.1).proved
    assert loop.guaranteed


DATA = np.zeros(2), np.ones((4, len(PLANT.box_rows))), np.eye(2), 1.0, np.empty((4, 0)), np.zeros(1)


@pytest.mark.parametrize("raised", RAISED)
def test_solver_that_does_not_come_to_its_end_has_no_answer_and_is_not_asked_again(monkeypatch, raised):
    prediction = Prediction(ellipsoid_test(certificate_of(PLANT).L, PLANT), 4)
    answer, program = PlanProgram(prediction).solve(*DATA), PlanProgram(prediction)

    class Breaking:
        def __init__(self, *_):
            pass

        def update(self, **_):
            raise raised

    with monkeypatch.context() as patch:
        patch.setattr(clarabel, "DefaultSolver", Breaking)
        if raised is KeyboardInterrupt:
            with pytest.raises(KeyboardInterrupt):
                program.solve(*DATA)
        else:
            assert program.solve(*DATA) is None
    np.testing.assert_array_equal(program.solve(*DATA), answer)
    with pytest.raises(ValueError, match="shape"):  # no failure of the solver
        program.solve(DATA[0], DATA[1][:3], *DATA[2:])
