import pickle
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import truck_trailer
from shields import Infeasible, verify
from shields.paper.bounds import PaperModel
from shields.paper.feasibility import FeasibilityScan, largest_scale
from tests.product import library_plant, paper_synthesis, safety_filter, safety_shield
from tests.verdicts import broken, verified

SMALL = library_plant(truck_trailer, gamma=1e-6, process_noise_cov=1e-6 * np.eye(2))


@pytest.fixture(scope="module")
def paper():
    return paper_synthesis(SMALL)


def test_certificate_carries_the_papers_constants(paper):
    bounds = PaperModel(SMALL).at(paper.kappa, paper.rho)
    assert "e'e <= epsilon" in str(paper)
    assert (paper.epsilon, paper.epsilon_up) == (bounds.epsilon, bounds.epsilon_up)
    assert verified(paper, SMALL).valid


def test_no_shield_takes_a_certificate_of_the_paper(paper):
    with pytest.raises(ValueError, match="takes a Certificate"):
        safety_filter(paper, SMALL)
    with pytest.raises(ValueError, match="a Certificate, its document or path"):
        safety_shield(gym.make("ncs_gym/TruckTrailer-v0", plant=SMALL), paper)
    with pytest.raises(ValueError, match="takes a Certificate and a LinearPlant"):
        verify(paper, SMALL)


@pytest.mark.slow
def test_reported_scale_is_feasible_and_a_little_more_is_not():
    plant = truck_trailer()
    scan = FeasibilityScan(plant)
    scale = largest_scale(scan, plant)

    def scaled(factor):
        factor *= scale
        covariance = factor * 1e-4 * np.eye(2)
        bounds = {"gamma": factor * 5e-4, "process_noise_cov": covariance, "initial_cov": covariance}
        return library_plant(truck_trailer, **bounds)

    assert verified(paper_synthesis(scaled(0.97), dkappa=0.005, drho=0.01), scaled(0.97)).valid
    with pytest.raises(Infeasible):
        paper_synthesis(scaled(1.05), dkappa=0.05, drho=0.05)  # proven over the whole domain, whatever the grid


def test_no_uncertainty_at_all_is_no_division_by_zero():
    zero = np.zeros((2, 2))
    plant = library_plant(truck_trailer, gamma=0.0, process_noise_cov=zero, initial_cov=zero)
    assert verified(paper_synthesis(plant), plant).valid


@pytest.mark.parametrize("kappa", [float(np.nextafter(1.0, 0.0)), 1.0 - 1e-12, 0.0, -1.0, 1e70])
def test_constants_at_the_edge_are_rejected_without_an_error(paper, kappa):
    assert not verified(replace(paper, kappa=kappa, rho=1.0), SMALL).valid


# What is changed, and the condition that notices.
CHANGES = [
    ("(C3)", lambda c: replace(c, L=1.001 * c.L)),
    ("(C2)", lambda c: replace(c, L=1e-6 * c.L)),
    ("(C7)", lambda c: replace(c, L=c.L @ np.diag([1.0, 0.9]))),
    ("(C1)", lambda c: replace(c, K=c.K + 3.0)),
    ("(C4)-(C6)", lambda c: replace(c, K=c.K + 30.0)),
    ("eps_up and eps", lambda c: replace(c, kappa=0.7)),
    ("eps_up and eps", lambda c: replace(c, epsilon=0.1 * c.epsilon)),
    ("0 < kappa, 1", lambda c: replace(c, rho=2.0)),
    ("plant", lambda c: replace(c, fingerprint="0" * 64)),
]


@pytest.mark.parametrize(("condition", "change"), CHANGES)
def test_changed_part_is_noticed_by_the_right_condition(paper, condition, change):
    assert any(each.startswith(condition) for each in broken(change(paper), SMALL))


def test_grid_without_a_solution_says_so_also_in_a_copy():
    with pytest.raises(Infeasible, match="take smaller steps") as caught:
        paper_synthesis(SMALL, dkappa=0.4, drho=1.0)
    copy = pickle.loads(pickle.dumps(caught.value))
    assert (str(copy), copy.binding, copy.shortfall) == (str(caught.value), "OP", 1.0)
