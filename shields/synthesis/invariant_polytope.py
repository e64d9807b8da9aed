"""The largest polytope that the certified gain keeps in the safe box (docs/shield_proof.md, "Polytopes").

It begins with the rows of the box and of the input limits. The next state fulfils a row, |g x| <= 1, if |g (A+BK) x|
<= 1 - s - d, where s and d are the supports of the estimation error and of the disturbance: that is a row again. What a
linear program shows to hold already is not added. A+BK is stable, so this comes to an end.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.stats import qmc

from ncs_gym import LinearPlant, exact
from shields.certificate import Certificate
from shields.errors import Infeasible
from shields.polytope import MOST_ROWS, Polytope
from shields.synthesis.design_problem import Rest
from shields.synthesis.faces import OPEN, Extremes, Faces, multipliers_of
from shields.synthesis.resting_point import around, limit_rows, units_of_states
from shields.verification import ACTION_ROUNDING

# The search follows at most so many rows from one step to the one before, nearly five times what it takes for any
# published plant that has a polytope.
MOST_FOLLOWED = 2000
# What the next states keep from every face, relative to the polytope: room for the rounding of rows and multipliers,
# and for what others imply only up to some part of it. Where the first one makes too many rows, the largest one mostly
# makes fewest; those after it are for fallbacks that bear little more than their radii.
MARGINS = (1e-6, 2e-4, 6e-5, 2e-5, 6e-6)
# A row counts as implied by others up to this; next to the larger margin, up to this part of it.
_IMPLIED, _NEARLY_IMPLIED = 1e-9, 0.9
# States reach this far in their units, up to this power of ten and down to it, or are sought again in units of that.
_SIMILAR = 1.0
# A search that had too many rows has too many again once it has grown by this factor.
_GROWN = 1.1
# Significant digits of rows and multipliers; what a row lacks by that is far below the margin.
_DIGITS = 10
# Points at which the share of the box is counted: the third digit is right.
_POINTS_LOG2 = 16
# Of fewer of them within all limits no share is said.
_LEAST_POINTS = 4000
# Steps after which it must be known which points a gain keeps in the box.
_MOST_STEPS = 3000


# Called with a line of text now and then: what is sought, and what is reached.
Progress = Callable[[str], object]


class Feedback(NamedTuple):
    """The fallback u = u_c + K (x_hat - x_c), K of shape (m, n), with shapes of errors, (l, n, n), and D, (n, n)."""

    K: np.ndarray
    errors: np.ndarray
    D: np.ndarray
    rest: Rest


def feedback_of(certificate: Certificate) -> Feedback:
    """Returns the fallback of a certificate."""
    rest = Rest(certificate.resting_state, certificate.resting_input)
    return Feedback(certificate.K, certificate.error_shapes, certificate.D, rest)


def in_half_ranges(rows: np.ndarray, low: np.ndarray, high: np.ndarray) -> Faces:
    """Returns rows with ends in units of half their range, or of the distance of the only end.

    Raises:
        Infeasible: If z = 0 is not inside.
    """
    if not ((low < 0.0) & (high > 0.0)).all():
        raise _none("errors and disturbances alone leave one of its faces; smaller bounds leave room")
    both = np.isfinite(low) & np.isfinite(high)
    half = np.where(both, 0.5 * high - 0.5 * low, np.minimum(-low, high))
    return Faces(rows / half[:, None], low / half, high / half)


def invariant_polytope(
    feedback: Feedback, plant: LinearPlant, margin: float, progress: Progress = lambda line: None
) -> Polytope:
    """Returns the largest polytope that a fallback keeps invariant, not yet verified.

    A state along which it would have no end gets the limit within which its gain was sought. From the margin, one of
    `MARGINS`, follows how much a row must cut.

    Raises:
        Infeasible: If there is none within `MOST_ROWS` rows, `MOST_FOLLOWED` of them followed; the message says why.
    """
    step, kept = _ClosedLoop(feedback, plant, margin), len(plant.box)
    implied = _IMPLIED if margin == MARGINS[0] else _NEARLY_IMPLIED * margin
    faces = invariant_faces(step.first_faces(), step.predecessor, kept, progress, implied)
    extents = _extents(faces) if step.has_free_states else np.ones(plant.n)
    if (np.abs(np.log10(extents)) > _SIMILAR).any():  # how far states go is known now
        limited = np.isinf(extents)
        grown, own, ones = np.where(limited, 1.0, extents), np.eye(plant.n)[limited], np.ones(np.count_nonzero(limited))
        step.widths = step.widths * grown
        faces = faces._replace(rows=faces.rows * grown).followed_by(Faces(own, -ones, ones))
        faces = invariant_faces(faces, step.predecessor, kept, progress, implied)
    physical = step.in_physical_units(faces)
    upper, lower = step.multipliers(physical)
    return Polytope(
        rows=physical.rows,
        low=physical.low,
        high=physical.high,
        center=step.rest.state,
        multipliers=upper,
        lower_multipliers=lower,
    )


def invariant_faces(
    faces: Faces,
    predecessor: Callable[[Faces], Faces],
    kept: int,
    progress: Progress = lambda line: None,
    implied: float = _IMPLIED,
) -> Faces:
    """Returns the faces of the largest polytope in another one whose states stay in it.

    Args:
        faces: Of the other one, in coordinates of similar size.
        predecessor: Of a row, what states fulfil exactly if the next ones fulfil the row for sure.
        kept: So many of the first rows stay even where others imply them; such rows are not followed then.
        progress: Called with a line of text now and then.
        implied: A row is added if it cuts off more than that.

    Raises:
        Infeasible: If there are none within `MOST_ROWS` and `MOST_FOLLOWED`, or `predecessor` raises it.
    """
    if kept > MOST_ROWS:
        raise _none(
            f"the safe box alone has {kept} rows, and it would need {MOST_ROWS} at most: leave out implied ones"
        )
    own = faces.some(slice(kept))
    faces, _ = _without_implied(faces, kept, implied)
    within = Extremes(faces)
    following, followed, most = 0, 0, MOST_ROWS
    while following < len(within.faces.rows):
        if following < kept and not any(_cuts_others(within, following, implied)):
            within.set_ends(following, -math.inf, math.inf)  # so that of two equal rows one is followed
            following += 1
            continue
        if len(within.faces.rows) > most:  # what later ones imply leads nowhere else, either
            faces, following = _without_implied(within.faces, kept, implied, following)
            _require_few(faces)
            within, most = Extremes(faces), max(MOST_ROWS, int(_GROWN * len(faces.rows)))
        if followed >= MOST_FOLLOWED:
            reason = f"its search follows more than {MOST_FOLLOWED} rows, fewer with longer steps"
            raise Infeasible(reason, "R", 0.0)
        if following % 50 == 0:
            progress(f"polytope: {len(within.faces.rows)} rows")
        row = predecessor(within.faces.some([following]))
        low, high = _cuts(within, row, implied)
        if low or high:
            within.add(row._replace(low=row.low if low else OPEN[0], high=row.high if high else OPEN[1]))
        following, followed = following + 1, followed + 1
    faces = own.followed_by(within.faces.some(slice(kept, None)))
    progress(f"polytope: which of {len(faces.rows)} rows count")
    faces = _bounding_every_state(_without_implied(faces, kept, implied)[0], kept)
    _require_few(faces)
    return faces


def share_in_polytope(polytope: Polytope, plant: LinearPlant) -> float | None:
    """Returns the share of the safe box's volume that a polytope fills, to about three digits.

    Past inputs are the operating one. None where a state has no limits of its own.
    """
    low, high = plant.own_limits  # of the box that these make, further limits leave a part
    if not np.isfinite(plant.own_limits).all():
        return None
    points = low + (high - low) * qmc.Sobol(plant.n, scramble=False).random_base2(_POINTS_LOG2)
    points[:, plant.n - plant.past :] = 0.0
    points = points[(plant.constraint_values(points.T) <= 0.0).all(axis=0)]
    return float((polytope.gauge(points) <= 1.0).mean()) if len(points) >= _LEAST_POINTS else None


def points_of_box(plant: LinearPlant, log2: int) -> np.ndarray | None:
    """Returns 2^log2 points that fill the safe box evenly, (2^log2, n), past inputs within the limits of inputs.

    None where the box is no product of intervals.
    """
    rows, past = plant.box, plant.past
    is_product = rows.shape == (plant.n, plant.n) and np.count_nonzero(rows) == plant.n and rows.any(axis=0).all()
    if not is_product or not np.isfinite(plant.box_ends).all():
        return None
    order = np.abs(rows).argmax(axis=0)  # the row of each state
    ends, units = plant.box_ends[:, order], rows.sum(axis=0)
    if past:
        ends[:, -past:], units[-past:] = np.tile(plant.input_ends, past // plant.m), 1.0
    drawn = 2.0 * qmc.Sobol(plant.n, scramble=False).random_base2(log2) - 1.0
    return (0.5 * (ends[0] + ends[1]) + 0.5 * (ends[1] - ends[0]) * drawn) / units


def share_of_points(feedback: Feedback, plant: LinearPlant, points: np.ndarray) -> float:
    """Returns what share of points of the safe box a fallback keeps in it for ever.

    They are those of the polytope of `invariant_polytope`, found without linear programs, and without the limit of
    rows. 0.0 where there is no such polytope, or `_MOST_STEPS` steps do not tell. Points are of shape (count, n).
    """
    step, total = _ClosedLoop(feedback, plant, MARGINS[0]), len(points)
    if np.abs(np.linalg.eigvals(step.next)).max() >= 1.0:
        return 0.0
    points = (points - feedback.rest.state) / step.widths
    least, most = points.min(axis=0), points.max(axis=0)
    try:
        faces = step.first_faces()
        for _ in range(_MOST_STEPS):
            points = points[faces.holds(points)]
            faces = step.predecessor(faces)
            up, down = np.maximum(faces.rows, 0.0), np.minimum(faces.rows, 0.0)
            # The others hold in all of the box.
            cuts = (up @ most + down @ least > faces.high) | (up @ least + down @ most < faces.low)
            faces = faces.some(cuts)
            if not (len(faces.rows) and len(points)):
                return len(points) / total
    except Infeasible:
        pass
    return 0.0


def limits_within_step(feedback: Feedback, plant: LinearPlant) -> Faces:
    """Returns what limits within a step ask of x - x_c under the fallback, for all errors and roundings of inputs.

    They are the plant's `step_rows` (docs/shield_proof.md, "States and inputs together").
    """
    (K, errors, _, rest), k = feedback, len(plant.box) + plant.m
    rows, low, high = (each[k:] for each in around(limit_rows(plant), rest))
    state, pushed = np.split(rows, [plant.n], axis=1)
    answer, taken = pushed @ K, float(ACTION_ROUNDING) * (np.abs(pushed) @ plant.input_half)
    taken = taken + np.sqrt(np.maximum(np.einsum("ri,lij,rj->lr", answer, errors, answer), 0.0).max(axis=0))
    return Faces(state + answer, low + taken, high - taken)


class _ClosedLoop:
    """What one step makes of rows, in units of the safe box and from the resting point."""

    def __init__(self, feedback: Feedback, plant: LinearPlant, margin: float) -> None:
        self.plant, self._feedback, self._margin = plant, feedback, margin
        self._K, self._errors, self._D, self.rest = feedback
        self.widths = units_of_states(plant, self.rest)
        self.has_free_states = self.widths is not plant.half_widths
        self.next = plant.A + plant.B @ self._K

    def first_faces(self) -> Faces:
        """Returns the faces of the box, of inputs, and within a step; raises Infeasible if errors alone leave one."""
        plant, (x_c, u_c) = self.plant, self.rest
        reached = plant.box @ x_c
        box = in_half_ranges(plant.box, *(plant.kept_ends - reached))
        taken = plant.input_half * (float(ACTION_ROUNDING) + self._margin) + self._reach(self._K)
        low, high = plant.input_ends[0] - u_c + taken, plant.input_ends[1] - u_c - taken
        if ((low >= 0.0) | (high <= 0.0)).any():
            raise _none("the error of the estimate alone takes an input beyond its limit; better sensors leave room")
        inputs, within = in_half_ranges(self._K, low, high), limits_within_step(self._feedback, plant)
        low, high = within.low + self._margin, within.high - self._margin
        if ((low >= 0.0) | (high <= 0.0)).any():
            raise _none(
                "errors of the estimate alone break a limit within a step; better sensors, or a gain that answers "
                "less, leave room"
            )
        faces = box.followed_by(inputs).followed_by(in_half_ranges(within.rows, low, high))
        return faces._replace(rows=faces.rows * self.widths)

    def predecessor(self, faces: Faces) -> Faces:
        """Returns what states have to fulfil so that the next ones fulfil rows; raises Infeasible as `first_faces`."""
        physical = faces.rows / self.widths
        pushed = physical @ self.plant.B
        taken = self._margin + self._reach(pushed @ self._K) + np.sqrt(((physical @ self._D) * physical).sum(axis=-1))
        taken = taken + float(ACTION_ROUNDING) * (np.abs(pushed) @ self.plant.input_half)
        return in_half_ranges((physical @ self.next) * self.widths, faces.low + taken, faces.high - taken)

    def _reach(self, rows: np.ndarray) -> np.ndarray:
        """Returns the largest support over the error sets of rows, shape (..., n) in physical units."""
        squares = np.einsum("...i,kij,...j->k...", rows, self._errors, rows)
        return np.sqrt(np.maximum(squares, 0.0)).max(axis=0)

    def in_physical_units(self, faces: Faces) -> Faces:
        """Returns rounded faces of the plant's state; those of the box are the plant's to the last bit."""
        plant, count = self.plant, len(self.plant.box)
        rows = exact.rounded(faces.rows, _DIGITS, axis=1) / self.widths
        reached = rows @ self.rest.state
        low, high = (
            np.where(np.isfinite(ends), exact.rounded(np.where(np.isfinite(ends), ends, 0.0), _DIGITS) + reached, ends)
            for ends in (faces.low, faces.high)
        )
        own = Faces(plant.box, *plant.kept_ends)
        return own.followed_by(Faces(rows, low, high).some(slice(count, None)))

    def multipliers(self, faces: Faces) -> tuple[np.ndarray, np.ndarray]:
        """Returns what bounds next rows, the gain's, and those within a step from above and below, (r + m + g, r)."""
        rows, limits = faces.rows, self.plant.input_half
        gains = slice(len(rows), len(rows) + self.plant.m)
        reached = rows @ self.rest.state
        own = Faces(rows * self.widths, faces.low - reached, faces.high - reached)
        within = limits_within_step(self._feedback, self.plant).rows
        images = np.concatenate([rows @ self.next, self._K / limits[:, None], within]) * self.widths
        found = np.array([multipliers_of(own, image) for image in images])
        found[np.abs(found) < 1e-13] = 0.0
        found[gains] *= limits[:, None, None]
        lower, upper = exact.rounded(found, _DIGITS + 2, axis=2).swapaxes(0, 1)
        return upper, lower


