"""Limits at all times of a step, as what they ask of the state at its beginning and of the input that is held."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ncs_gym import exact
from ncs_gym.validation import read_only

if TYPE_CHECKING:
    from ncs_gym.plants.linear_plant import LinearPlant

# What the bound between grid points gains for its own rounding; and for that of rows, next to what they can reach.
_MARGIN, _ROUNDING = 0.01, 1e-12


def kept_at_all_times(plant: LinearPlant) -> dict[str, np.ndarray]:
    """Returns `kept_ends`, `arriving` and all rows and ends within a step of a plant whose box counts at N times of it.

    With the input held, x(tau) = A_tau x + B_tau u + d_tau, where [A_tau, B_tau] is the upper part of exp(G tau) for
    G = [[Ac, Bc], [0, 0]]. A row c of the box is one on (x, u) at the times tau_i = i dt / N, of which the first is on
    x alone. Its ends are closer by the support rho of the disturbance and by eta of docs/shield_proof.md, "Between the
    samples": between two times a function leaves its linear interpolation by at most h^2/8 times its largest second
    derivative, here [c, 0] G^2 exp(G tau) (x, u). In the norm |q|_W = sum |q_j| W_j, with W the largest |x_j| and
    |u_j|, that grows from one time to the next by at most exp(h m), m the logarithmic norm of G.

    What a disturbance did by tau counts in proportion to the time: (tau / dt) (x+ - A x - B u) is in E(D), too.

    Raises:
        ValueError: If nothing is known of times within a step, or the bound is out of reach of float64, or leaves
            nothing of a limit.
    """
    has_remainder = any(each.is_left_out for each in plant.bounds.disturbance.parts)
    if plant.model.continuous is None or plant.past or has_remainder or plant.step_offset.any():
        needed = "a model of Model.sampled, without delays, rates, remainder and constant disturbance"
        raise ValueError(f"between_samples needs {needed}: else nothing is known of times within a step")
    if exact.rank(plant.box[np.isfinite(plant.box_ends).all(axis=0)]) < plant.n:
        raise ValueError("between_samples needs Limits with two ends that bound every state: give generous ones")
    points, n, m = plant.between_samples, plant.n, plant.m
    G, h = np.concatenate([plant.model.continuous, np.zeros((m, n + m))]), plant.dt / points
    box, W, size, D = np.pad(plant.box, ((0, 0), (0, m))), plant.reach, np.abs(G), plant.disturbance.shape_matrix
    try:
        onward = [np.eye(n + m), *(exact.exponential(G, plant.dt * i / points) for i in range(1, points))]
        growth = float(exact.exponential(np.array([[_logarithmic_norm(G, W)]]), h)[0, 0])
        rows = np.array([exact.product(box, each) for each in onward])
        bends = [exact.product(np.abs(exact.product(each, G, G)), W) for each in rows]
        reach = W + h * h * growth * exact.product(size, size, W)
        onward.append(np.concatenate([np.hstack([plant.A, plant.B]), np.eye(m, n + m, n)]))
        sizes = [exact.product(np.abs(box), np.abs(each), reach) for each in onward]
    except OverflowError as error:
        raise ValueError(
            "the bound between samples is out of reach of float64: a shorter dt or closer limits would help"
        ) from error
    eta = (1.0 + _MARGIN) * (h * h / 8.0) * growth * np.max(bends, axis=0) + _ROUNDING * np.max(sizes, axis=0)
    rho = np.sqrt(np.diag(exact.product(plant.box, D, plant.box.T)))
    kept_ends = plant.box_ends + np.outer([1.0, -1.0], (1.0 + _ROUNDING) * (eta + rho))
    if (emptied := np.flatnonzero(kept_ends[0] >= kept_ends[1])).size:
        j = int(emptied[0])
        raise ValueError(
            f"between_samples={points} leaves nothing of row {j + 1} of the box: a disturbance takes {rho[j]:.3g} of "
            f"half its range, what is between the times {eta[j]:.3g}; more of them, a shorter dt or less disturbance "
            "would help"
        )
    shares = (np.arange(1, points) / points)[:, None, None]
    way = [rows[1:] - shares * (plant.box @ np.hstack([plant.A, plant.B])), np.tile(plant.box, (points - 1, 1, 1))]
    return {
        "within_step": read_only(np.concatenate([way[0], shares * way[1]], axis=2).reshape(-1, 2 * n + m)),
        "kept_ends": read_only(kept_ends),
        "arriving": read_only(rho),
        "step_rows": read_only(np.concatenate([plant.mixed_rows, *rows[1:]])),
        "step_ends": read_only(np.hstack([plant.mixed_ends, np.tile(kept_ends, points - 1)])),
    }


def _logarithmic_norm(G: np.ndarray, W: np.ndarray) -> float:
    """Returns m = max_i (G_ii + sum_{j != i} |G_ij| W_j / W_i), at least 0.

    In the norm max |z_j| / W_j of columns, and so in |q|_W of rows, |exp(G s)| <= exp(s m).
    """
    off = np.abs(G) * (1.0 - np.eye(len(G)))
    return max(float((np.diag(G) + exact.product(off, W) / W).max()), 0.0)
