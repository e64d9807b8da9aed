"""How often badly scaled and nearly unstable plants get a certificate; none may fail its verification.

python benchmarks/numerical_trust.py [plants per row] [largest number of states]
"""

from __future__ import annotations

import sys
import time
from collections import Counter

import numpy as np

from ncs_gym import LinearPlant
from shields import Infeasible, synthesize, verify

# States, inputs, powers of ten that units spread over each way, spectral radius, coupling.
ROWS = [
    (n, m, *row)
    for n, m in ((2, 1), (4, 2), (6, 3), (8, 2))
    for row in ((0, 0.99, 0.3), (6, 0.99, 0.3), (6, 0.9999, 0.3), (6, 0.9999, 2.0))
]


def badly_scaled_plant(seed: int, n: int, m: int, decades: float, radius: float, coupling: float = 0.3) -> LinearPlant:
    """A random plant whose states and inputs have units of their own, 10^U(-decades, decades) each.

    `coupling` is the size of what is above the diagonal of its Schur form: how far from normal A is.
    """
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.standard_normal((n, n)))[0]
    poles = np.append(radius, rng.uniform(-0.9, 0.95, n - 1))
    A = basis @ (np.diag(poles) + coupling * np.triu(rng.standard_normal((n, n)), 1)) @ basis.T
    state, put = 10.0 ** rng.uniform(-decades, decades, n), 10.0 ** rng.uniform(-decades, decades, m)
    size = 1e-2 * (1.0 - radius)  # of the noise in units of the box: what a slow plant can still reject
    noise = size**2 * np.diag(state**2)
    return LinearPlant(
        A=state[:, None] * A / state,
        B=state[:, None] * rng.standard_normal((n, m)) / put,
        box=np.diag(1.0 / state),
        u_max=put * rng.uniform(0.5, 2.0, m),
        dt=0.1,
        gamma=float(size * state.min()) ** 2,
        process_noise_cov=noise,
        measurement_noise_cov=noise,
        initial_cov=size**2 * float(state.min()) ** 2 * np.eye(n),
    )


def outcome(plant: LinearPlant) -> str:
    """ "certificate", or which condition of `Infeasible` binds; whatever else is raised or fails to verify is an error.

    Raises:
        AssertionError: If a certificate does not verify.
    """
    try:
        certificate = synthesize(plant, safe_set="ellipsoid")
    except Infeasible as infeasible:
        return f"infeasible: {infeasible.binding}"
    report = verify(certificate, plant)
    if not report.valid:
        raise AssertionError(f"a certificate does not verify:\n{report}")
    return "certificate"


def main(count: int, most_states: int) -> None:
    print(f"{'n':>2} {'m':>2} {'units':>14} {'radius':>7} {'coupling':>8} {'certified':>9} {'s/plant':>8}  others")
    for n, m, decades, radius, coupling in (row for row in ROWS if row[0] <= most_states):
        start = time.perf_counter()
        found = Counter(outcome(badly_scaled_plant(seed, n, m, decades, radius, coupling)) for seed in range(count))
        seconds = (time.perf_counter() - start) / count
        certified = found.pop("certificate", 0)
        units = f"1e-{decades}..1e{decades}" if decades else "1"
        others = ", ".join(f"{each} {name}" for name, each in sorted(found.items()))
        row = f"{n:>2} {m:>2} {units:>14} {radius:>7} {coupling:>8} {certified:>5}/{count:<3} {seconds:>8.2f}  {others}"
        print(row, flush=True)


if __name__ == "__main__":
    given = [int(argument) for argument in sys.argv[1:]]
    main(*given, *(20, 8)[len(given) :])