def _none(reason: str) -> Infeasible:
    return Infeasible(reason, "P", 0.0)


def _require_few(faces: Faces) -> None:
    if len(faces.rows) > MOST_ROWS:
        reason = f"it would need more than {MOST_ROWS} rows, fewer with longer steps or less disturbance"
        raise Infeasible(reason, "R", 0.0)


def _extents(faces: Faces) -> np.ndarray:
    """Returns how far every coordinate reaches in a polytope, shape (n,); infinite where it has no end."""
    within = Extremes(faces)
    return np.abs([within.of(row) for row in np.eye(faces.rows.shape[1])]).max(axis=1)


def _cuts(within: Extremes, row: Faces, implied: float) -> tuple[bool, bool]:
    """Returns whether the low and the high end of one row cut more than that off a polytope."""
    low, high = float(row.low[0]), float(row.high[0])
    # An open end cuts nothing, even off what is unbounded.
    return (
        low > -math.inf and within.least(row.rows[0]) < low - implied,
        high < math.inf and within.largest(row.rows[0]) > high + implied,
    )


def _cuts_others(within: Extremes, number: int, implied: float) -> tuple[bool, bool]:
    """Returns whether the ends of a face cut more than that off what the other faces bound."""
    row = within.faces.some([number])
    within.set_ends(number, -math.inf, math.inf)
    cuts = _cuts(within, row, implied)
    within.set_ends(number, float(row.low[0]), float(row.high[0]))
    return cuts


