import pickle
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import LinearPlant, truck_trailer
from shields import Infeasible, SafetyShield, certify, synthesize
from shields.paper.bounds import PaperModel
from shields.paper.feasibility import FeasibilityScan, largest_scale
from shields.runtime.guarantee import NO_ERROR_SET
from tests.verdicts import verified

SMALL = truck_trailer(gamma=1e-6, process_noise_cov=1e-6 * np.eye(2))


@pytest.fixture(scope="module")
def paper():
    return synthesize(SMALL, method="paper")


def test_certificate_carries_the_papers_constants_and_no_error_set(paper):
    assert paper.method == "paper"
    assert paper.Sigma is paper.error_set is paper.multipliers is None
    bounds = PaperModel(SMALL).at(paper.kappa, paper.rho)
    assert (paper.epsilon, paper.epsilon_up) == (bounds.epsilon, bounds.epsilon_up)
    assert verified(paper, SMALL).valid


@pytest.mark.cases(1)
@pytest.mark.parametrize(
    ("bounds", "search", "steps"),  # the first search for SMALL is the fixture's
    [
        ({"gamma": 1e-6, "process_noise_cov": 1e-6 * np.eye(2)}, "largest", (0.05, 0.1)),
        ({"gamma": 1e-5, "process_noise_cov": np.zeros((2, 2))}, "first", (0.02, 0.05)),
    ],
)
def test_where_op_succeeds_its_constraints_hold_exactly(bounds, search, steps):
    plant = truck_trailer(**bounds)
    certificate = synthesize(plant, method="paper", search=search, dkappa=steps[0], drho=steps[1])
    report = verified(certificate, plant)
    assert report.valid, str(report)
    assert {f"(C{i})" for i in (1, 2, 3, 7)} <= {c.name.split()[0] for c in report.conditions}


def test_exact_conditions_are_checked_separately(paper):
    assert paper.provenance["exact_conditions_hold"] is True
    assert "e'e <= epsilon" in paper.provenance["guarantee"]
    stronger = certify(SMALL, paper.L, paper.K)
    assert stronger is not None
    assert verified(stronger, SMALL).valid
    np.testing.assert_array_equal(stronger.L, paper.L)
    assert certify(SMALL, paper.L, 2.5 * paper.K) is None


def test_shield_with_a_paper_certificate_works_but_is_never_guaranteed(paper):
    env = SafetyShield(gym.make("ncs_gym/TruckTrailer-v0", plant=SMALL), paper)
    _, info = env.reset(seed=0)
    assert info["shield_reason"] == NO_ERROR_SET
    for _ in range(50):
        *_, info = env.step(np.ones(1, np.float32))
        assert not info["shield_guaranteed"]
        assert info["state"] @ paper.M @ info["state"] <= 1.0


@pytest.mark.slow
def test_printed_parameters_are_infeasible_and_the_reason_has_figures():
    with pytest.raises(Infeasible, match=r"\(C2\) binds") as caught:
        synthesize(truck_trailer(), method="paper", dkappa=0.05, drho=0.1)  # proven over the whole domain
    error = caught.value
    assert error.binding == "C2"
    assert error.shortfall == pytest.approx(1.0 - 0.034, abs=5e-4)
    assert error.details["ratio"] == pytest.approx(0.034, abs=5e-4)
    assert error.details["largest_gamma"] == 0.0
    copy = pickle.loads(pickle.dumps(error))
    assert (copy.binding, copy.details) == (error.binding, error.details)


@pytest.mark.slow
def test_reported_scale_is_feasible_and_a_little_more_is_not():
    plant = truck_trailer()
    scan = FeasibilityScan(plant)
    scale = largest_scale(scan, plant)

    def scaled(factor):
        factor *= scale
        return truck_trailer(
            gamma=factor * 5e-4, process_noise_cov=factor * 1e-4 * np.eye(2), initial_cov=factor * 1e-4 * np.eye(2)
        )

    assert verified(synthesize(scaled(0.97), "paper", dkappa=0.005, drho=0.01), scaled(0.97)).valid
    with pytest.raises(Infeasible):
        synthesize(scaled(1.05), "paper", dkappa=0.05, drho=0.05)  # proven over the whole domain, whatever the grid


def test_too_coarse_a_grid_says_so():
    with pytest.raises(Infeasible, match="use smaller steps") as caught:
        synthesize(SMALL, method="paper", dkappa=0.4, drho=1.0)
    assert caught.value.binding == "grid"


@pytest.mark.parametrize("unit", [1e-3, 1e4])
def test_units_of_the_state_change_nothing(unit, paper):
    scaled = replace(
        SMALL,
        B=SMALL.B * unit,
        box=SMALL.box_rows / unit,
        gamma=SMALL.gamma * unit**2,
        process_noise_cov=SMALL.process_noise_cov * unit**2,
        measurement_noise_cov=SMALL.measurement_noise_cov * unit**2,
        initial_cov=SMALL.initial_cov * unit**2,
    )
    certificate = synthesize(scaled, method="paper")
    assert verified(certificate, scaled).valid
    assert (certificate.kappa, certificate.rho) == (paper.kappa, paper.rho)
    np.testing.assert_allclose(certificate.L / unit**2, paper.L, rtol=1e-4)


def one_state(A, B, u_max, gamma, Q, P0):
    return LinearPlant(
        A=[[A]], B=[[B]], box=[[1.0]], u_max=u_max, dt=0.1, gamma=gamma, process_noise_cov=[[Q]], initial_cov=[[P0]]
    )


@pytest.mark.slow
def test_a_plant_no_gain_can_contract_is_infeasible_not_falsely_certified():
    with pytest.raises(Infeasible):
        synthesize(one_state(0.999, 1e-6, 1.0, 1e-12, 1e-13, 1e-12), method="paper", dkappa=0.05, drho=0.1)


@pytest.mark.slow
def test_an_input_limit_that_binds_is_named():
    with pytest.raises(Infeasible, match="input limit") as caught:
        synthesize(one_state(1.5, 1.0, 0.4, 9.985e-4, 9.985e-4, 9.985e-4), method="paper", dkappa=0.05, drho=0.1)
    assert caught.value.binding == "C5"
    assert 0.0 < caught.value.shortfall < 1.0


def test_no_uncertainty_at_all_is_no_division_by_zero():
    zero = np.zeros((2, 2))
    plant = truck_trailer(gamma=0.0, process_noise_cov=zero, initial_cov=zero)
    assert verified(synthesize(plant, method="paper"), plant).valid


@pytest.mark.parametrize("kappa", [float(np.nextafter(1.0, 0.0)), 1.0 - 1e-12, 0.0, -1.0, 1e70])
def test_constants_at_the_edge_are_rejected_without_an_error(paper, kappa):
    assert not verified(replace(paper, kappa=kappa, rho=1.0), SMALL).valid
