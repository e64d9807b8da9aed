"""Nature at its worst: first errors of full size, whatever their bound was declared as."""

import numpy as np
import pytest

from experiments.attack.worst_case import WorstCaseVectorEnv, starts_in_box
from ncs_gym import Channel, Ellipsoid, LinearPlant
from shields import VectorSafetyShield
from tests.certificates import certificate_of
from tests.shields.polytope.limits import PLANTS, certificate

COUNT = 32
SLANTED = np.array([[4e-4, 1e-4], [1e-4, 1e-4]])
ACROSS, ALONG = np.array([[1.0], [2.0]]), np.array([[1.0, 0.0], [1.0, 1.0]])


def plant_with(**first_error) -> LinearPlant:
    """A plant in the unit box whose first error is bounded in the way given."""
    return LinearPlant(
        A=[[0.9, 0.1], [0.0, 0.8]],
        B=[[0.0], [0.1]],
        H=[[1.0, 0.0]],
        box=[1.0, 1.0],
        u_max=2.0,
        dt=0.1,
        disturbance_bound=0.002,
        sensor_bound=0.002,
        **first_error,
    )


def first_errors(plant: LinearPlant) -> np.ndarray:
    """First errors of the campaign, shape (COUNT, n); no step of it breaks an assumption."""
    certificate = certificate_of(plant)
    env = VectorSafetyShield(WorstCaseVectorEnv(COUNT, certificate, plant=plant, channel=Channel()), certificate)
    _, info = env.reset(seed=0)
    errors = info["estimation_error"]
    for _ in range(20):
        *_, info = env.step(np.ones((COUNT, 1), np.float32))
        assert not info["assumption_violated"].any()
        assert info["shield_guaranteed"].all()
    return errors


@pytest.mark.cases(2)
@pytest.mark.parametrize(
    ("bound", "use"),
    [
        (0.02, lambda e: np.linalg.norm(e, axis=1) / 0.02),
        ([0.01, 0.03], lambda e: np.linalg.norm(e / [0.01, 0.03], axis=1) / np.sqrt(2.0)),
        (Ellipsoid(SLANTED), lambda e: np.sqrt(np.einsum("ij,ji->i", e, np.linalg.solve(SLANTED, e.T)))),
        ((ACROSS, 0.01), lambda e: np.abs(e[:, 0]) / 0.01 + np.abs(e[:, 1] - 2.0 * e[:, 0])),
        ((ALONG, [0.01, 0.02]), lambda e: np.hypot(e[:, 0] / 0.01, (e[:, 1] - e[:, 0]) / 0.02) / np.sqrt(2.0)),
    ],
    ids=["number", "half-widths", "ellipsoid", "one direction", "two directions"],
)
def test_first_errors_attain_the_declared_bound(bound, use):
    errors = first_errors(plant_with(initial_bound=bound))
    np.testing.assert_allclose(use(errors), 1.0, atol=1e-6)
    assert np.ptp(errors, axis=0).min() > 0.0


def test_first_errors_attain_the_bound_of_a_covariance_and_of_what_is_declared_besides():
    covariance = 1e-5 * np.eye(2)
    alone, both = (plant_with(initial_cov=covariance, initial_bound=bound) for bound in (0.0, 0.02))
    radius = np.sqrt(alone.initial_radius_squared)
    np.testing.assert_allclose(np.linalg.norm(first_errors(alone), axis=1), radius, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(first_errors(both), axis=1), radius + 0.02, rtol=1e-6)


def test_starts_in_the_box_are_drawn_from_all_of_it():
    plant = PLANTS["angle"]
    starts = starts_in_box(np.random.default_rng(0), plant, certificate("angle"), 4000)[1::2]
    (low, high), reached = plant.own_limits, [starts.min(axis=0), starts.max(axis=0)]
    np.testing.assert_allclose(reached, [low, high], atol=0.01)
    np.testing.assert_allclose(starts.mean(axis=0), 0.5 * (low + high), atol=0.03)