def _without_implied(faces: Faces, kept: int, implied: float, count: int = 0) -> tuple[Faces, int]:
    """Returns faces without those that the others imply, and how many of the first `count` rows stay.

    The `kept` first stay as they are. Of a row that only cuts with one end the other one is opened.
    """
    within, stays = Extremes(faces), np.full(len(faces.rows), True)
    for i in range(len(faces.rows) - 1, kept - 1, -1):
        low, high = _cuts_others(within, i, implied)
        within.set_ends(
            i, float(within.faces.low[i]) if low else -math.inf, float(within.faces.high[i]) if high else math.inf
        )
        stays[i] = low or high
    return within.faces.some(stays), int(np.count_nonzero(stays[:count]))


def _bounding_every_state(faces: Faces, kept: int) -> Faces:
    """Returns faces of which those with two ends bound every state, as proofs ask for, if the polytope is bounded.

    An open end is closed where the others imply it; the `kept` first rows are followed by a closed copy instead.
    """
    rows, low, high = (part.copy() for part in faces)
    closed = np.isfinite(low) & np.isfinite(high)
    for i in np.flatnonzero(~closed).tolist():
        rank = np.linalg.matrix_rank(rows[closed]) if closed.any() else 0
        if rank == rows.shape[1]:
            break
        least, largest = Extremes(faces).of(rows[i])
        is_bounded = math.isfinite(least) and math.isfinite(largest)
        if not is_bounded or np.linalg.matrix_rank(np.vstack([rows[closed], rows[i]])) == rank:
            continue
        ends = max(float(low[i]), least), min(float(high[i]), largest)
        if i < kept:
            rows, low, high = np.vstack([rows, rows[i]]), np.append(low, ends[0]), np.append(high, ends[1])
            closed = np.append(closed, True)
        else:
            low[i], high[i] = ends
            closed[i] = True
    return Faces(rows, low, high)
