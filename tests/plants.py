"""Plants for property tests."""

from __future__ import annotations

import numpy as np

from ncs_gym import LinearPlant


def random_plant(seed: int, n: int, m: int, p: int | None = None, gamma: float = 1e-3) -> LinearPlant:
    """A random stable plant in the unit box; with p, that many random outputs."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A *= rng.uniform(0.4, 0.9) / np.abs(np.linalg.eigvals(A)).max()
    return LinearPlant(
        A=A,
        B=rng.standard_normal((n, m)),
        box=np.eye(n),
        u_max=rng.uniform(0.5, 2.0, m),
        dt=0.1,
        gamma=gamma,
        H=None if p is None else rng.standard_normal((p, n)),
        process_noise_cov=1e-5 * np.eye(n),
        measurement_noise_cov=1e-4 * np.eye(n if p is None else p),
        initial_cov=1e-5 * np.eye(n),
    )
