"""Random plants: what is not made for any of them should hold for all."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.stats import ortho_group

from ncs_gym import Ball, Bounds, ChannelContract, Gaussian, Limits, LinearPlant, Model

# Step of `slow_and_fast_plant`, how its time constants are spread, and the units of its states and inputs.
STEP, TIME_CONSTANTS, UNITS = 0.1, (0.03, 300.0), (1e-3, 1e3)


def random_plant(seed: int, n: int, m: int, p: int | None = None, gamma: float = 1e-3) -> LinearPlant:
    """A random stable plant in the unit box; with p, that many random outputs."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A *= rng.uniform(0.4, 0.9) / np.abs(np.linalg.eigvals(A)).max()
    B, u_max = rng.standard_normal((n, m)), rng.uniform(0.5, 2.0, m)
    H, sensed = (None, n) if p is None else (rng.standard_normal((p, n)), p)
    noise = Gaussian(1e-5 * np.eye(n), 0.05)
    return LinearPlant(
        Model(A, B, H, 0.1),
        Limits(state=np.ones(n), input=u_max),
        Bounds(Ball(np.sqrt(gamma)) + noise, Gaussian(1e-4 * np.eye(sensed), 0.05), noise),
    )


def under_contracts(count: int) -> Iterator[tuple[LinearPlant, ChannelContract]]:
    """Yields random plants of 2 to 5 states, every second one unstable, with contracts."""
    for seed in range(count):
        plant = random_plant(seed, *((2, 1, 1), (3, 2, 1), (4, 2, 2), (4, 1, 3), (5, 2, 2))[seed % 5])
        if seed % 2:
            faster = replace(plant.model, A=plant.A * (1.0 + 0.02 * (seed % 7)) / plant.spectral_radius)
            plant = replace(plant, model=faster)
        yield plant, ChannelContract(1 + seed % 4)


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
    noise = Gaussian(size**2 * np.diag(state**2), 0.05)
    B, u_max = state[:, None] * rng.standard_normal((n, m)) / put, put * rng.uniform(0.5, 2.0, m)
    return LinearPlant(
        Model(state[:, None] * A / state, B, None, 0.1),
        Limits(state=state, input=u_max),
        Bounds(Ball(size * state.min()) + noise, noise, Gaussian(size**2 * float(state.min()) ** 2 * np.eye(n), 0.05)),
    )


def slow_and_fast_plant(seed: int, *, in_own_units: bool) -> LinearPlant:
    """A stable plant of two to four states with slow and fast modes, which are mixed; limits have two different ends.

    Disturbances and errors are a share of the limits, drawn from .1 to 3 %.
    """
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(2, 5)), int(rng.integers(1, 3))
    slow, fast = np.log(TIME_CONSTANTS)
    modes = -1.0 / np.exp(rng.uniform(slow, fast, n))
    mixed = np.eye(n) + 0.5 * ortho_group.rvs(n, random_state=rng)
    A = mixed @ np.diag(modes) @ np.linalg.inv(mixed)
    B = mixed @ (modes[:, None] * rng.standard_normal((n, m)))
    low, high = -rng.uniform(0.5, 1.0, n), rng.uniform(0.5, 1.0, n)
    ends = -rng.uniform(0.5, 1.0, m), rng.uniform(0.5, 1.0, m)
    share = np.exp(rng.uniform(np.log(0.001), np.log(0.03)))
    low_unit, high_unit = np.log(UNITS)
    units = np.exp(rng.uniform(low_unit, high_unit, n + m)) if in_own_units else np.ones(n + m)
    x, u = units[:n], units[n:]
    return LinearPlant(
        Model.sampled((x[:, None] * A) / x, (x[:, None] * B) / u, None, STEP),
        Limits(state=(x * low, x * high), input=(u * ends[0], u * ends[1])),
        Bounds(share * x * np.minimum(1.0, STEP * np.abs(modes).min() * 10.0), share * x, share * x),
    )
