"""What a linear controller bears over a finite horizon: a yardstick for certificates, and no proof of safety."""

from __future__ import annotations

import warnings
from itertools import product

import cvxpy as cp
import numpy as np

from ncs_gym import ChannelContract, LinearPlant
from ncs_gym.validation import own_error_state
from shields.errors import Infeasible

HORIZON = 15


@own_error_state
def linear_feedback_tolerance(plant: LinearPlant, contract: ChannelContract | None, horizon: int = HORIZON) -> float:
    """Returns the factor on all radii that the best linear output feedback bears, up to a solver's precision.

    Disturbances, sensor noise and first errors are multiplied by it, and a controller that is linear in the samples it
    has, with gains of its own for every step, keeps box and input limits for all of them from x_hat_0 = 0 on, for so
    many steps and no longer. The newest sample is as old as the contract allows at every step. The controller is found
    by convex optimization over feedbacks of purified outputs, the samples less what inputs explain, in which states and
    inputs are linear (Goulart and Kerrigan 2007, docs/bibliography.md): supports of ellipsoids add up.

    A certificate holds for ever, from all of its set, and says which input is safe; so it tolerates less as a rule.

    Args:
        plant: The plant.
        contract: Age and rounding of samples; None for none at all.
        horizon: Number of steps, at least 1.

    Raises:
        ValueError: If the horizon is no step.
        Infeasible: If the solver finds nothing.
    """
    if horizon < 1:
        raise ValueError(f"the horizon must be at least one step, got {horizon}")
    n, m, p, widths = plant.n, plant.m, plant.p, plant.half_widths
    N = plant.sensor_error_with(0.0 if contract is None else contract.quantization_step).shape_matrix
    age = horizon if contract is None else contract.max_age
    # In units of the box, the input limits, and of what the sensors are off by.
    units = np.sqrt(np.maximum(np.diag(N), 1e-12 * np.diag(plant.H @ np.diag(widths**2) @ plant.H.T)))
    A, B = plant.A * widths / widths[:, None], plant.B * plant.u_max / widths[:, None]
    H, rows = plant.H * widths / units[:, None], plant.box_rows * widths
    shapes = plant.initial_error.shape_matrix, plant.disturbance.shape_matrix
    first, each = (_root(shape / np.outer(widths, widths)) for shape in shapes)
    noise = _root(N / np.outer(units, units))
    powers = [np.eye(n)]
    for _ in range(horizon):
        powers.append(A @ powers[-1])
    # x_1..x_T of first error and disturbances alone, and what inputs u_0..u_{T-1} add; H x_0..x_{T-1} of the former.
    alone = np.zeros((horizon + 1, n, horizon + 1, n))
    pushed = np.zeros((horizon, n, horizon, m))
    for k, j in product(range(horizon + 1), range(horizon)):
        if j < k:
            alone[k, :, 1 + j] = powers[k - 1 - j] @ each
            pushed[k - 1, :, j] = powers[k - 1 - j] @ B
    for k in range(horizon + 1):
        alone[k, :, 0] = powers[k] @ first
    seen = np.einsum("pn,knjl->kpjl", H, alone[:-1]).reshape(horizon * p, -1)
    free = alone[1:].reshape(horizon * n, -1)
    sensors = np.kron(np.eye(horizon), noise)
    known = np.kron(np.tril(np.ones((horizon, horizon)), -age), np.ones((m, p)))
    gains = cp.Variable((horizon * m, horizon * p))
    every_row = np.kron(np.eye(horizon), rows)
    effect = every_row @ pushed.reshape(horizon * n, -1)
    of_errors = cp.vstack([every_row @ free + effect @ gains @ seen, gains @ seen])
    of_noise = cp.vstack([effect @ gains @ sensors, gains @ sensors])
    supports = [cp.norm(of_errors[:, n * j : n * (j + 1)], 2, axis=1) for j in range(horizon + 1)]
    supports += [cp.norm(of_noise[:, p * j : p * (j + 1)], 2, axis=1) for j in range(horizon)]
    largest = cp.Variable()
    problem = cp.Problem(cp.Minimize(largest), [sum(supports) <= largest, cp.multiply(1.0 - known, gains) == 0.0])
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Solution may be inaccurate")  # it proves nothing anyway
            problem.solve(solver=cp.CLARABEL)
    except cp.SolverError as error:
        raise Infeasible(f"no linear controller was found: {error}", "yardstick", 0.0) from error
    found = float("nan") if largest.value is None else float(largest.value)
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE) or not found > 0.0:
        raise Infeasible(f"no linear controller was found: the solver says {problem.status}", "yardstick", 0.0)
    return 1.0 / found


def _root(shape: np.ndarray) -> np.ndarray:
    """Returns F with F F' = shape, which may be singular."""
    values, vectors = np.linalg.eigh(0.5 * (shape + shape.T))
    return vectors * np.sqrt(np.maximum(values, 0.0))
