"""What a certificate says of a network that goes silent: how long the box is kept, and how the guarantee returns.

The statement and its proof are in docs/shield_proof.md, "A contract that is exceeded".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ncs_gym import Ellipsoid, LinearPlant
from ncs_gym.estimation.error_bound import certified_error_set
from ncs_gym.estimation.kalman_filter import ErrorRecursion
from ncs_gym.network.channel import in_time
from ncs_gym.validation import as_count, counted
from shields.certificate import Certificate
from shields.certificate_text import labeled
from shields.polytope import Polytope
from shields.synthesis.design_problem import Rest
from shields.synthesis.faces import Extremes, Faces
from shields.synthesis.resting_point import around, limit_rows
from shields.verification import ACTION_ROUNDING, require_valid
from shields.verification.polytope_conditions import faces_of

# More steps are not looked at.
MOST_STEPS = 200
# Lengths of outages after which a way back is computed, in contracts, and the longest way that is looked for.
OUTAGES, LONGEST_WAY = (2, 10, 100), 10_000
# What limits must be kept by, in units of the distance of their nearer end from the resting point: far more than the
# rounding of float64.
MARGIN = 1e-8


class WayBack(NamedTuple):
    """After how many steps the error lies in its certified set again, counted from the first sample after an outage.

    Attributes:
        outage: Its length [steps].
        often: Where samples come at every step then.
        rarely: Where they come as rarely as the contract allows, every max_age + 1 steps.
    """

    outage: int
    often: int | None
    rarely: int | None


@dataclass(frozen=True)
class Silence:
    """What is known in advance of silences that exceed the contract of a certificate; printed, it says so in words.

    Behind a downlink commands must keep arriving as its contract says.

    Attributes:
        max_age: Steps that the newest sample may be old under the contract, with what a downlink takes of them.
        dt: Duration of a step [s]; None for a plant that has none.
        anywhere: For how many steps more, at most `MOST_STEPS`, the box is kept from any belief that the contract
            allows, whatever the agent and the disturbance do (every mode of a shield but "monitor").
        at_half: The same with the fallback input, from an estimate in half of the safe set around its resting point;
            the state itself may be outside then.
        at_rest: The same from an estimate at the resting point.
        ways_back: How the guarantee returns after outages.
    """

    max_age: int
    dt: float | None
    anywhere: int
    at_half: int
    at_rest: int
    ways_back: tuple[WayBack, ...]

    def __str__(self) -> str:
        def until(steps: int) -> str:
            most, number = " or more" if steps >= MOST_STEPS else "", self.max_age + steps
            seconds = "" if self.dt is None else f" ({in_time(number * self.dt)})"
            return f"{counted(number, 'step')}{seconds}{most} old"

        kept = (
            f"if no sample comes, late ones included, the box is kept until the newest is {until(self.anywhere)}, from "
            "any belief that the contract allows and whatever the agent does; with the fallback input, from an "
            f"estimate in half of the safe set, until it is {until(self.at_half)}, from one at rest until "
            f"{until(self.at_rest)}"
        )
        ways = [way.rarely for way in self.ways_back]
        outages = _listed([str(way.outage) for way in self.ways_back])
        steps = _listed(["not within 10,000" if each is None else f"{each:,}" for each in ways])
        back = (
            f"after {outages} steps without a sample the error is in its certified set again "
            f"{steps} steps after the first sample, if samples come as rarely as the contract allows"
        )
        return labeled("  silence     ", kept) + "\n" + labeled("  way back    ", back)


def silence_of(certificate: Certificate, plant: LinearPlant, input_delay: int = 0) -> Silence | None:
    """Returns what is known of silences that exceed a certificate's contract; None without a contract.

    Args:
        certificate: Verified exactly here.
        plant: Its plant.
        input_delay: What a downlink takes of the contract's age [steps], as `NCSEnv.downlink_protocol` says.

    Raises:
        CertificateError: If the certificate does not verify for the plant.
        ValueError: If the input delay is beyond the contract's age.
    """
    require_valid(certificate, plant)
    contract = certificate.contract
    if contract is None:
        return None
    fallbacks = _Fallbacks(certificate, plant)
    recursion = ErrorRecursion(plant, contract.quantization_step, certified_error_set(plant, contract))
    input_delay = as_count(input_delay, "input_delay", low=0, high=contract.max_age)
    rarest = contract.max_age - input_delay + 1  # steps from one sample to the next, if they arrive at once
    outages = [many * max(contract.max_age, 1) for many in OUTAGES]
    ways = [WayBack(steps, *(way_back(recursion, steps, gap) for gap in (1, rarest))) for steps in outages]
    at_half, at_rest = (fallbacks.kept(0, MOST_STEPS, share) for share in (0.5, 0.0))
    return Silence(contract.max_age, plant.dt, fallbacks.kept_anywhere(), at_half, at_rest, tuple(ways))


class _Fallbacks:
    """For how many fallback inputs in a row, without a sample, the limits are kept.

    In coordinates around the resting point, with y the state, e the error of its estimate and w the disturbances,

        y_hat_j = (A + B K)^j (y_0 + e_0),    e_j = A^j e_0 - sum_{i<j} A^i w,    y_j = y_hat_j - e_j,

    so that a limit r y_j + s u_j with u_j = K y_hat_j is a sum of supports: of S for y_0, and of E(Sigma) and E(D). If
    the resting point is no equilibrium, sum_{i<j} (A + B K)^i (A x_c + B u_c - x_c) is added to y_hat_j.
    """

    def __init__(self, certificate: Certificate, plant: LinearPlant) -> None:
        rest, n, k = certificate.fallback, plant.n, len(plant.box)
        limits = around(limit_rows(plant), Rest(rest.resting_state, rest.resting_input))
        self._rows_on_states, self._has_ways = k, len(plant.step_rows) > 0
        self._low, self._high = limits.low, limits.high
        self._own = MARGIN * np.minimum(np.abs(self._low), np.abs(self._high))
        self._on_state, self._on_input = limits.rows[:, :n], limits.rows[:, n:]
        self._on_estimate = self._on_state + self._on_input @ rest.gain
        self._powers, self._loops = _powers(plant.A), _powers(plant.A + plant.B @ rest.gain)
        self._moved = plant.A @ rest.resting_state + plant.B @ rest.resting_input - rest.resting_state
        self._plant, self._set = plant, _Supports(certificate, plant)
        self._rounded = float(ACTION_ROUNDING) * plant.largest_input
        self._error = certificate.Sigma
        self._known: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}

    def kept_anywhere(self) -> int:
        """Returns after how many steps without a sample, from the oldest age that is allowed, the box may be left."""
        last, age = MOST_STEPS, 1  # the step from the oldest age itself is certified
        while age < last:
            last = min(last, age + self.kept(age, last - age))
            age += 1
        return last

    def kept(self, age: int, most: int, share: float | None = None) -> int:
        """Returns for how many steps the limits are kept, `age` steps after the oldest.

        The state is in S or, if a share is given, its estimate in that share of S.
        """
        # S is in the box, but with a share it is not known that the state is in S.
        first = 0 if share is not None and self._has_ways else self._rows_on_states
        if not self._keeps(age, 0, share)[first:].all():
            return 0
        for steps in range(1, most + 1):
            kept = self._keeps(age, steps, share)
            if not kept[: self._rows_on_states].all():
                return steps - 1
            if not kept.all():  # the next input is not known to be within its limits
                return steps
        return most

    def _keeps(self, age: int, j: int, share: float | None) -> np.ndarray:
        """Returns which limits are kept after j fallback inputs, shape (q,)."""
        least, largest, reach = self._after(j)
        error = -self._on_state @ self._powers[j]
        if share is None:
            error = error + self._on_estimate @ self._loops[j]
        else:
            least, largest = share * least, share * largest
        D = self._plant.disturbance.shape_matrix
        grown = _support(error @ self._powers[:age], D).sum(axis=0)  # since the oldest age
        reach = reach + grown + _support(error @ self._powers[age], self._error)
        kept: np.ndarray = (self._low <= least - reach) & (largest + reach <= self._high)
        return kept

    def _after(self, j: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns what S, and what disturbances and rounding add, after j inputs: the same for every age."""
        if j not in self._known:
            disturbed = _support(self._on_state @ self._powers[:j], self._plant.disturbance.shape_matrix)
            rounded = np.abs(self._on_estimate @ self._loops[:j] @ self._plant.B) @ self._rounded
            reach = self._own + (disturbed + rounded).sum(axis=0) + np.abs(self._on_input) @ self._rounded
            reach = reach + np.abs(self._on_estimate @ self._loops[:j].sum(axis=0) @ self._moved)
            self._known[j] = *self._set.of(self._on_estimate @ self._loops[j]), reach
        return self._known[j]


