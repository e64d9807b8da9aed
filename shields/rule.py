"""The one-step test and the mode of a shield as compiled loops know them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


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
