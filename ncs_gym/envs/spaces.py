"""The observation and action spaces of the control loop, and what actions stand for."""

from __future__ import annotations

from math import isfinite
from typing import Any

import numpy as np
from gymnasium.spaces import Box

from ncs_gym.ellipsoid import Ellipsoid
from ncs_gym.estimation.error_bound import ErrorSet
from ncs_gym.estimation.estimator import Belief
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.tasks import Task
from ncs_gym.validation import as_numbers, counted, shown, warn_caller

# What can be observed besides estimate and task.
OBSERVED = "age", "error"
# Widens the observation box: float32 rounding, and estimates a little off the reachable set.
OBSERVATION_MARGIN = 1.01


class ClippedObservationWarning(UserWarning):
    """Entries of a task are beyond the observation space, which agents do not see."""


def observation_space(
    plant: LinearPlant,
    task: Task,
    error_set: ErrorSet,
    initial_set: Ellipsoid,
    horizon: int,
    input_delay: int = 0,
    observe: tuple[str, ...] = (),
) -> Box:
    """Returns the finite box of estimate and task entries that can be reached within some steps, float32.

    The reach of x_hat is where one step out of the safe box, or out of a start, can end (with a downlink c + 1 steps),
    plus the certified error; of a stable plant also that of x from the initial set under every input and disturbance
    within the horizon. What runs away further is clipped, so that rescaled observations still say something.

    Args:
        plant: The plant.
        task: Gives entries of its own.
        error_set: Bounds the errors.
        initial_set: Bounds the starts.
        horizon: Number of steps.
        input_delay: c, the number of steps from a decision to its effect.
        observe: What is observed besides; see `read_observed`.

    Raises:
        ValueError: If a bound of the task is no number > 0, or an entry is beyond float32's range.
    """
    powers = [np.eye(plant.n)]
    for _ in range(horizon):
        powers.append(powers[-1] @ plant.A)
    unforced = np.array(powers)
    added = np.abs(unforced[:-1] @ plant.B) @ plant.largest_input + plant.disturbance.support(unforced[:-1])
    pushed = np.vstack([np.zeros(plant.n), added.cumsum(axis=0)])
    in_box = np.where(np.isfinite(plant.reach[: plant.n]), plant.reach[: plant.n], plant.half_widths)
    near, late = np.maximum(in_box, initial_set.support(np.eye(plant.n))), input_delay + 2
    reach = (np.abs(unforced[:late]) @ near + pushed[:late]).max(axis=0)
    if plant.spectral_radius < 1.0:
        reach = np.maximum(reach, (pushed + initial_set.support(unforced)).max(axis=0))
    errors = np.sqrt(np.diagonal(error_set.shapes, axis1=1, axis2=2).max(axis=0))
    estimate = reach + errors
    known = {"age": np.array([float(horizon)]), "error": errors}
    more = [known[name] for name in observe]
    own = task.observation_bound(plant, horizon)
    if not (np.isfinite(own) & (np.asarray(own) > 0.0)).all():
        raise ValueError(f"{type(task).__name__}: observation_bound must be finite numbers > 0, got {shown(own)}")
    bound = OBSERVATION_MARGIN * np.concatenate([estimate, own, *more])
    numbers = np.finfo(np.float32)
    if not ((bound >= numbers.tiny) & (bound <= numbers.max)).all():
        raise ValueError(
            f"observations of up to {shown(bound.tolist())} are out of float32's range: choose other units"
        )
    high = bound.astype(np.float32)
    low = -high
    low[len(low) - sum(map(len, more)) :] = 0.0
    return Box(low, high, dtype=np.float32)


def read_observed(observe: Any) -> tuple[str, ...]:
    """Returns what is observed besides estimate and task: "age", of the newest sample used, and "error", its radii.

    Raises:
        ValueError: If it is something else, or named twice.
    """
    names = tuple(observe) if isinstance(observe, (list, tuple)) else (observe,)
    if not all(isinstance(each, str) and each in OBSERVED for each in names) or len(set(names)) < len(names):
        raise ValueError(f"observe must be a list of some of {list(OBSERVED)}, got {shown(observe)}")
    return names


def nearest_action(inputs: np.ndarray, plant: LinearPlant) -> np.ndarray:
    """Returns the float32 actions whose inputs are nearest to some, shape (..., m), clipped to [-1, 1]."""
    if inputs.ndim == 1:  # of one environment, in a fifth of the time
        each = zip(inputs.tolist(), plant.input_middle.tolist(), plant.input_half.tolist(), strict=True)
        scaled = [(u - middle) / half for u, middle, half in each]
        return np.array([min(max(each, -1.0), 1.0) for each in scaled], np.float32)
    actions = (inputs - plant.input_middle) / plant.input_half
    return np.minimum(np.maximum(actions, -1.0), 1.0).astype(np.float32)


def expressible(inputs: np.ndarray, plant: LinearPlant) -> np.ndarray:
    """Returns the inputs of the nearest float32 actions; see `nearest_action`."""
    return plant.input_half * nearest_action(inputs, plant) + plant.input_middle


