"""A plant with a remainder: what its certificate says, and when its guarantee ends."""

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import Channel, Ellipsoid, FunctionProcess
from ncs_gym.plants.family import Remainder
from shields import Infeasible
from shields.runtime.guard import EXPLANATIONS, LEFT_MODEL, NOT_KNOWN_INSIDE, GuaranteeMonitor
from tests.certificates import certificate_of
from tests.plants import with_remainder
from tests.product import (
    belief,
    family_of,
    linear_plant,
    loop_env,
    safety_filter,
    safety_shield,
    sampled_plant,
    synthesize,
    vector_shield,
)

COMMON = {"A": [[0.9, 0.1], [0.0, 0.8]], "B": [[0.0], [0.3]], "box": [1.0, 1.0], "u_max": 1.0, "dt": 0.1}
COMMON |= {"sensor_bound": 0.001, "initial_bound": 0.001}
BOUND = Ellipsoid(1e-4 * np.eye(2))
EXACT = linear_plant(**COMMON, disturbance_bound=BOUND)
LEFT_OUT = Remainder(BOUND, False, "an example")
LOCAL = with_remainder()
LINEAR = "ncs_gym/LinearNCS-v0"


def late(steps, remainder=LEFT_OUT):
    """The same plant, whose inputs take effect some steps later."""
    bounds = {"disturbance_bound": 0.0, "sensor_bound": 1e-3, "initial_bound": 1e-3}
    model = (COMMON["A"], COMMON["B"], np.eye(2), np.zeros((2, 1)), 0.1)
    return sampled_plant(model, box=[1.0, 1.0], u_max=1.0, input_delay=steps, remainder=remainder, **bounds)


def reasons(plant, start, mode="monitor", **settings):
    """Why the proof does not hold, step by step, while the state decays."""
    env = safety_shield(loop_env(plant, **settings), certificate_of(plant), mode)
    _, info = env.reset(seed=0, options={"state": np.asarray(start)})
    seen = [info["shield_reason"]]
    for _ in range(40):
        *_, info = env.step(np.zeros(1, np.float32))
        seen.append(info["shield_reason"])
    _, info = env.reset(seed=0)
    return [*seen, info["shield_reason"]]


DOWNLINK = {"downlink": Channel(loss=0.3, delay=2, max_consecutive_losses=1)}


@pytest.mark.parametrize("settings", [{}, DOWNLINK])
def test_guarantee_does_not_come_back_after_a_state_that_may_be_outside(settings):
    start = [0.99, 0.99]  # in the box, not in S
    exact, local = (reasons(plant, start, **settings) for plant in (EXACT, LOCAL))
    assert NOT_KNOWN_INSIDE in exact
    assert exact[-2:] == ["", ""]  # back in S, and the next episode
    assert set(local[:-1]) == {LEFT_MODEL}
    assert local[-1] == ""
    assert set(reasons(LOCAL, [0.3, 0.3], "project", **settings)) == {""}


def test_a_first_state_that_may_be_outside_is_not_forgotten_when_inputs_take_effect_inside():
    for plant, after in ((EXACT, ""), (LOCAL, LEFT_MODEL)):
        safe = certificate_of(plant).safe_set
        start = 1.02 * np.array([1.0, 0.0]) / safe.gauge(np.array([1.0, 0.0]))  # decays into S in two steps
        assert safe.gauge(plant.A @ plant.A @ start) < 0.9
        seen = reasons(plant, start, **DOWNLINK)
        assert seen[0] == (after or NOT_KNOWN_INSIDE)
        assert set(seen[3:-1]) == {after}
        assert seen[-1] == ""


def test_certificate_says_what_it_assumes_of_the_remainder():
    assumed = certificate_of(LOCAL).provenance["assumptions"]
    assert any("is assumed to lie in its bound while the state is in the box: an example" in each for each in assumed)
    assert "an example" in str(certificate_of(LOCAL))
    assert "remainder" not in str(certificate_of(EXACT))


@pytest.mark.cases(1)
@pytest.mark.parametrize("downlink", [{}, {"downlink": Channel(delay=1)}])
def test_inputs_under_way_beyond_their_limits_are_outside_the_model(downlink):
    """S reaches to four times the limits in their direction, the bound of the remainder only to the limits."""
    plants = [late(1), late(1, remainder=None)]
    start = [0.0, 0.0, 1.3]
    assert set(reasons(plants[0], start, **downlink)[:-1]) == {LEFT_MODEL}
    assert set(reasons(plants[0], [0.0, 0.0, 0.9], **downlink)) == {""}
    assert set(reasons(plants[1], start, **downlink)) == {""}


def test_inputs_under_way_that_an_error_may_put_beyond_their_limits_are_outside_the_model():
    plant = late(1)
    shield = safety_filter(certificate_of(plant), plant)
    for error, reason in ((0.0, ""), (0.009, ""), (0.011, LEFT_MODEL)):
        errors = shield.errors_of(np.diag([1e-12, 1e-12, error**2]))
        for last in (0.99, -0.99):
            state = GuaranteeMonitor(shield).start(True, belief(np.array([0.0, 0.0, last])), errors)
            assert EXPLANATIONS[state.broken] == reason


def test_family_that_the_box_cannot_bear_is_told_what_share_of_its_radii_would_do():
    def furnace(loss):
        bounds = {"disturbance_bound": 0.02, "sensor_bound": 0.02, "initial_bound": 0.02}
        return linear_plant(A=[[1.0 - 0.1 * loss]], B=[[0.05]], dt=0.1, box=[1.0], u_max=2.0, **bounds)

    with pytest.raises(Infeasible, match=r"radii shrink to 13\.\d% of those given"):
        synthesize(family_of(furnace, {"loss": (-6.0, 8.0)}, monotone=True))


@pytest.mark.parametrize("many", [False, True])
def test_a_step_that_no_measurement_shows_is_no_measurement(many):
    """Two states apart from each other; only the first is measured, and the process differs in the second alone."""
    bounds = {"disturbance_bound": [0.01, 0.02], "sensor_bound": [0.01], "initial_bound": [0.05, 0.02]}
    model = {"A": np.diag([0.9, 0.8]), "B": [[0.1], [0.1]], "H": [[1.0, 0.0]], "dt": 1.0, "box": 1.0, "u_max": 2.0}
    plant = linear_plant(**model, **bounds)
    process = FunctionProcess(lambda x, u: plant.A @ x + plant.B @ u + [0.0, 0.3])
    given = {"plant": plant, "process": process, "allow_assumption_violation": True}
    certificate = synthesize(plant)
    if many:
        env = vector_shield(gym.make_vec(LINEAR, num_envs=2, **given), certificate, on_unproved="ignore")
    else:
        env = safety_shield(gym.make(LINEAR, **given), certificate, on_unproved="ignore")
    env.reset(seed=0)
    info = env.step(np.zeros((2, 1) if many else 1, np.float32))[4]
    reason = info["shield_reason"][0] if many else info["shield_reason"]
    assert reason == "the simulation saw a step outside the bound on disturbances of the model"
    assert np.all(info["assumption_violated"])
