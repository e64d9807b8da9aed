"""The verdict of both verifiers, which have no code in common, and the truth of what they accept by another route."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from scipy.linalg import expm

from ncs_gym import Ellipsoid, LinearPlant
from shields import Certificate, Report, paper, verify
from shields.paper import PaperCertificate
from tests.second_verifier.verify import verify_again

# For what floats round where a claim is looked at without exact arithmetic.
ROUNDING = 1.0 + 1e-9


def verified(certificate: Certificate | PaperCertificate, plant: LinearPlant) -> Report:
    """The report of the verifier, after the second has come to the same verdict on every condition."""
    first = (paper.verify if isinstance(certificate, PaperCertificate) else verify)(certificate, plant)
    second = verify_again(certificate, plant)
    assert first.valid == second.valid, f"{first}\n\n{second}"
    if isinstance(certificate, PaperCertificate):  # (C1) and (C7) are stated in other words, and (C1) needs L > 0
        one, other = broken_constraints(first), broken_constraints(second)
        assert one - other <= ({"(C1)"} if "L" in one else set()), (first, second)
        assert other <= one, (first, second)
    else:
        judged = {condition.name: condition.holds for condition in first.conditions}
        again = {condition.name: condition.holds for condition in second.conditions}
        # Of a matrix that is no shape the second takes no root and has no margin, where the first takes zero.
        no_set = {condition.name: False for condition in second.conditions if np.isnan(condition.margin)}
        assert judged | no_set == {name: again[name] for name in judged | no_set}, (first, second)
        # Conditions between samples are left out by the first where others fail.
        assert not first.valid or all(name.startswith("chi-square") for name in again.keys() - judged), (first, second)
    assert all((condition.margin >= 0.0) == condition.holds for condition in second.conditions)
    return first


def broken(certificate: Certificate | PaperCertificate, plant: LinearPlant) -> list[str]:
    """The names of the conditions that do not hold, by both verifiers."""
    return [condition.name for condition in verified(certificate, plant).conditions if not condition.holds]


def broken_constraints(report: Report) -> set[str]:
    """The first words of the conditions that do not hold."""
    return {condition.name.split()[0] for condition in report.conditions if not condition.holds}


def support(shape: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The largest values of directions over an ellipsoid."""
    return np.sqrt(np.maximum(np.einsum("...i,ij,...j->...", directions, shape, directions), 0.0))


def assert_true(certificate: Certificate, plant: LinearPlant) -> None:
    """What a certificate of two states claims holds, by support functions: no multiplier, no matrix inequality."""
    angles = np.linspace(0.0, np.pi, 361)
    a = np.column_stack([np.cos(angles), np.sin(angles)])
    assert_errors_stay(certificate, plant, a)
    D, K = plant.disturbance.shape_matrix, certificate.K
    closed, gain = plant.A + plant.B @ K, plant.B @ K
    S = certificate.safe_set
    rows = a if isinstance(S, Ellipsoid) else S.rows

    def reach(rows: np.ndarray) -> np.ndarray:
        return support(S.shape_matrix, rows) if isinstance(S, Ellipsoid) else np.abs(rows @ corners_of(S.F).T).max(-1)

    assert (reach(a) > 0.0).all()
    errors = np.max([support(gain @ Sigma @ gain.T, rows) for Sigma in certificate.error_shapes], axis=0)
    assert (reach(rows @ closed) + errors + support(D, rows) <= ROUNDING * reach(rows)).all()
    assert (reach(plant.box) <= ROUNDING).all()
    used = np.max([support(Sigma, K) for Sigma in certificate.error_shapes], axis=0)
    assert (reach(K) + used <= ROUNDING * plant.largest_input).all()
    for within in between(plant, 20 if plant.between_samples else 0):
        moved = within[:, : plant.n] + within[:, plant.n :] @ K
        pushed = [support(Sigma, within[:, plant.n :] @ K) for Sigma in certificate.error_shapes]
        assert (reach(moved) + np.max(pushed, axis=0) + support(D, plant.box) <= ROUNDING).all()


def assert_errors_stay(certificate: Certificate, plant: LinearPlant, a: np.ndarray) -> None:
    """Errors of every age are in the set of their age, in the given directions."""
    D = support(plant.disturbance.shape_matrix, a)
    shapes = [certificate.error_shapes[0], *certificate.next_error_shapes]
    assert (support(plant.initial_error.shape_matrix, a) <= ROUNDING * support(shapes[0], a)).all()
    for older, newer in zip(shapes[1:], shapes[:-1], strict=True):
        assert (support(plant.A @ newer @ plant.A.T, a) + D <= ROUNDING * support(older, a)).all()
    if certificate.updates is not None:
        noise = plant.sensor_error_with(certificate.contract.quantization_step).shape_matrix
        for shape, T in zip(shapes[1:], certificate.updates.gains, strict=True):
            kept = np.eye(plant.n) - T @ plant.H
            updated = support(kept @ shape @ kept.T, a) + support(T @ noise @ T.T, a)
            assert (updated <= ROUNDING * support(shapes[0], a)).all()


def corners_of(faces: np.ndarray) -> np.ndarray:
    """The corners of the polygon of all x with |g x| <= 1 for every face g, but for signs."""
    pairs = [np.array(pair) for pair in combinations(faces, 2) if abs(np.linalg.det(pair)) > 1e-12]
    points = np.concatenate([np.linalg.solve(pair, np.array([[1.0, 1.0], [1.0, -1.0]])).T for pair in pairs])
    return points[np.abs(points @ faces.T).max(axis=1) <= ROUNDING]


def between(plant: LinearPlant, points: int) -> list[np.ndarray]:
    """Rows of the box on state and input at times within a step, by the matrix exponential."""
    if not points:
        return []
    G = np.concatenate([plant.model.continuous, np.zeros((plant.m, plant.n + plant.m))])
    return [plant.box @ expm(G * (plant.dt * i / points))[: plant.n] for i in range(1, points)]
