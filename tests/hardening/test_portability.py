"""The same on every processor: plants, certificates, agents and finished runs, made by other kernels and instructions.

OpenBLAS takes the kernels that `OPENBLAS_CORETYPE` names, numpy leaves out the instructions that
`NPY_DISABLE_CPU_FEATURES` names; both are read when a process starts.
"""

import json
import os
import platform
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction
from functools import cache
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import ncs_gym
from ncs_gym import Ellipsoid
from shields.verification.rational_matrix import add, congruence, is_positive_semidefinite, rational, scale, subtract
from tests.certificates import ROOT, certificate_of, metric
from tests.product import altered, family_of, linear_plant, safety_filter

on_x86 = pytest.mark.skipif(
    platform.machine() not in ("x86_64", "AMD64"), reason="only x86 has kernels that can be chosen"
)

WIDE = "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR AVX2 FMA3 X86_V4 X86_V3"


@cache
def can_run(kernels: str) -> bool:
    """Whether a product of matrices with these kernels ends; without their instructions the processor stops it."""
    product = "import numpy as np; np.ones((64, 64)) @ np.ones((64, 64)); np.linalg.inv(np.eye(64))"
    environment = os.environ | {"OPENBLAS_CORETYPE": kernels}
    return subprocess.run([sys.executable, "-c", product], env=environment, capture_output=True).returncode == 0


def plants_around_points():
    """Plants whose operating point is found or moves limits: disturbances with two ends, limits of sums, families."""
    rng, found = np.random.default_rng(0), {}

    def of(index, k=1.0, **more):
        A = np.array([[0.9, 0.1 * k, 0.0], [0.0, 1.0, 0.2], [-0.1, 0.0, 0.7 * k]]) + 1e-3 * index
        limits = {"state_limits": ([-1.0, -3.0, 0.1], [2.0, 5.0, 1e3]), "input_limits": ([-0.4, 0.0], [1.0, 70.0])}
        limits["output_limits"] = [([1.0, 0.7, 1e-3], -20.0, 30.0)]
        ends = [-0.01, 0.0, -0.3], [0.03, 0.002, 0.1]
        bounds = {"disturbance_bound": (np.eye(3), *ends), "sensor_bound": 0.01, "initial_bound": 0.01}
        rests = {"operating_state": [0.3, 0.7, 33.3], "operating_input": [0.1, 30.1]}
        B = [[0.2 * k, 0.01], [0.0, 0.03], [0.1, 0.5]]
        return linear_plant(A=A, B=B, dt=0.1, **limits, **bounds, **rests, **more)

    for index in rng.integers(0, 99, 3).tolist():
        found[f"point {index}"] = of(index)
        found[f"family {index}"] = family_of([of(index), of(index, 1.01)], at_rest=True)
    return found


def print_points():
    print(json.dumps({name: plant.fingerprint for name, plant in plants_around_points().items()}))


def under(kernels, *command, wide=True):
    """What a command prints in a process with other kernels, and without numpy's wide instructions unless `wide`."""
    if not can_run(kernels):
        pytest.skip(f"this processor lacks instructions of the kernels of {kernels}")
    environment = os.environ | {"OPENBLAS_CORETYPE": kernels} | ({} if wide else {"NPY_DISABLE_CPU_FEATURES": WIDE})
    command = [sys.executable, "-W", "ignore", *map(str, command)]
    run = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return run.stdout


def call(function, *arguments):
    """A command that calls a function of this module."""
    file = Path(__file__).resolve()
    load = f"import runpy; runpy.run_path({str(file)!r})[{function.__name__!r}]"
    return "-c", f"{load}(*{tuple(map(str, arguments))!r})"


@on_x86
@pytest.mark.slow
@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.filterwarnings("ignore::ncs_gym.limits.MovedOperatingPointWarning")
def test_operating_points_that_are_found_are_the_same_under_other_kernels(wide):
    expected = {name: plant.fingerprint for name, plant in plants_around_points().items()}
    assert json.loads(under("Prescott", *call(print_points), wide=wide)) == expected


