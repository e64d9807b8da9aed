"""What N environments remember from step to step; the last axis of every array is the environment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ncs_gym.compiled import inner


class Fleet(NamedTuple):
    """Views of two arrays, one of float64 and one of int32 rows.

    Rings have a slot per age 0..buffer, found by step modulo their length.

    Attributes:
        state, mean: x and x_hat, shape (n, N).
        priors: Means before updates, shape (buffer + 1, n, N).
        inputs: Inputs that led to each step, shape (buffer + 1, m, N).
        samples: Measurements as sent, shape (buffer + 1, p, N).
        disturbance: d of the last step, shape (n, N).
        noise: Sensor noise of the last step that any environment sent at, shape (p, N).
        uniforms: What the channel drew, shape (3, N).
        violations: In this episode, shape (N,).
        keys: Of random numbers, uint64, shape (N,).
        due: Age at which each sample arrives, -1 if never, shape (buffer + 1, N).
        node: Of the gain table, shape (N,).
        age: Steps since the newest sample used, shape (N,).
        steps: In this episode, shape (N,).
        wait: Steps until the next sample is sent, shape (N,).
        lost: Packets lost in a row, shape (N,).
        bad: State of the Gilbert-Elliott chain, 0 or 1, shape (N,).
        alarm, arrived: 0 or 1, shape (N,).
        counted: Whether violations count now, 0 or 1, shape (N,).
    """

    state: np.ndarray
    mean: np.ndarray
    priors: np.ndarray
    inputs: np.ndarray
    samples: np.ndarray
    disturbance: np.ndarray
    noise: np.ndarray
    uniforms: np.ndarray
    violations: np.ndarray
    keys: np.ndarray
    due: np.ndarray
    node: np.ndarray
    age: np.ndarray
    steps: np.ndarray
    wait: np.ndarray
    lost: np.ndarray
    bad: np.ndarray
    alarm: np.ndarray
    arrived: np.ndarray
    counted: np.ndarray


# Rows of int32 before the ring of due ages.
MARKS = 9


def rows_of(n: int, m: int, p: int, slots: int) -> tuple[int, int]:
    """Returns how many rows of float64 and of int32 a fleet has."""
    return 3 * n + p + 5 + slots * (n + m + p), MARKS + slots


@inner
def fleet_of(n, m, p, slots, numbers, marks):
    """Returns the `Fleet` in an array of float64 and one of int32, rows by environments."""
    N, state, mean, end = numbers.shape[1], numbers[:n], numbers[n : 2 * n], 2 * n
    priors = numbers[end : end + slots * n].reshape(slots, n, N)
    end += slots * n
    inputs = numbers[end : end + slots * m].reshape(slots, m, N)
    end += slots * m
    samples = numbers[end : end + slots * p].reshape(slots, p, N)
    end += slots * p
    disturbance, end = numbers[end : end + n], end + n
    noise, end = numbers[end : end + p], end + p
    uniforms, violations, keys = numbers[end : end + 3], numbers[end + 3], numbers[end + 4].view(np.uint64)
    return Fleet(
        state,
        mean,
        priors,
        inputs,
        samples,
        disturbance,
        noise,
        uniforms,
        violations,
        keys,
        marks[MARKS:],
        marks[0],
        marks[1],
        marks[2],
        marks[3],
        marks[4],
        marks[5],
        marks[6],
        marks[7],
        marks[8],
    )
