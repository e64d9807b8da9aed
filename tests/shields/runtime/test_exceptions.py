"""An exception of any kind inside a loop ends its guarantee until the next reset; what is refused changes nothing."""

import clarabel
import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import Channel, Packet, truck_trailer
from shields.runtime.backup_plans import Prediction
from shields.runtime.backup_plans.plan_search import PlanProgram
from shields.runtime.guard import Guard
from shields.runtime.safe_loop import NOT_STARTED
from shields.runtime.set_test import ellipsoid_test
from tests.certificates import certificate_of
from tests.product import loop_env, loop_step, safe_loop, safety_shield, vector_env, vector_shield

PLANT = truck_trailer(mass=4000.0)
MODES = ["project", "lookahead"]
RAISED = [ValueError, KeyboardInterrupt, type("PanicException", (BaseException,), {})]


def stopped(*_, **__):
    raise KeyboardInterrupt


def shield_of(kind, mode):
    if kind == "one":
        return safety_shield(loop_env(PLANT), certificate_of(PLANT), mode)
    return vector_shield(vector_env(3, plant=PLANT), certificate_of(PLANT), mode)


def raising(raised, when, whole):
    """Raises before or after what is called."""

    def call(*given, **named):
        if when == "after":
            whole(*given, **named)
        raise raised

    return call


# Where an exception may come from: the loop, what is reported of it, the guard, and the task.
PLACES = {
    "step": ("_now.move", "_now.report", "_guard.decide", "_guard.observe", "_guard.info"),
    "reset": ("_now.begin", "_now.report", "_guard.begin", "_guard.info"),
}


@pytest.mark.cases(9)
@pytest.mark.parametrize("raised", RAISED)
@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize(("call", "place"), [(call, place) for call in PLACES for place in PLACES[call]])
@pytest.mark.parametrize("kind", ["one", "many"])
def test_exception_inside_an_environment_ends_its_episode(kind, call, place, when, raised, monkeypatch):
    shield = shield_of(kind, "lookahead")
    action = np.zeros(shield.action_space.shape)
    shield.reset(seed=0)
    shield.step(action)
    part, name = place.split(".")
    owner = getattr(shield.unwrapped, part)
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, raising(raised, when, getattr(owner, name)))
        with pytest.raises(raised):
            shield.step(action) if call == "step" else shield.reset(seed=1)
    with pytest.raises(gym.error.ResetNeeded):
        shield.step(action)
    if kind == "many":
        with pytest.raises(gym.error.ResetNeeded, match="reset all"):
            shield.reset(options={"reset_mask": np.array([True, False, False])})
    assert np.all(shield.reset(seed=1)[1]["shield_guaranteed"])
    assert np.all(shield.step(action)[4]["shield_guaranteed"])


class StopsWhoAsks:
    """A proposal in the conversion of which Ctrl-C is pressed."""

    def __array__(self, *_, **__):
        raise KeyboardInterrupt


@pytest.mark.parametrize("name", ["decide", "observe", "begin"])
@pytest.mark.parametrize("mode", MODES)
def test_exception_in_a_loop_stops_it_until_the_next_start(mode, name, monkeypatch):
    loop = safe_loop(certificate_of(PLANT), PLANT, Channel(delay=1), mode)
    loop.start(np.zeros(2))
    loop_step(loop, 0.1)
    loop.receive([Packet(1, np.zeros(2))])
    with pytest.raises(KeyboardInterrupt):
        loop.decide(StopsWhoAsks())
    assert loop.guaranteed  # nothing was decided yet
    if name == "observe":
        loop.decide(0.1)

    call = {"decide": lambda: loop.decide(0.1), "observe": loop.receive, "begin": lambda: loop.start(np.zeros(2))}[name]
    with monkeypatch.context() as patch:
        patch.setattr(Guard, name, stopped)
        with pytest.raises(KeyboardInterrupt):
            call()
    assert (loop.guaranteed, loop.reason) == (False, NOT_STARTED)
    for refused in (loop.receive, lambda: loop.decide(None), loop.command):
        with pytest.raises(RuntimeError, match="call"):
            refused()
    loop.start(np.zeros(2))
    assert loop_step(loop, 0.1).proved
    assert loop.guaranteed


DATA = np.zeros(2), np.ones((4, len(PLANT.box))), np.eye(2), 1.0, np.empty((4, 0)), np.zeros(1)


@pytest.mark.parametrize("raised", RAISED)
def test_solver_that_does_not_come_to_its_end_has_no_answer_and_is_not_asked_again(monkeypatch, raised):
    prediction = Prediction(ellipsoid_test(certificate_of(PLANT).safe_set.shape_matrix, PLANT), 4)
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
