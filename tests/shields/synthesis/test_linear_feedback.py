"""The yardstick of certificates: what a linear controller bears over a finite horizon."""

import numpy as np
import pytest

from ncs_gym import ChannelContract, LinearPlant
from shields import linear_feedback_tolerance
from tests.shields.synthesis.test_network_requirements import servo


def integrator(A=1.0, u_max=10.0, **settings):
    bounds = {"disturbance_bound": 0.1, "sensor_bound": 1e-6, "initial_bound": 1e-6} | settings
    return LinearPlant(dt=1.0, A=[[A]], B=[[1.0]], H=[[1.0]], box=[1.0], u_max=u_max, **bounds)


@pytest.mark.parametrize("age", [0, 1, 4])
def test_integrator_bears_one_disturbance_for_every_step_that_the_newest_sample_is_old(age):
    """u = -x of the newest sample, less the inputs since then, leaves the last age + 1 disturbances, at best."""
    found = linear_feedback_tolerance(integrator(), ChannelContract(age), horizon=8)
    assert found == pytest.approx(10.0 / (age + 1), rel=1e-3)


def test_input_limit_binds_where_disturbances_are_larger_than_what_an_input_can_undo():
    """x_8 is what eight disturbances add, less seven inputs at most; a wider limit lets more through."""
    free, limited, none = (
        linear_feedback_tolerance(integrator(u_max=u_max), ChannelContract(0), horizon=8) for u_max in (10.0, 0.5, 1e-9)
    )
    assert free == pytest.approx(10.0, rel=1e-3)
    assert none < limited < free
    assert limited > 5.0 * (1.0 - 1e-3)  # what u = -x bears: |d| <= 0.5


def test_without_samples_a_stable_plant_bears_what_its_errors_add_up_to():
    found = linear_feedback_tolerance(integrator(0.5, initial_bound=0.2), None, horizon=10)
    worst = max(0.2 * 0.5**k + 0.1 * (1.0 - 0.5**k) / 0.5 for k in range(1, 11))
    assert found == pytest.approx(1.0 / worst, rel=1e-3)


def test_older_and_coarser_samples_and_more_steps_are_borne_less():
    plant = servo()
    known = linear_feedback_tolerance(plant, ChannelContract(1), horizon=6)
    assert linear_feedback_tolerance(plant, ChannelContract(3), horizon=6) < known
    assert linear_feedback_tolerance(plant, ChannelContract(1, 0.01), horizon=6) < known
    assert linear_feedback_tolerance(plant, ChannelContract(1), horizon=9) <= known * (1.0 + 1e-6)


def test_units_do_not_matter():
    scale = np.diag([1e3, 1e-2])
    A, B, H = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.0], [0.1]]), np.array([[1.0, 0.0]])
    bounds = {"disturbance_bound": [0.01, 0.02], "initial_bound": [0.01, 0.02], "sensor_bound": 0.01}
    plain = LinearPlant(dt=1.0, A=A, B=B, H=H, box=[1.0, 1.0], u_max=2.0, **bounds)
    other = LinearPlant(
        dt=1.0,
        A=scale @ A @ np.linalg.inv(scale),
        B=scale @ B,
        H=H @ np.linalg.inv(scale),
        box=np.diag(scale),
        u_max=2.0,
        disturbance_bound=scale @ [0.01, 0.02],
        initial_bound=scale @ [0.01, 0.02],
        sensor_bound=0.01,
    )
    first, second = (linear_feedback_tolerance(each, ChannelContract(2), horizon=6) for each in (plain, other))
    assert first == pytest.approx(second, rel=1e-3)
