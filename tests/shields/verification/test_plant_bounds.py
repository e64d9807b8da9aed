"""Certificates for plants with bounds in plain terms: exact verification holds what is declared, and notices less."""

from dataclasses import replace

import numpy as np
import pytest

from ncs_gym import ChannelContract, Ellipsoid, LinearPlant, truck_trailer
from shields import synthesize
from tests.certificates import certificate_of
from tests.shields.verification.test_verification import replaced
from tests.verdicts import verified

BOUNDS = {
    "disturbance_bound": [0.03, 0.004],
    "sensor_bound": [0.02, 0.03],
    "initial_bound": ([[1.0, 0.2], [0.3, 0.4]], 0.02),
}
CASES = {
    "alone": dict.fromkeys(("process_noise_cov", "measurement_noise_cov", "initial_cov"), np.zeros((2, 2)))
    | {"gamma": 0.0},
    "with covariances": {"initial_cov": np.diag([1e-4, 0.0]), "gamma": 1e-4},
}


@pytest.fixture(scope="module", params=CASES)
def designed(request):
    plant = truck_trailer(4000.0, **CASES[request.param], **BOUNDS)
    return plant, certificate_of(plant)


def broken(certificate, plant):
    return [condition.name for condition in verified(certificate, plant).conditions if not condition.holds]


def test_certificate_for_declared_bounds_is_valid(designed):
    plant, certificate = designed
    assert verified(certificate, plant).valid


@pytest.mark.parametrize(
    ("name", "words"), [("disturbance_bound", "D: the plant's"), ("sensor_bound", "N:"), ("initial_bound", "r0:")]
)
def test_sets_that_miss_a_declared_bound_make_a_certificate_invalid(designed, name, words):
    plant, certificate = designed
    larger = replaced(plant, **{name: Ellipsoid(1.001 * getattr(plant, name).shape)})
    found = broken(certificate, larger)
    assert len(found) == 1
    assert found[0].startswith(words)


def test_disturbance_set_of_the_certificate_that_misses_the_bound_is_noticed(designed):
    plant, certificate = designed
    without = replace(plant, disturbance_bound=None)
    found = broken(replace(certificate, D=without.disturbance.shape_matrix), plant)
    assert any(name.startswith("D: the certificate's") for name in found)


@pytest.mark.parametrize("name", BOUNDS)
def test_certificate_belongs_to_its_declared_bounds(designed, name):
    plant, certificate = designed
    other = replace(plant, **{name: Ellipsoid(0.5 * getattr(plant, name).shape)})
    assert broken(certificate, other)[0].startswith("plant")


def test_noise_set_under_a_contract_holds_the_declared_noise():
    plant = truck_trailer(4000.0, **BOUNDS)
    certificate = certificate_of(plant, ChannelContract(1, 0.02))
    assert verified(certificate, plant).valid
    larger = replaced(plant, sensor_bound=Ellipsoid(1.001 * plant.sensor_bound.shape_matrix))
    found = broken(certificate, larger)
    assert len(found) == 1
    assert found[0].startswith("N:")


@pytest.mark.parametrize("name", BOUNDS)
def test_method_of_the_paper_refuses_bounds_that_its_theorems_do_not_know(name):
    small = truck_trailer(gamma=1e-6, process_noise_cov=1e-6 * np.eye(2))
    plant = replace(small, **{name: 1e-4})
    with pytest.raises(ValueError, match=f"method 'paper' knows gamma and covariances alone, not {name}"):
        synthesize(plant, method="paper")
    paper = synthesize(small, method="paper")
    assert verified(paper, small).valid
    assert not verified(replace(paper, fingerprint=plant.fingerprint), plant).valid


@pytest.mark.parametrize("input_delay", [1, 2])
def test_plant_with_delayed_inputs_goes_through_synthesis_and_verification(input_delay):
    rate, B, C = [[0.0, 1.0], [-0.2, -0.5]], [[0.0], [1.0]], [[1.0, 0.0]]
    bounds = {"disturbance_bound": [0.0005, 0.003], "sensor_bound": 0.01, "initial_bound": 0.02}
    settings = {"box": [1.0, 1.5], "u_max": 0.8, "dt": 0.1}
    plant = LinearPlant.from_statespace((rate, B, C, None), input_delay=input_delay, **settings, **bounds)
    certificate = synthesize(plant)
    assert verified(certificate, plant).valid
    rows = plant.box_rows[:2]
    assert (np.einsum("ij,jk,ik->i", rows, certificate.L, rows) <= 1.0).all()
    assert certificate.safe_set.support(np.eye(plant.n)[0]) > 0.5
    full = np.array([0.0, 0.0, *[0.8] * input_delay])
    assert certificate.safe_set.gauge(full) < 1.0  # inputs at their limits are allowed
