"""Past inputs as states of a plant: of an input delay, or of limits of how fast inputs change."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ncs_gym.uncertainty.ellipsoid import Ellipsoid, ellipsoid_around_sum
from ncs_gym.uncertainty.remainder import Remainder
from ncs_gym.validation import as_count, counted

if TYPE_CHECKING:
    from ncs_gym.plants.linear_plant import LinearPlant

Kind = TypeVar("Kind", bound="LinearPlant")

# Rows of the box keep inputs under way within this many times their limits. They never leave those, so the rows only
# bound the safe set: closer ones would forbid inputs near their limit, farther ones enlarge the set by little.
STORED_INPUT_REACH = 4.0
LONGEST_INPUT_DELAY = 100


def inputs_under_way(plant: LinearPlant, disturbed: np.ndarray | None = None) -> int:
    """Returns how many of the last states are past inputs, of an `input_delay` or limits of rates; 0 of most plants.

    These are states (u_{k-d}, .., u_{k-1}), of which the input is the newest one in the next step. What is disturbed on
    its way is none: it may be beyond the limits of inputs.

    Args:
        plant: The plant.
        disturbed: Which states are disturbed, shape (n,); by default what is declared of the plant.
    """
    n, m = plant.n, plant.m
    if disturbed is None:
        disturbed = plant.nominal_disturbance.shape_matrix.diagonal() > 0.0
    if n <= m or plant.A[-m:].any() or not np.array_equal(plant.B[-m:], np.eye(m)) or disturbed[-m:].any():
        return 0
    stored = m
    while (
        stored + m < n
        and np.array_equal(plant.A[-stored - m : -stored], np.eye(n)[n - stored :][:m])
        and not plant.B[-stored - m : -stored].any()
        and not disturbed[-stored - m : -stored].any()
    ):
        stored += m
    return stored


def inputs_are_late(plant: LinearPlant) -> bool:
    """Returns whether inputs take effect steps after they are decided, as with `input_delay`."""
    stored = inputs_under_way(plant)
    return stored > 0 and not plant.B[: plant.n - stored].any()


def is_row_of_past_input(plant: LinearPlant) -> np.ndarray:
    """Returns which rows of the box `storing` added, shape (k,): nobody gave them, and no input ever reaches them."""
    first, found = plant.n - inputs_under_way(plant), np.zeros(len(plant.box), np.bool_)
    for j in range(first, plant.n):
        i, row = (j - first) % plant.m, np.zeros(plant.n)
        row[j] = 1.0 / (STORED_INPUT_REACH * plant.input_half[i])
        ends = plant.input_ends[:, i] / plant.input_half[i]
        found |= (plant.box == row).all(axis=1) & (ends == plant.box_ends.T).all(axis=1)
    return found


def with_past_inputs(plant: Kind, input_delay: int | None, du_max: ArrayLike | None) -> Kind:
    """Returns the plant with inputs that take effect later, and that change by no more than `du_max`; None for neither.

    Raises:
        ValueError: If either is wrong, or see `storing`.
    """
    delay = 0 if input_delay is None else as_count(input_delay, "input_delay", low=0, high=LONGEST_INPUT_DELAY)
    plant = storing(plant, delay, delay) if delay else plant
    return plant if du_max is None else plant.with_rate_limits(du_max)


def storing(plant: Kind, stored_inputs: int, delay: int) -> Kind:
    """Returns the plant with the last inputs as further states: x, u_{k-d}, .., u_{k-1}, the oldest input first.

    Disturbances and first errors are those of x alone.

    Args:
        plant: The plant.
        stored_inputs: Of how many steps.
        delay: Steps after which an input takes effect: as many, and the oldest one acts; or 0.

    Raises:
        ValueError: If the plant has an `initial_cov` or `between_samples`, or is the middle of a family.
    """
    if np.any(plant.initial_cov):
        raise ValueError(
            "with inputs as states the first error must be given by initial_bound (initial_cov=0 where a plant comes "
            "with one): that of initial_cov is a ball in all states, and past inputs are known"
        )
    if plant.between_samples is not None:
        raise ValueError("between_samples is for plants without input_delay and without limits of rates")
    n, m, stored = plant.n, plant.m, plant.m * stored_inputs
    A, B = np.zeros((n + stored, n + stored)), np.zeros((n + stored, m))
    A[:n, :n], A[n:-m, n + m :] = plant.A, np.eye(stored - m)
    if delay:
        A[:n, n : n + m] = plant.B
    else:
        B[:n] = plant.B
    B[-m:] = np.eye(m)
    box = np.zeros((len(plant.box) + stored, n + stored))
    box[: len(plant.box), :n] = plant.box
    box[len(plant.box) :, n:] = np.diag(np.tile(1.0 / (STORED_INPUT_REACH * plant.input_half), stored_inputs))
    ends = np.concatenate([plant.box_ends, np.tile(plant.input_ends / plant.input_half, stored_inputs)], axis=1)
    # An input that takes effect later is in the limits of states and inputs when it does, and a state by then.
    of_state, of_input = plant.mixed_rows[:, :n], plant.mixed_rows[:, n:]
    others = np.zeros((len(of_state), stored if delay else stored + m))
    others[:, : m if delay else None] = of_input if delay else np.pad(of_input, ((0, 0), (stored, 0)))
    coupled, coupled_ends = np.concatenate([of_state, others], axis=1), plant.mixed_ends
    if delay:
        box, ends = np.concatenate([box, coupled]), np.concatenate([ends, coupled_ends], axis=1)
        coupled, coupled_ends = np.empty((0, n + stored + m)), np.empty((2, 0))
    ages = [f"{counted(age, 'step')} ago" for age in range(stored_inputs, 0, -1)]
    disturbance = plant.disturbance_bound
    if plant.gamma > 0.0:  # one bound for both: the ball of gamma would reach the stored inputs
        ball = Ellipsoid(plant.gamma * np.eye(n))
        disturbance = ellipsoid_around_sum(plant.relative_weight, ball, disturbance)
    # The further states of a model move as they should: stored inputs keep their limits.
    remainder = plant.remainder
    if remainder is not None:
        if plant.members is not None:
            raise ValueError("inputs become states of the plants of a family one by one: give du_max to its members")
        padded = Ellipsoid(np.pad(remainder.bound.shape_matrix, (0, stored)))
        remainder = Remainder(padded, remainder.is_proved, remainder.basis)
    return replace(
        plant,
        A=A,
        B=B,
        box=box,
        box_ends=ends,
        mixed_rows=coupled,
        mixed_ends=coupled_ends,
        gamma=0.0,
        H=np.pad(plant.H, ((0, 0), (0, stored))),
        process_noise_cov=np.pad(plant.process_noise_cov, (0, stored)),
        initial_cov=np.zeros((n + stored, n + stored)),
        disturbance_bound=_padded(disturbance, stored),
        initial_bound=_padded(plant.initial_bound, stored),
        remainder=remainder,
        continuous_model=None,
        operating_state=np.concatenate([plant.operating_state, np.tile(plant.operating_input, stored_inputs)]),
        step_offset=np.pad(plant.step_offset, (0, stored)),
        state_names=[*plant.state_names, *(f"{name} of {age}" for age in ages for name in plant.input_names)],
        state_units=[*plant.state_units, *tuple(plant.input_units) * stored_inputs],
    )


def without_past_inputs(plant: LinearPlant) -> tuple[LinearPlant, bool]:
    """Returns the model of the own states alone, of which nothing uncertain is declared, and whether inputs are late.

    Its input is the oldest one under way if inputs take effect later, and else the one of the step.
    """
    from ncs_gym.plants.linear_plant import LinearPlant

    m, n, is_late = plant.m, plant.n - inputs_under_way(plant), inputs_are_late(plant)
    rows = ~plant.box[:, n:].any(axis=1)
    own = LinearPlant(
        A=plant.A[:n, :n],
        B=plant.A[:n, n : n + m] if is_late else plant.B[:n],
        H=plant.H[:, :n],
        dt=plant.dt,
        box=plant.box[rows, :n],
        box_ends=plant.box_ends[:, rows],
        input_ends=plant.input_ends,
        operating_state=plant.operating_state[:n],
        operating_input=plant.operating_input,
        **dict.fromkeys(("disturbance_bound", "sensor_bound", "initial_bound"), 0.0),
    )
    return own, is_late


def _padded(bound: Ellipsoid | None, zeros: int) -> Ellipsoid | None:
    """Returns a bound of the same entries and of some more that are zero."""
    return None if bound is None else Ellipsoid(np.pad(bound.shape_matrix, (0, zeros)))