def _powers(matrix: np.ndarray) -> np.ndarray:
    """Returns shape (MOST_STEPS + 1, n, n)."""
    powers = [np.eye(len(matrix))]
    for _ in range(MOST_STEPS):
        powers.append(matrix @ powers[-1])
    return np.array(powers)


class _Supports:
    """Bounds of the values of rows in S, around the resting point, which do not depend on units."""

    def __init__(self, certificate: Certificate, plant: LinearPlant) -> None:
        self._set = kept = certificate.safe_set
        if isinstance(kept, Polytope):
            faces, shift = faces_of(kept, len(plant.box)), kept.rows @ kept.center
            assert faces is not None  # it was verified
            self._units = (1.0 + 1e-9) * np.array([float(each) for each in faces.widths])  # |y_i| is at most as large
            self._extremes = Extremes(Faces(kept.rows * self._units, kept.low - shift, kept.high - shift))

    def of(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns them for rows, shape (q, n): two arrays of shape (q,)."""
        if isinstance(self._set, Ellipsoid):
            reach = _support(rows, self._set.shape_matrix)
            return -reach, reach
        rows, reach = rows * self._units, np.ones(rows.shape[1])
        sizes = np.abs(rows).max(axis=1)
        bounds = [self._extremes.bounds(row / (size or 1.0), reach) for row, size in zip(rows, sizes, strict=True)]
        least, largest = np.array(bounds).T * sizes
        return least, largest


def _support(rows: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Returns the largest values of rows, shape (..., q, n), in E(shape), shape (..., q)."""
    return np.sqrt(np.maximum(((rows @ shape) * rows).sum(axis=-1), 0.0))


def way_back(recursion: ErrorRecursion, outage: int, gap: int) -> int | None:
    """Returns after how many steps from the first sample on the shape is certified again; None if never.

    Samples came so rarely before the outage, too.
    """
    known = recursion.first
    for number, steps in enumerate([gap] * 5 + [outage] + [gap] * (LONGEST_WAY // gap)):
        for _ in range(steps):
            known = recursion.predicted(known)
        updated = recursion.updated(known)
        assert updated is not None  # under a contract every sample is used
        known = updated[1]
        if number >= 5 and known.certified:
            return (number - 5) * gap
    return None


def _listed(texts: list[str]) -> str:
    return ", ".join(texts[:-1]) + f" and {texts[-1]}"