class Observer:
    """Makes the observations of a control loop, or of N at once, the last axis.

    Args:
        task: The task, which has entries of its own.
        space: The observation space of one loop.
        observe: What is observed besides; see `read_observed`.
        horizon: Steps that the bounds of the space are about.
        many: Whether there are N.
    """

    def __init__(self, task: Task, space: Box, observe: tuple[str, ...], horizon: int, *, many: bool = False) -> None:
        self._task, self._observe, self._horizon, self._has_warned = task, observe, horizon, False
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        self._low, self._high = (low[:, None], high[:, None]) if many else (low, high)
        self._axis = ", shape (entries, N)" if many else ", shape (entries,)"

    def observation(self, known: Belief, own: Any) -> np.ndarray:
        """Returns entries clipped to the space, shape (entries,) or (entries, N), float32.

        The task's own are of shape (extra,) or (extra, N).

        Raises:
            ValueError: If the task has another number of entries than it has bounds.
        """
        parts = [known.estimate, own]
        for name in self._observe:
            parts.append(self._observed(known, name))
        try:
            entries = np.concatenate(parts)
        except ValueError:
            raise ValueError(
                f"{type(self._task).__name__}: observe must return an array of entries{self._axis}, got {shown(own)}"
            ) from None
        if len(entries) != len(self._low):
            bounds = len(self._low) - len(entries) + len(own)
            raise ValueError(
                f"{type(self._task).__name__}: observe returns {len(own)} entries, observation_bound the bounds of "
                f"{bounds}: it must return the largest absolute value of each"
            )
        # The usual case; no entry whose low end is zero is negative.
        if np.count_nonzero(np.abs(entries) <= self._high) == entries.size:
            return entries.astype(np.float32)
        within = np.minimum(np.maximum(entries, self._low), self._high)
        if not self._has_warned:
            own_entries = slice(len(known.estimate), len(known.estimate) + len(own))
            beyond = np.argwhere(within[own_entries] != entries[own_entries])
            if len(beyond):
                self._has_warned = True
                self._warn(len(known.estimate), int(beyond[0][0]))
        return within.astype(np.float32)

    def _observed(self, known: Belief, name: str) -> np.ndarray:
        if name == "age":
            return np.asarray(known.age, dtype=np.float64)[None]
        return np.sqrt(np.diagonal(known.error_shape, axis1=-2, axis2=-1)).T

    def _warn(self, first: int, entry: int) -> None:
        bound = float(np.ravel(self._high)[first + entry])
        warn_caller(
            f"entry {entry} of {type(self._task).__name__} is beyond its observation_bound of {bound:.6g} and is "
            f"clipped in observations: bound what {counted(self._horizon, 'step')} can reach, and give horizon=... "
            "if episodes are longer",
            ClippedObservationWarning,
        )


def read_action(plant: LinearPlant, action: Any) -> tuple[np.ndarray, np.ndarray]:
    """Reads an action once, so that nobody who writes into it later changes anything.

    Returns:
        A copy of the action, float32 if it is an array of that and float64 otherwise, clipped to [-1, 1], and the
        float64 input that it stands for, shape (m,) each: -1 the low end of the limits, 1 the high one.

    Raises:
        ValueError: If the action is not finite or does not have shape (m,).
    """
    is_float = type(action) is np.ndarray and action.dtype.char in "fd"
    numbers = action.copy() if is_float else as_numbers(action)
    if numbers is not None and numbers.shape == plant.input_half.shape:
        values = numbers.tolist()
        for value in values:
            if not -1.0 <= value <= 1.0:
                break
        else:  # the usual case, in half the time
            return numbers, plant.input_half * numbers + plant.input_middle
        if all(map(isfinite, values)):
            clipped = np.array([min(max(value, -1.0), 1.0) for value in values])
            return clipped.astype(numbers.dtype), plant.input_half * clipped + plant.input_middle
    raise ValueError(f"the action must be finite with shape ({plant.m},), got {shown(action)}")


def read_actions(plant: LinearPlant, actions: Any, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns what `read_action` does for `count` environments: a copy, shape (count, m), and inputs, (m, count).

    Raises:
        ValueError: If one is not finite or the shape is wrong.
    """
    is_float = type(actions) is np.ndarray and actions.dtype.char in "fd"
    numbers = actions.copy() if is_float else as_numbers(actions)
    if numbers is not None and numbers.shape == (count, plant.m):
        farthest = np.abs(numbers).max()
        half, middle = plant.input_half[:, None], plant.input_middle[:, None]
        if farthest <= 1.0:  # the usual case
            return numbers, half * numbers.T + middle
        if np.isfinite(farthest):
            numbers = np.minimum(np.maximum(numbers, -1.0), 1.0)
            return numbers, half * numbers.T + middle
    raise ValueError(f"the actions must be finite with shape ({count}, {plant.m}), got {shown(actions)}")
