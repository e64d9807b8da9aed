"""Rounding must never turn "passed" into a lie: judged in rational arithmetic, far out and for thin safe sets."""

from dataclasses import replace
from fractions import Fraction

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import Channel
from shields import CertificateError
from shields.polytope import Polytope
from shields.runtime.guard import FAR_OUT, NOT_KNOWN_INSIDE
from shields.runtime.safety_filter import require_computable
from shields.runtime.set_test import certified_root, ellipsoid_test
from shields.verification.rational_matrix import (
    congruence,
    is_positive_semidefinite,
    multiply,
    rational,
    scale,
    subtract,
)
from tests.certificates import certificate_of, with_proof
from tests.plants import named
from tests.product import altered, linear_plant, loop_env, safety_filter, safety_shield
from tests.shields.edges import edge_of

SINGULAR = np.array([[0.5, -0.3], [0.25, -0.15]])


def exact_level(certificate, plant, x, u, d):
    """x+' L^-1 x+ - 1 of two states, exactly."""
    column = lambda vector: [[Fraction(float(entry))] for entry in vector]  # noqa: E731
    moved = zip(multiply(rational(plant.A), column(x)), multiply(rational(plant.B), column(u)), column(d), strict=True)
    p, q = (sum(row[0] for row in rows) for rows in moved)
    (a, b), (_, c) = rational(certificate.safe_set.shape_matrix)
    return float((c * p * p - 2 * b * p * q + a * q * q) / (a * c - b * b) - 1)


def worst_disturbance(certificate, plant, x, u):
    """Roughly the worst d on the boundary of E(D), shrunk so that it is inside."""
    d = np.zeros(2)
    for _ in range(5):
        slope = np.linalg.solve(certificate.safe_set.shape_matrix, plant.A @ x + plant.B @ u + d)
        d = plant.nominal_disturbance.extreme_point(slope)
    return (1 - 1e-12) * d


@pytest.mark.parametrize("count", [60, pytest.param(600, marks=pytest.mark.slow)])
@pytest.mark.parametrize("size", [1.0, 1e4, 1e7, 1e10, 1e13])
def test_passed_means_inside_however_far_out_the_estimate_is(size, count):
    # Estimates along a direction that A annihilates: products of huge numbers cancel.
    plant = linear_plant(A=SINGULAR, B=np.ones((2, 1)), box=np.eye(2), u_max=1.0, dt=0.1, gamma=1e-6)
    certificate = certificate_of(plant)
    shield, rng = safety_filter(certificate, plant), np.random.default_rng(0)
    *_, axes = np.linalg.svd(SINGULAR)
    passed, worst = 0, -1.0
    for _ in range(count):
        inwards, u = rng.choice([-1.0, 1.0]) * axes[0], rng.uniform(-1, 1, 1)
        base = axes[1] * size * rng.uniform(0.5, 1.0)

        def passes(way, base=base, inwards=inwards, u=u):
            return shield.decide(base + way * inwards, np.zeros((2, 2)), u).reason == "safe"

        way = edge_of(passes, 8.0)
        x = base + way * inwards
        if passes(way):
            passed += 1
            worst = max(worst, exact_level(certificate, plant, x, u, worst_disturbance(certificate, plant, x, u)))
    assert worst <= 0.0
    assert passed > count // 6
    assert worst > -1e-4 or size > 1e7  # at the edge, as far as float64 can tell


def slanted(ratio):
    """A plant whose box is `ratio` times longer than wide, and not along the axes."""
    c, s = np.cos(0.6), np.sin(0.6)
    C = np.diag([1.0, ratio]) @ np.array([[c, s], [-s, c]])
    T, size = np.linalg.inv(C), (0.1 / ratio) ** 2
    return linear_plant(
        A=T @ np.array([[0.6, 0.2], [-0.1, 0.5]]) @ C,
        B=T @ np.array([[1.5], [1.2]]),
        box=C,
        u_max=1.0,
        dt=0.1,
        gamma=size,
        initial_cov=size * np.eye(2),
        measurement_noise_cov=size * np.eye(2),
    )


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_root_never_understates_the_norm(size):
    rng = np.random.default_rng(0)
    for n in (1, 2, 3, 6):
        G = rng.standard_normal((n, n)) * 10.0 ** rng.uniform(-3, 3, n)[:, None]
        L = size * (G @ G.T)
        L = 0.5 * (L + L.T)
        root = certified_root(L)
        identity = rational(np.eye(n))
        assert is_positive_semidefinite(subtract(congruence(rational(root), rational(L)), identity))
        assert not is_positive_semidefinite(subtract(congruence(rational((1 - 1e-8) * root), rational(L)), identity))


@pytest.mark.parametrize("tilt", [0.0, 2.0**10, 2.0**20])
def test_known_inside_is_true_to_the_last_bit_without_any_margin(tilt):
    # The root of this L is exact; only products with it round, by terms of size `tilt` that cancel.
    factor = np.array([[1.0, 0.0], [tilt, 1.0]])
    test, rng = ellipsoid_test(factor @ factor.T, slanted(10.0)), np.random.default_rng(0)
    errors = test.predicted(np.zeros((1, 2, 2)), np.zeros((0, 2, 2))).single()
    for _ in range(60):
        x = factor @ rng.standard_normal(2)
        size = edge_of(lambda size, x=x: test.knows_inside(size * x, errors, 0.0), 1e3, tries=70)
        p, q = (Fraction(float(entry)) for entry in size * x)
        assert size > 0.0
        assert p * p + (q - Fraction(tilt) * p) ** 2 <= 1