@pytest.mark.parametrize(
    "name",
    ["TruckTrailerCruise", *(pytest.param(name, marks=pytest.mark.slow) for name in ("CartPole", "BatchReactor"))],
)
def test_verdicts_are_true_in_any_order_of_summation(name):
    """With the states in other orders every sum is taken in another order; what passes lies inside, exactly."""
    env = gym.make(f"ncs_gym/{name}-v0").unwrapped
    plant, rng = env.plant, np.random.default_rng(3)
    certificate = certificate_of(plant, env.certificate_contract)
    shape = certificate.error_shapes[0]
    orders = [np.arange(plant.n), np.arange(plant.n)[::-1], rng.permutation(plant.n)]
    filters = [safety_filter(*reordered(certificate, plant, order)) for order in orders]
    passed = 0
    for _ in range(30):
        direction = rng.standard_normal(plant.n)
        direction /= certificate.safe_set.gauge(direction)
        u, low, high = rng.uniform(-1.0, 1.0, plant.m) * plant.largest_input, 0.0, 2.0
        for _ in range(50):  # to the edge of what passes, where the last bits decide
            middle = 0.5 * (low + high)
            passes = filters[0].decide(middle * direction, shape, u).reason == "safe"
            low, high = (middle, high) if passes else (low, middle)
        x_hat = low * direction
        for each, order in zip(filters, orders, strict=True):
            decision = each.decide(x_hat[order], shape[np.ix_(order, order)], u)
            if decision.reason == "safe":
                passed += 1
                assert is_inside_exactly(certificate, plant, x_hat, shape, u)
    assert passed >= 30


def reordered(certificate, plant, order):
    """Certificate and plant with the states in another order; the proof of the certificate does not change."""
    square = np.ix_(order, order)
    bounds = {
        name: bound and ncs_gym.Ellipsoid(bound.shape_matrix[np.ix_(*2 * [order[: bound.dim]])])
        for name, bound in (
            ("disturbance_bound", plant.of_disturbance.bound),
            ("initial_bound", plant.of_first_error.bound),
        )
    }
    names = {name: [getattr(plant, name)[i] for i in order] for name in ("state_names", "state_units")}
    turned = altered(
        plant,
        A=plant.A[square],
        B=plant.B[order],
        box=plant.box[:, order],
        H=plant.H[:, order],
        process_noise_cov=plant.process_noise.covariance[square],
        initial_cov=plant.initial_noise.covariance[square],
        operating_state=plant.operating_state[order],
        continuous_model=None,
        **bounds,
        **names,
    )
    updates = certificate.updates
    if updates is not None:
        updates = replace(updates, last=updates.last[square], gains=updates.gains[:, order])
    return (
        replace(
            certificate,
            safe_set=Ellipsoid(certificate.safe_set.shape_matrix[square]),
            K=certificate.K[:, order],
            proofs=tuple(replace(proof, Sigma=proof.Sigma[square]) for proof in certificate.proofs),
            D=certificate.D[square],
            updates=updates,
            fingerprint=turned.fingerprint,
        ),
        turned,
    )


def is_inside_exactly(certificate, plant, x_hat, shape, u):
    """Whether {A x_hat + B u} + E(A P A') + E(D) lies in E(L) for some multipliers, in rational arithmetic."""
    column = [[Fraction(float(x))] for x in [*x_hat, *u]]
    both = [[*a, *b] for a, b in zip(rational(plant.A), rational(plant.B), strict=True)]
    center = [sum(a * b[0] for a, b in zip(row, column, strict=True)) for row in both]
    moved, D, L = (
        congruence(rational(plant.A), rational(shape)),
        rational(plant.disturbance.shape_matrix),
        rational(certificate.safe_set.shape_matrix),
    )
    sizes = [
        np.sqrt(np.trace(metric(certificate) @ part))
        for part in (plant.A @ shape @ plant.A.T, plant.disturbance.shape_matrix)
    ]
    nus = np.clip(sizes[0] / sum(sizes) + np.linspace(-0.02, 0.02, 9), 1e-9, 1.0 - 1e-9)
    M, c = metric(certificate), np.array([float(x) for x in center])
    for nu in map(Fraction, nus.tolist()):
        total = add(scale(1 / nu, moved), scale(1 / (1 - nu), D))
        spread = np.linalg.eigvals(M @ np.array([[float(x) for x in row] for row in total])).real.max()
        for t in map(Fraction, np.clip(np.sqrt(spread) + np.linspace(-0.05, 0.05, 11), 1e-6, 1 - 1e-6).tolist()):
            # {c} + E(P) lies in E(L) if [t, c'; c, L - P/(1-t')] >= 0 for 1-t' = the share of P, t = 1 - t'.
            rest = subtract(L, scale(1 / t, total))
            block = [[1 - t, *center]] + [[x, *row] for x, row in zip(center, rest, strict=True)]
            if is_positive_semidefinite(block):
                return True
    return bool(c @ M @ c < 0.0)
