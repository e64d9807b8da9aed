"""The one-step test and the mode of a shield as compiled loops know them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from ncs_gym.compiled import inner


class Rule(NamedTuple):
    """The test and the mode as loops need them.

    Attributes:
        moved: G A, shape (n, n).
        effect: G B, shape (n, m).
        columns: Of the bound on rounding, shape (n,).
        gain: K, shape (m, n).
        limits: u_max, shape (m,).
        vertices: Of the input box, shape (2^m, m); empty but in mode "boundary".
        pushed: What rounding grows with.
        rounding: Relative.
        margin: Room that an input must have.
        reserve: Room that a projected input must have.
        farthest: Estimates beyond this reach are unusable.
        smallest: Smallest radius with weights.
        monitors: Mode "monitor".
        projects: Mode "project".
    """

    moved: np.ndarray
    effect: np.ndarray
    columns: np.ndarray
    gain: np.ndarray
    limits: np.ndarray
    vertices: np.ndarray
    pushed: float
    rounding: float
    margin: float
    reserve: float
    farthest: float
    smallest: float
    monitors: bool
    projects: bool


def packed(rule: Rule) -> tuple[np.ndarray, np.ndarray]:
    """Returns the whole numbers and the others of a rule, as `unpacked` wants them; arrays are cheap to hand over."""
    counts = [*rule.effect.shape, len(rule.vertices), rule.monitors, rule.projects]
    arrays = [rule.moved, rule.effect, rule.columns, rule.gain, rule.limits, rule.vertices]
    scalars = [rule.pushed, rule.rounding, rule.margin, rule.reserve, rule.farthest, rule.smallest]
    return np.array(counts, np.int64), np.concatenate([*(each.ravel() for each in arrays), scalars])


@inner
def unpacked(counts, numbers):
    """Returns the `Rule` that was packed."""
    n, m, corners = counts[0], counts[1], counts[2]
    effect = n * n
    columns = effect + n * m
    gain = columns + n
    limits = gain + m * n
    vertices = limits + m
    end = vertices + corners * m
    return Rule(
        numbers[:effect].reshape(n, n),
        numbers[effect:columns].reshape(n, m),
        numbers[columns:gain],
        numbers[gain:limits].reshape(m, n),
        numbers[limits:vertices],
        numbers[vertices:end].reshape(corners, m),
        numbers[end],
        numbers[end + 1],
        numbers[end + 2],
        numbers[end + 3],
        numbers[end + 4],
        numbers[end + 5],
        counts[3] != 0,
        counts[4] != 0,
    )