@pytest.mark.parametrize("count", [16, pytest.param(160, marks=pytest.mark.slow)])
@pytest.mark.parametrize("tilt", [2.0**8, 2.0**10, 2.0**12])
def test_known_inside_leaves_room_for_the_error_to_the_last_bit_without_any_margin(tilt, count):
    factor = np.array([[1.0, 0.0], [tilt, 1.0]])
    L, rng, nothing, closest = factor @ factor.T, np.random.default_rng(0), np.zeros((0, 2, 2)), 0.0
    test = ellipsoid_test(L, slanted(10.0))
    for _ in range(count):
        root = factor @ rng.standard_normal((2, 2))
        shape = 0.5 * (root @ root.T + (root @ root.T).T)

        def knows(size, shape=shape):
            return test.knows_inside(np.zeros(2), test.predicted(size * shape[None], nothing).single(), 0.0)

        size = edge_of(knows, 1e3)
        assert size > 0.0
        assert is_positive_semidefinite(subtract(rational(L), rational(size * shape)))
        grown = scale(1 + Fraction(1, 10**4), rational(size * shape))
        closest += not is_positive_semidefinite(subtract(rational(L), grown))
    assert closest > count // 2


def test_gain_may_be_as_large_as_float64_computes_it_accurately(certificate, loaded):
    # A quarter of a float32 step of the limit, against n + 2 roundings of sums of |K| |x_hat|.
    thin = with_proof(certificate, Sigma=certificate.Sigma * [[1.0, 0.1], [0.1, 0.01]])
    extent = np.sqrt(np.diag(thin.safe_set.shape_matrix)) + np.sqrt(np.diag(thin.Sigma))
    assert extent[0] > 1.05 * extent[1] or extent[1] > 1.05 * extent[0]
    largest = 0.25 * 2.0**-24 * 4.0 / (4 * 2.0**-52 * extent.sum())
    require_computable(replace(thin, K=0.99 * largest * np.array([[1.0, -1.0]])), loaded)
    with pytest.raises(CertificateError, match="gain is too large"):
        require_computable(replace(thin, K=1.01 * largest * np.array([[1.0, -1.0]])), loaded)


@pytest.mark.cases(2)
@pytest.mark.parametrize("first_error", [0.0, 1e-6])
@pytest.mark.parametrize("name", ["singular", "slanted"])
def test_error_lies_in_its_ellipsoid_exactly_when_rounding_is_all_there_is(name, first_error):
    # No noise but a disturbance of the user's that asks for all of E(D), from up to 60 half-widths out.
    base = linear_plant(A=SINGULAR, B=np.ones((2, 1)), box=np.eye(2), u_max=1.0, dt=0.1, gamma=0.0)
    plant = altered(base if name == "singular" else slanted(30.0), gamma=0.0, measurement_noise_cov=None)
    plant = altered(plant, initial_cov=first_error**2 * np.eye(2))
    sign = [1.0]

    def everything(rng, plant, nominal_next):
        sign[0] = -sign[0] if rng.random() < 0.2 else sign[0]
        return sign[0] * plant.disturbance.extreme_point(plant.half_widths * [1.0, -1.0])

    for channel in (Channel(), Channel(loss=1.0), Channel(loss=0.5, delay=1)):
        env = loop_env(plant, channel, disturbance=everything)
        for seed in range(2):
            far = plant.half_widths * np.random.default_rng(seed).uniform(-1, 1, 2) * (60.0 if seed % 2 else 0.9)
            _, info = env.reset(seed=seed, options={"state": far})
            for action in np.random.default_rng(seed).uniform(-1, 1, (40, 1)):
                error = [
                    Fraction(float(a)) - Fraction(float(b))
                    for a, b in zip(info["estimate"], info["state"], strict=True)
                ]
                rows = [[Fraction(1), *error]]
                rows += [[z, *row] for z, row in zip(error, rational(info["error_shape"]), strict=True)]
                assert is_positive_semidefinite(rows)
                info = env.step(action)[4]


@pytest.mark.parametrize("size", [3.0, 1e3, 1e8])
def test_start_far_out_is_recovered_from_only_while_rounding_does_not_count(certificate, size):
    env = safety_shield(gym.make("ncs_gym/TruckTrailerCruise-v0"), certificate)
    _, info = env.reset(seed=0, options={"state": np.array([size, 0.0])})
    assert info["shield_reason"] == (FAR_OUT if size > 100.0 else NOT_KNOWN_INSIDE)
    for _ in range(199):
        *_, info = env.step(np.zeros(1, np.float32))
    assert info["shield_guaranteed"] is (size < 100.0)


def test_polytope_that_is_wider_than_floats_tell_has_no_gain_that_floats_compute():
    """Its second state gets to 2^50, where the pseudoinverse of the rows says 1."""
    plant, contract = named("servo")
    rows = np.array([[1.0, 1.0], [1.0, 1.0 + 2.0**-50]])
    thin = replace(
        certificate_of(plant, contract, "polytope"), safe_set=Polytope(rows=rows, multipliers=np.zeros((3, 2)))
    )
    assert thin.safe_set.widths.max() < 2.0
    with pytest.raises(CertificateError, match="the gain is too large"):
        require_computable(thin, plant)
