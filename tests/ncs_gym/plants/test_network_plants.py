"""The three plants at which the network decides: their equations, and certificates that are nearly used up."""

import numpy as np
import pytest
from scipy.linalg import expm

from ncs_gym.plants.convoy import convoy
from ncs_gym.plants.lane_keeping import lane_keeping
from ncs_gym.plants.stirred_tank import stirred_tank


def test_tank_runs_away_at_the_rate_of_its_unstable_pole():
    growth = max(abs(np.linalg.eigvals(stirred_tank().A)))
    assert np.log(growth) * 60.0 / 3.0 == pytest.approx(2.83, abs=0.01)  # per minute, of a step of 3 s


def test_follower_falls_back_by_what_the_leader_gains():
    plant, v = convoy(), np.array([0.0, 1.0])
    away = expm(np.array([[0.0, -1.0], [0.0, -1.0 / 0.3]]) * 0.1) @ v
    np.testing.assert_allclose(plant.A @ v, away, rtol=1e-12)
    assert np.sqrt(plant.disturbance_bound.shape_matrix[0, 0]) == pytest.approx(0.45 * 0.1)


def test_car_moves_sideways_with_its_heading():
    plant = lane_keeping()
    np.testing.assert_allclose(plant.A, [[1.0, 20.0 * 0.05], [0.0, 1.0]], rtol=1e-12)
    np.testing.assert_allclose(plant.B, [[20.0 * 0.05**2 / 2.0], [0.05]], rtol=1e-12)
