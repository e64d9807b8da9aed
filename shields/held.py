"""What can be held under a certificate: at which set points the filter lets the input pass that holds them.

These are numbers of solvers in float64, for planning: nothing is proved with them, and the filter decides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ncs_gym import LinearPlant
from ncs_gym.validation import ReadOnlyArrays, as_count, as_vector, counted, shown
from shields.certificate import Certificate
from shields.certificate_text import Reach, labeled, reach_in
from shields.runtime import SafetyFilter
from shields.runtime.safety_filter import MARGIN
from shields.synthesis.resting_point import equilibria
from shields.synthesis.semidefinite_programs import extreme_points
from shields.verification import require_valid

# Set points keep this much from what the filter lets pass, in units of its rows: more than a solver is off.
_KEPT = 1e-6
# A state that equilibria move by less than this share of its limits is none that is held at set points.
_UNMOVED = 1e-3


@dataclass(frozen=True, eq=False, kw_only=True)
class SetPoints(ReadOnlyArrays):
    """Between which set points of an output no calm step is overridden.

    A step is calm if the estimate is the set point itself.

    Attributes:
        age: Age of the newest sample that error sets were taken for [steps].
        low, high: The ends [physical units].
        deviations: Both as deviations from the operating point, shape (2,).
        states: The states at rest at both ends, as deviations, shape (2, n).
        inputs: The inputs that hold them, as deviations, shape (2, m).
    """

    age: int
    low: float
    high: float
    deviations: np.ndarray
    states: np.ndarray
    inputs: np.ndarray

    def __post_init__(self) -> None:
        self._make_arrays_read_only()


def setpoint_range(certificate: Certificate, plant: LinearPlant, output: Any, age: int = 0) -> SetPoints | None:
    """Returns between which set points of an output no calm step is overridden; None if none are found.

    The least and the largest c x_s of all x_s = A x_s + B u_s with u_s, and limits of both together, within their ends,
    at which the filter lets u_s pass with the estimate x_s and the certified error set of an age. Estimates are often
    better than that set: a loop may rest somewhat beyond the range, and disturbances move it from set points inside.

    Args:
        certificate: Verified exactly here.
        plant: The plant it was made for.
        output: c, shape (n,), or (n - past,) without past inputs; or the name or the index of a state.
        age: Of the newest sample [steps], at most that of the contract; without a contract 0, which is any age.

    Raises:
        CertificateError: If the certificate does not verify for the plant, or float64 is too coarse for it.
        ValueError: If an argument is of another kind, no state has this name or index, or no error set this age.
    """
    shield = SafetyFilter(certificate, plant)
    row, shapes = _row_of(output, plant), certificate.error_shapes
    age = as_count(age, "age", low=0, high=len(shapes) - 1)
    errors, test = shield.errors_of(shapes[age]), shield.test
    directions, kept, n = equilibria(plant), shield.projection_margin + _KEPT, plant.n
    moved, half = np.hstack([test.state_rows, test.input_rows]) @ directions, plant.input_half
    rows = np.concatenate([moved[test.cone :], directions[n:] / half[:, None]])
    middle = np.concatenate([test.middle, plant.input_middle / half])
    ends = np.concatenate([errors.row_limits - kept, np.full(plant.m, 1.0 - _KEPT)])
    ball = errors.weighting @ moved[: test.cone], errors.radius - kept
    found = extreme_points(row @ directions[:n], rows, middle - ends, middle + ends, *ball)
    if found is None:
        return None
    points = found @ directions.T
    if not all(test.margins_alone(point[:n], errors, point[n:])[0] >= MARGIN for point in points):
        return None
    states, inputs = np.split(points, [n], axis=1)
    low, high = (states @ row + row @ plant.operating_state).tolist()
    return SetPoints(age=age, low=low, high=high, deviations=states @ row, states=states, inputs=inputs)


def reach_of(certificate: Certificate, plant: LinearPlant) -> tuple[Reach, ...]:
    """Returns how far each quantity that the safe box limits gets inside the safe set of a certificate.

    Raises:
        CertificateError: If the certificate does not verify for the plant.
        ValueError: If an argument is of another kind, or a solver fails.
    """
    require_valid(certificate, plant)
    return reach_in(certificate.safe_set, plant)


def held_text(certificate: Certificate, plant: LinearPlant, input_delay: int = 0) -> str:
    """Returns `reach_of`, and the set points of the outputs that measure one state, in words.

    A downlink takes `input_delay` steps of the contract's age: no sample is fresher.
    """
    reach = ", ".join(map(str, reach_of(certificate, plant)))
    measured = [int(row.argmax()) for row in plant.H != 0.0 if row.sum() == 1]
    moved = np.abs(equilibria(plant)[: plant.n]).max(axis=1, initial=0.0) > _UNMOVED * plant.half_widths
    texts = [_range_text(certificate, plant, j, input_delay) for j in dict.fromkeys(measured) if moved[j]]
    points = f"{'; '.join(texts)} (for planning: the filter decides)" if texts else ""
    named = {"reach": reach, "set points": points}
    return "\n".join(labeled(f"  {name:12}", text) for name, text in named.items() if text)


def _range_text(certificate: Certificate, plant: LinearPlant, state: int, input_delay: int) -> str:
    oldest, texts, unit = len(certificate.proofs) - 1, [], plant.state_units[state]
    for age in dict.fromkeys([min(input_delay, oldest), oldest]):
        points = setpoint_range(certificate, plant, state, age)
        ends = "nowhere" if points is None else f"from {points.low:.4g} to {points.high:.4g} {unit}".rstrip()
        texts.append(f"{ends} with samples {counted(age, 'step')} old" if oldest else ends)
    return f"{plant.state_names[state]} {', '.join(texts)}"


def _row_of(output: Any, plant: LinearPlant) -> np.ndarray:
    if isinstance(output, str):
        if output not in plant.state_names:
            raise ValueError(f"output must be one of the states {list(plant.state_names)}, got {shown(output)}")
        return np.eye(plant.n)[plant.state_names.index(output)]
    if np.ndim(output) == 0:
        return np.eye(plant.n)[as_count(output, "output", low=0, high=plant.n - 1)]
    own = plant.n - plant.past
    size = own if np.shape(output) == (own,) else plant.n
    return np.pad(as_vector(output, size, "output"), (0, plant.n - size))
