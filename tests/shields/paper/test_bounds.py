import numpy as np
import pytest
from scipy.stats import chi2

from ncs_gym import truck_trailer
from shields.paper.bounds import PaperModel, safety_margin, state_error_bound, uplink_error_bound
from tests.product import library_plant

Q, P0 = np.diag([1e-4, 3e-5]), np.diag([2e-4, 1e-4])


def uplink(gamma, Q, P0, delta, g2):
    """eps_up of Theorem 2 from the numbers of a plant."""
    largest = np.linalg.eigvalsh(P0)[-1], np.linalg.eigvalsh(Q)[-1] + gamma
    return uplink_error_bound(*largest, chi2.ppf(1.0 - delta, len(Q)), g2, 1.0 - g2)


def test_uplink_bound_is_theorem_5_with_the_kept_quantile():
    expected = (2e-4 * 0.9 + (1e-4 + 5e-4) / 0.1) * chi2.ppf(0.95, 2)
    assert uplink(5e-4, Q, P0, 0.05, 0.9) == pytest.approx(expected)


def test_safety_margin_is_the_distance_argument_of_the_paper():
    alpha = safety_margin(5e-4, 0.0094, 0.9029)
    assert alpha**0.5 - (0.9029 * alpha) ** 0.5 == pytest.approx(5e-4**0.5 + 0.0094**0.5)
    assert safety_margin(1.0, 1.0, 1.0) == 0.0


def test_model_of_a_plant_agrees_with_the_single_formulas():
    plant = library_plant(truck_trailer, gamma=1e-5, process_noise_cov=Q, initial_cov=P0)
    bounds = PaperModel(plant).at(0.8, 1.1)
    epsilon_up = uplink(1e-5, Q, P0, 0.05, 0.88)
    assert bounds.epsilon_up == pytest.approx(epsilon_up)
    assert bounds.epsilon == pytest.approx(state_error_bound(np.linalg.norm(plant.A, 2), 0.88, epsilon_up))
    assert bounds.alpha == pytest.approx(safety_margin(1e-5, bounds.epsilon, 0.8))


def test_safety_margin_keeps_its_digits_near_one():
    from fractions import Fraction

    kappa = 0.9999999998726
    exact = (Fraction(1) - Fraction(kappa)) / 2  # 1 - sqrt(kappa) to first order
    assert safety_margin(1.0, 0.0, kappa) == pytest.approx(float(1 / exact) ** 2, rel=1e-9)
