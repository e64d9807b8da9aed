"""How long the two verifiers take: for one condition, and for all of a certificate.

python benchmarks/verification.py [largest number of states]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from ncs_gym import ChannelContract, LinearPlant, batch_reactor, cart_pole, truck_trailer
from shields import synthesize, verify
from shields.verification.conditions import matrix_condition
from shields.verification.flint import exact
from shields.verification.rational_matrix import add, congruence, rational, scale, subtract

# Random plants, by their number of states.
SIZES = (2, 4, 6, 8, 12)
# Each time is the smallest of so many.
REPEATS = 5


def milliseconds(judge: Callable[[], object]) -> float:
    """The shortest of some runs."""
    durations = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        judge()
        durations.append(time.perf_counter() - start)
    return 1e3 * min(durations)


def error_bound_by_fractions(A: np.ndarray, Sigma: np.ndarray, D: np.ndarray, lam: float) -> bool:
    """(E1) as the first engine decides it."""
    exact_lam = rational(np.array([[lam]]))[0][0]
    moved = add(scale(1 / exact_lam, congruence(rational(A), rational(Sigma))), scale(1 / (1 - exact_lam), rational(D)))
    return matrix_condition("(E1)", subtract(rational(Sigma), moved)).holds


def error_bound_by_flint(A: np.ndarray, Sigma: np.ndarray, D: np.ndarray, lam: float) -> bool:
    """(E1) as the second engine decides it."""
    rate, shape = exact.number(lam), exact.matrix(Sigma)
    rest = 1 - rate
    moved = rest * exact.mapped(exact.matrix(A), shape) + rate * exact.matrix(D)
    return exact.definite("(E1)", rate * rest * shape - moved, rate * rest).holds


def random_condition(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """(A, Sigma, D, lam) of a random plant for which (E1) holds."""
    rng = np.random.default_rng(n)
    A = rng.standard_normal((n, n))
    A *= 0.5 / np.linalg.norm(A, 2)
    root = rng.standard_normal((n, n))
    Sigma = np.eye(n) + 0.01 * (root @ root.T)
    return A, 0.5 * (Sigma + Sigma.T), 0.01 * np.eye(n), 0.7


def row(name: str, first: float, second: float) -> None:
    """Prints one row."""
    print(f"{name:38s}{first:12.2f}{second:12.2f}{first / second:9.1f}x", flush=True)


def main(most_states: int) -> None:
    print(f"{'':38s}{'rational':>12s}{'flint':>12s}{'ratio':>10s}\n{'':38s}{'[ms]':>12s}{'[ms]':>12s}")
    for n in (size for size in SIZES if size <= most_states):
        arguments = random_condition(n)
        judges = [partial(each, *arguments) for each in (error_bound_by_fractions, error_bound_by_flint)]
        assert all(judge() for judge in judges)
        row(f"one condition (E1), n = {n}", *map(milliseconds, judges))
    cases: list[tuple[str, LinearPlant, ChannelContract | None]] = [
        ("truck-trailer, 4000 kg, n = 2", truck_trailer(mass=4000.0), None),
        ("cart-pole, max_age 3, n = 4", cart_pole(), ChannelContract(3, 1e-4)),
        ("batch reactor, max_age 3, n = 4", batch_reactor(), ChannelContract(3, 1e-3)),
    ]
    for name, plant, promised in cases:
        certificate = synthesize(plant, contract=promised, safe_set="ellipsoid")
        reports = [partial(verify, certificate, plant, engine=engine) for engine in ("rational", "flint")]
        assert all(report().valid for report in reports)
        row(name, *map(milliseconds, reports))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else SIZES[-1])
