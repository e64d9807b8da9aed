"""Certificates for plants with bounds in plain terms: exact verification holds what is declared, and notices less."""

from dataclasses import replace

import numpy as np
import pytest

from ncs_gym import Ellipsoid, truck_trailer
from tests.certificates import certificate_of
from tests.plants import named
from tests.product import altered, library_plant, paper_synthesis
from tests.shields.verification.test_mutations import replaced
from tests.verdicts import broken, verified

BOUNDS = {
    "disturbance_bound": [0.03, 0.004],
    "sensor_bound": [0.02, 0.03],
    "initial_bound": ([[1.0, 0.2], [0.3, 0.4]], 0.02),
}


@pytest.fixture(scope="module")
def designed():
    """Declared bounds beside covariances; those of bounds alone are among the mutations."""
    plant = library_plant(truck_trailer, 4000.0, initial_cov=np.diag([1e-4, 0.0]), gamma=1e-4, **BOUNDS)
    return plant, certificate_of(plant)


@pytest.mark.parametrize(
    ("name", "words"), [("disturbance_bound", "D: the plant's"), ("sensor_bound", "N:"), ("initial_bound", "r0:")]
)
def test_sets_that_miss_a_declared_bound_make_a_certificate_invalid(designed, name, words):
    plant, certificate = designed
    assert verified(certificate, plant).valid
    larger = replaced(plant, **{name: Ellipsoid(1.001 * getattr(plant, name).shape_matrix)})
    found = broken(certificate, larger)
    assert len(found) == 1
    assert found[0].startswith(words)


def test_paper_certificate_proves_nothing_of_bounds_that_its_theorems_do_not_know():
    small = library_plant(truck_trailer, gamma=1e-6, process_noise_cov=1e-6 * np.eye(2))
    paper = paper_synthesis(small)
    assert verified(paper, small).valid
    for name in BOUNDS:
        plant = altered(small, **{name: 1e-4})
        assert not verified(replace(paper, fingerprint=plant.fingerprint), plant).valid


def test_certificate_of_delayed_inputs_allows_inputs_at_their_limits():
    plant, _ = named("delayed")
    certificate = certificate_of(plant)
    assert verified(certificate, plant).valid
    rows = plant.box_rows[:2]
    assert (np.einsum("ij,jk,ik->i", rows, certificate.L, rows) <= 1.0).all()
    assert certificate.safe_set.support(np.eye(plant.n)[0]) > 0.5
    assert certificate.safe_set.gauge(np.array([0.0, 0.0, 0.8])) < 1.0
