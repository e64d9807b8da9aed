"""Whether the sets D, N and X0 of a plant hold what was declared of it (docs/shield_proof.md, "Setting")."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from flint import arb, ctx, fmpq

from ncs_gym import Ellipsoid, LinearPlant
from ncs_gym.ellipsoid import TruncatedGaussian
from shields.certificate import Certificate
from shields.verification.rational_matrix import Condition
from tests.second_verifier.exact import PRECISION, at_least_zero, definite, identity, is_so, matrix, number

# No term of a sum of ellipsoids gets a smaller weight.
_SMALLEST_WEIGHT = 1e-9


class Part(NamedTuple):
    """One of the ellipsoids whose sum another one must hold.

    Attributes:
        shape: Its exact shape.
        size: About the size of its best weight; any proves containment, a good one proves it of a small set.
    """

    shape: Any
    size: float


def bound_conditions(certificate: Certificate, plant: LinearPlant) -> Iterator[Condition]:
    """Checks D, the plant's own sets, and N of a contract, against what the plant declares."""
    D, updates = matrix(certificate.D), certificate.updates
    weight, quantizer = plant.relative_weight, np.eye(plant.p)
    own = matrix(plant.disturbance.shape_matrix)
    ball = _part(number(plant.gamma) * identity(plant.n), weight)
    declared = [_declared(bound, weight) for bound in (plant.of_disturbance.bound, plant.remainder_bound)]
    disturbed = [ball, _noise(plant.process_noise, weight), *declared]
    yield _holds_sum("D: the plant's holds the disturbance and the process noise", own, disturbed)
    x_c, u_c = (matrix(each).transpose() for each in (certificate.resting_state, certificate.resting_input))
    moved = matrix(plant.A) * x_c + matrix(plant.B) * u_c - x_c  # zero at an equilibrium
    both = [_part(own, weight), _part(moved * moved.transpose(), weight)]
    yield _holds_sum("D: the certificate's holds the plant's", D, both)
    sensed = [_noise(plant.sensor_noise, quantizer), _declared(plant.of_sensor.bound, quantizer)]
    if updates is None:
        yield _holds_sum("N: holds the sensor noise", matrix(plant.sensor_error.shape_matrix), sensed)
    else:
        step = number(updates.contract.quantization_step)
        box = plant.p * step * step / 4 * identity(plant.p)  # in the ball around the box of |v_i| <= step/2
        sensed.append(_part(box, quantizer))
        yield _holds_sum("N: holds the sensor noise and the quantization error", matrix(updates.noise), sensed)
    first = [_noise(plant.initial_noise, weight), _declared(plant.of_first_error.bound, weight)]
    yield _holds_sum("X0: holds the error of the first estimate", matrix(plant.initial_error.shape_matrix), first)
    for what, noise in (
        ("process noise", plant.process_noise),
        ("sensor noise", plant.sensor_noise),
        ("first error", plant.initial_noise),
    ):
        if np.any(noise.covariance):
            yield keeps_enough(f"chi-square: no more than delta of the {what} is truncated", noise, plant)


def keeps_enough(name: str, noise: TruncatedGaussian, plant: LinearPlant) -> Condition:
    """Returns the condition that a truncation removes no more than the probability delta, in ball arithmetic."""
    with ctx.workprec(PRECISION):
        half = arb(number(noise.energy) / 2)
        removed = half.gamma_upper(arb(fmpq(len(noise.covariance), 2)), regularized=1)
        slack = (arb(number(plant.delta)) - removed).lower()
        if not slack.is_finite():
            return is_so(name, False)
        return at_least_zero(name, slack.fmpq())


def _noise(noise: TruncatedGaussian, weight: np.ndarray) -> Part:
    return _part(number(noise.energy) * matrix(noise.covariance), weight)


def _declared(bound: Ellipsoid | None, weight: np.ndarray) -> Part:
    """Returns a declared bound; zero if there is none."""
    return _part(matrix(np.zeros_like(weight) if bound is None else bound.shape_matrix), weight)


def _part(shape: Any, weight: np.ndarray) -> Part:
    """Returns an ellipsoid of an exact shape, with its size.

    The sum of P_i / w_i has the smallest trace, weighted with W, for w_i in proportion to sqrt(tr W P_i).
    """
    product = matrix(weight) * shape
    trace = sum((product[i, i] for i in range(product.nrows())), fmpq(0))
    return Part(shape, math.sqrt(max(float(trace), 0.0)))


def _holds_sum(name: str, outer: Any, parts: list[Part]) -> Condition:
    """Returns the condition that an ellipsoid holds the sum of others: outer - sum of P_i / w_i >= 0.

    For weights w_i > 0 of sum 1, (sum of sqrt(a'P_i a))^2 <= sum of a'P_i a / w_i for every a (Cauchy-Schwarz).
    """
    parts = [part for part in parts if any(part.shape.entries())]
    weights = _weights([part.size for part in parts])
    product = math.prod(weights, start=fmpq(1))
    difference = product * outer
    for part, weight in zip(parts, weights, strict=True):
        difference -= (product / weight) * part.shape
    return definite(name, difference, product)


def _weights(sizes: list[float]) -> list[Any]:
    """Returns rational weights of sum 1 near the proportion of some sizes; the largest takes what the others leave."""
    if not sizes:
        return []
    largest = max(range(len(sizes)), key=lambda index: sizes[index])
    total = math.fsum(sizes) or 1.0
    weights = [number(max(size / total, _SMALLEST_WEIGHT)) for size in sizes]
    weights[largest] = 1 - sum((weight for index, weight in enumerate(weights) if index != largest), fmpq(0))
    return weights
