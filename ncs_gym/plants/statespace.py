"""State-space models from elsewhere: sampled exactly, with their bounds, and with inputs that take effect later."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ncs_gym import exact
from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.uncertainty.remainder import Remainder
from ncs_gym.uncertainty.shape_matrices import outer_sum
from ncs_gym.uncertainty.truncated_gaussian import truncation_energy
from ncs_gym.validation import as_count, as_matrix, as_number, shown

if TYPE_CHECKING:
    from ncs_gym.plants.linear_plant import LinearPlant

# Durations of steps that differ by less than this are the same.
SAME_STEP = 1e-9
# Rows of the box keep inputs under way within this many times their limits. They never leave those, so the rows only
# bound the safe set: closer ones would forbid inputs near their limit, farther ones enlarge the set by little.
STORED_INPUT_REACH = 4.0
LONGEST_INPUT_DELAY = 100


def zero_order_hold(A: np.ndarray, B: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the matrices of x+ = A x + B u for x' = A x + B u with u held constant over each step.

    Every entry is rounded once, so that it is the same on every machine.

    Args:
        A: Continuous-time state matrix, shape (n, n) [1/s].
        B: Continuous-time input matrix, shape (n, m).
        dt: Duration of a step [s].

    Raises:
        ValueError: If an entry is too large for a float64.
    """
    n, m = B.shape
    try:
        sampled = exact.exponential(np.block([[A, B], [np.zeros((m, n + m))]]), dt)
    except OverflowError as error:
        raise ValueError(f"the model grows beyond all numbers within a step of {dt:g} s: give a smaller dt") from error
    return sampled[:n, :n], sampled[:n, n:]


def arguments_with_noise(
    A: np.ndarray,
    B: np.ndarray,
    H: np.ndarray,
    half_widths: np.ndarray,
    u_max: float,
    dt: float,
    noise_fractions: tuple[float, float],
    arguments: dict[str, Any],
) -> dict[str, Any]:
    """Returns the arguments of `LinearPlant` for a continuous-time model, with noise in proportion to its safe box.

    Args:
        A: Continuous-time state matrix, shape (n, n) [1/s].
        B: Continuous-time input matrix, shape (n, m).
        H: Output matrix, shape (p, n).
        half_widths: Of the safe box, shape (n,).
        u_max: Limit of every input.
        dt: Duration of a step [s].
        noise_fractions: Bounds of process noise and of sensor noise, as fractions of the half-widths.
        arguments: Other arguments of `LinearPlant`, which take precedence.
    """
    n = len(A)
    sampled_A, sampled_B = zero_order_hold(A, B, dt)
    disturbance, sensor = noise_fractions
    delta = arguments.get("delta", 0.05)
    outputs = exact.product(np.abs(H), half_widths)
    smallest = np.full(n, half_widths.min())
    defaults = {
        "gamma": 0.0,
        "process_noise_cov": np.diag(np.square(disturbance * half_widths)) / truncation_energy(delta, n),
        "measurement_noise_cov": np.diag(np.square(sensor * outputs)) / truncation_energy(delta, len(H)),
        "initial_cov": np.diag(np.square(sensor * smallest)) / truncation_energy(delta, n),
    }
    common = {"A": sampled_A, "B": sampled_B, "box": half_widths, "H": H, "u_max": u_max, "dt": dt}
    return common | defaults | arguments


def sampled_arguments(sys: Any, dt: float | None, settings: dict[str, Any]) -> dict[str, Any]:
    """Returns the arguments of `LinearPlant` for a state-space model: `settings`, and its matrices in discrete time.

    Args:
        sys: The model, as `LinearPlant.from_statespace` takes it.
        dt: Duration of a step [s]; None for that of the model.
        settings: Other arguments.

    Raises:
        ValueError: If it is no such model, D is not zero, dt is missing or another than the model's, or a setting is
            given by the model.
    """
    twice = sorted({"A", "B", "H"} & set(settings))
    if twice:
        raise ValueError(f"{' and '.join(twice)} come from the state-space model: give the model alone")
    *matrices, own = _matrices(sys)
    A = as_matrix(matrices[0], (None, None), "A of the model")
    A = as_matrix(A, (len(A), len(A)), "A of the model")
    B = as_matrix(matrices[1], (len(A), None), "B of the model")
    H = as_matrix(matrices[2], (None, len(A)), "C of the model")
    if matrices[3] is not None and np.any(matrices[3]):
        raise ValueError(
            "D of the model must be zero, since sensors here measure y = H x + v: subtract D u, of which u is known, "
            f"from what is measured and give D = 0, got {shown(np.asarray(matrices[3]).tolist())}"
        )
    is_continuous = own is None or (own is not True and own == 0)
    if dt is None:
        if is_continuous or own is True:
            raise ValueError("the model has no sampling time: give dt, the duration of a step in seconds")
        dt = own
    dt = as_number(dt, "dt", low=0.0, low_open=True)
    if is_continuous:
        A, B = zero_order_hold(A, B, dt)
    elif own is not True and abs(as_number(own, "dt of the model", low=0.0) - dt) > SAME_STEP * dt:
        raise ValueError(f"dt must be that of the model in discrete time, {own}, or be left out, got {dt}")
    return {"A": A, "B": B, "H": H, "dt": dt} | settings


