"""Plants of state-space models from python-control, scipy.signal and plain matrices, and delayed inputs."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import signal
from scipy.integrate import solve_ivp

from ncs_gym.disturbances import BY_NAME, as_disturbance
from tests.product import sampled_plant

A, B, C, D = np.array([[0.0, 1.0], [-2.0, -3.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]]), np.zeros((1, 1))
REST = {"box": [1.0, 2.0], "u_max": 3.0, "disturbance_bound": 0.001, "sensor_bound": 0.001, "initial_bound": 0.01}
SAMPLED = signal.cont2discrete((A, B, C, D), 0.1)


def control_model(matrices, dt):
    """What `control.ss(...)` looks like from outside."""
    return SimpleNamespace(**dict(zip("ABCD", matrices, strict=True)), dt=dt)


CONTINUOUS = {
    "python-control": control_model((A, B, C, D), 0),
    "scipy": signal.StateSpace(A, B, C, D),
    "tuple": (A, B, C, D),
    "lists without D": [A.tolist(), B.tolist(), C.tolist(), None],
}
DISCRETE = {
    "python-control": control_model(SAMPLED[:4], 0.1),
    "scipy": signal.StateSpace(*SAMPLED[:4], dt=0.1),
    "tuple": (*SAMPLED[:4], 0.1),
    "dt unknown": control_model(SAMPLED[:4], True),
}


@pytest.mark.parametrize("name", CONTINUOUS)
def test_continuous_model_is_sampled_exactly(name):
    plant = sampled_plant(CONTINUOUS[name], dt=0.1, **REST)
    assert sampled_plant(CONTINUOUS[name], 0.1, **REST).fingerprint == plant.fingerprint
    assert plant.dt == 0.1
    model = SimpleNamespace(A=A, B=B, C=C)
    end = solve_ivp(lambda _, x: model.A @ x + model.B[:, 0] * 1.7, (0.0, 0.1), [0.4, -0.9], rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(plant.A @ [0.4, -0.9] + plant.B @ [1.7], end.y[:, -1], atol=1e-9)
    np.testing.assert_array_equal(plant.H, model.C)
    np.testing.assert_array_equal(plant.box, [[1.0, 0.0], [0.0, 0.5]])


def test_model_that_leaves_open_whether_it_is_in_discrete_time_is_refused():
    """python-control answers True to both questions where dt is None."""
    with pytest.raises(ValueError, match="not None"):
        sampled_plant(control_model(SAMPLED[:4], None), 0.1, **REST)


@pytest.mark.parametrize("name", DISCRETE)
def test_discrete_model_is_taken_as_it_is(name):
    plant = sampled_plant(DISCRETE[name], dt=0.1, **REST)
    np.testing.assert_array_equal(plant.A, SAMPLED[0])
    if name != "dt unknown":
        assert sampled_plant(DISCRETE[name], **REST).fingerprint == plant.fingerprint


def test_past_inputs_are_named_by_their_age():
    names = {"state_names": ["angle", "rate"], "input_names": ["torque"], "input_units": ["N m"]}
    plant = sampled_plant((A, B, C, D), dt=0.1, input_delay=2, **REST | names)
    assert plant.state_names[2:] == ("torque of 2 steps ago", "torque of 1 step ago")
    assert plant.state_units[2:] == ("N m",) * 2


def test_delayed_inputs_are_limited_but_never_count_as_violated():
    plant = sampled_plant((A, B, C, D), dt=0.1, input_delay=2, **(REST | {"u_max": 0.7}))
    assert np.linalg.matrix_rank(plant.box) == plant.n
    assert (plant.constraint_values(np.array([0.0, 0.0, 0.7, -0.7])) < -0.5).all()


@pytest.mark.parametrize("name", BY_NAME)
def test_disturbances_of_a_delayed_plant_leave_its_stored_inputs_alone(name):
    noise = {"gamma": 1e-4, "process_noise_cov": 1e-4 * np.eye(2)}
    plant = sampled_plant((A, B, C, D), dt=0.1, input_delay=2, **(REST | noise))
    source, rng = as_disturbance(name, plant, False), np.random.default_rng(0)
    memory = source.begin(rng, plant)
    for k in range(50):
        d = source.draw(rng, plant, rng.standard_normal(4), k, memory) + 0.0 * plant.process_noise.sample(rng)
        assert np.abs(d[:2]).max() > 0.0  # the adversary does not waste itself on stored inputs
        np.testing.assert_array_equal(d[2:], 0.0)
    np.testing.assert_array_equal(plant.process_noise.sample(rng)[2:], 0.0)
    np.testing.assert_array_equal(plant.of_first_error.drawn(rng)[2:], 0.0)
    assert (np.diag(plant.disturbance.shape_matrix)[2:] < 1e-12).all()
    assert (np.diag(plant.initial_error.shape_matrix)[2:] < 1e-12).all()