def delayed_arguments(plant: LinearPlant, input_delay: int) -> dict[str, Any]:
    """Returns the arguments of the plant whose inputs take effect some steps later.

    Its state is (x, u_{k-d}, .., u_{k-1}), the oldest input first. Disturbances and first errors are those of x alone.

    Args:
        plant: The plant without delay.
        input_delay: d, steps, at least 1.

    Raises:
        ValueError: If the delay is no such number, or the first error is given by a covariance.
    """
    delay = as_count(input_delay, "input_delay", low=1, high=LONGEST_INPUT_DELAY)
    if np.any(plant.initial_cov):
        raise ValueError(
            "with input_delay the first error must be given by initial_bound: that of initial_cov is a ball in all "
            "states, and inputs under way are known"
        )
    n, m, stored = plant.n, plant.m, plant.m * delay
    A = np.zeros((n + stored, n + stored))
    A[:n, :n], A[:n, n : n + m] = plant.A, plant.B
    A[n:-m, n + m :] = np.eye(stored - m)
    B = np.concatenate([np.zeros((n + stored - m, m)), np.eye(m)])
    box = np.zeros((len(plant.C) + stored, n + stored))
    box[: len(plant.C), :n] = plant.C
    box[len(plant.C) :, n:] = np.diag(np.tile(1.0 / (STORED_INPUT_REACH * plant.u_max), delay))
    names = [f"{name} of {age} step{'s' * (age > 1)} ago" for age in range(delay, 0, -1) for name in plant.input_names]
    return {
        "A": A,
        "B": B,
        "box": box,
        "u_max": plant.u_max,
        "dt": plant.dt,
        "H": np.pad(plant.H, ((0, 0), (0, stored))),
        "process_noise_cov": np.pad(plant.process_noise_cov, (0, stored)),
        "measurement_noise_cov": plant.measurement_noise_cov,
        "initial_cov": np.zeros((n + stored, n + stored)),
        "delta": plant.delta,
        "disturbance_bound": _padded(_unknown_disturbance(plant), stored),
        "remainder": _padded_remainder(plant.remainder, stored),
        "sensor_bound": plant.sensor_bound,
        "initial_bound": _padded(plant.initial_bound, stored),
        "error_gain": None if plant.error_gain is None else np.pad(plant.error_gain, ((0, 0), (0, stored))),
        "operating_state": np.concatenate([plant.operating_state, np.tile(plant.operating_input, delay)]),
        "operating_input": plant.operating_input,
        "state_names": [*plant.state_names, *names],
        "state_units": [*plant.state_units, *tuple(plant.input_units) * delay],
        "input_names": plant.input_names,
        "input_units": plant.input_units,
    }


def inputs_under_way(plant: LinearPlant) -> int:
    """Returns how many of the last states are inputs under way, as those of `delayed_arguments` are; 0 of most plants.

    These are states (u_{k-d}, .., u_{k-1}) of a plant that the input itself reaches only as the newest of them.
    """
    n, m = plant.n, plant.m
    if n <= m or plant.A[-m:].any() or not np.array_equal(plant.B, np.eye(n)[:, -m:]):
        return 0
    stored = m
    while stored + m < n and np.array_equal(plant.A[-stored - m : -stored], np.eye(n)[n - stored :][:m]):
        stored += m
    return stored


def _matrices(sys: Any) -> tuple[Any, Any, Any, Any, Any]:
    """Returns A, B, C, D and the sampling time of a model: 0 or None in continuous time, True if it is unknown.

    Raises:
        ValueError: If it is no state-space model.
    """
    if isinstance(sys, (tuple, list)) and len(sys) in (4, 5):
        A, B, C, D, *sampling = sys
        return A, B, C, D, sampling[0] if sampling else None
    model: Any = sys
    if hasattr(model, "to_ss") and not hasattr(model, "A"):
        model = model.to_ss()
    if not all(hasattr(model, name) for name in "ABCD"):
        raise ValueError(
            "sys must be a state-space model of python-control (control.ss(...)) or scipy.signal, or a tuple "
            f"(A, B, C, D) or (A, B, C, D, dt), got {shown(sys)}"
        )
    return model.A, model.B, model.C, model.D, getattr(model, "dt", None)


def _unknown_disturbance(plant: LinearPlant) -> Ellipsoid | None:
    """Returns what holds the ball of gamma plus the declared disturbances; None if there is neither."""
    ball, declared = plant.gamma * np.eye(plant.n), plant.disturbance_bound
    if declared is None or not np.any(ball):
        return declared if not np.any(ball) else Ellipsoid(ball)
    return Ellipsoid(outer_sum(ball, declared.shape, plant.relative_weight))


def _padded_remainder(remainder: Remainder | None, zeros: int) -> Remainder | None:
    """Returns the remainder of a model whose further states move as they should: inputs under way keep their limits."""
    if remainder is None:
        return None
    return replace(remainder, bound=Ellipsoid(np.pad(remainder.bound.shape, (0, zeros))))


def _padded(bound: Ellipsoid | None, zeros: int) -> Ellipsoid | None:
    """Returns a bound of the same entries and of some more that are zero."""
    return None if bound is None else Ellipsoid(np.pad(bound.shape, (0, zeros)))
