"""Bounds of disturbances from a recording of inputs and outputs: what must have acted, and what cannot have."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from textwrap import fill
from typing import Any

import numpy as np

from ncs_gym.bounds import Bounds, Box, Through
from ncs_gym.model import Model
from ncs_gym.plants.linear_plant import of_outputs
from ncs_gym.validation import ReadOnlyArrays, as_matrix, as_names, as_number, as_setting, counted, shown

# A record has at least so many windows, half of which are held against the other half.
FEWEST_WINDOWS = 20
# Singular values below this fraction of the largest are rounding.
_RANK_PRECISION = 1e-10
# Results of linear programs are moved outward by this fraction of their units, ten times the solver's tolerance.
_PRECISION = 1e-6
# Residuals grow with a signal if Student's t of the slope, and their change over its range in means, are above these.
_LEAST_T, _LEAST_GROWTH = 5.0, 0.5
# What other steps of the same direction, and other ones, count in combinations of outputs, of which the best is kept.
_MULTIPLES = ((1.0, 1.0), (10.0, 1.0), (100.0, 1.0), (100.0, 100.0))
# Steps of the parts of a record that each give a lower bound.
_PART = 200
# Further steps of a window of outputs at both ends, which leave less of other disturbances.
_FURTHER = 2


@dataclass(frozen=True, eq=False, kw_only=True)
class RecordedBounds(ReadOnlyArrays):
    """Half-widths of a disturbance E s, direction by direction, from a recording.

    Attributes:
        E: Directions, shape (n, q).
        directions, outputs: Their names.
        steps: Number of steps of the record.
        window: Number of steps from whose outputs one disturbance is told: 1 where states are measured.
        lower: No smaller half-width of a direction explains every sample, however large the others are, shape (q,).
        explaining: Those that together explain every sample with the smallest weighted sum, shape (q,).
        upper: No larger disturbance occurred, shape (q,), unless closer to an end of the record than the window;
            infinite where the outputs do not tell.
        sensor: Half-widths of the sensor noise that all these take for granted, shape (p,).
        left: Share of the second half's steps whose disturbance may exceed all of the first half's, shape (q,).
        grows: Sentences, where disturbances grow with a state or an input: the model is wrong, not the bound.
        first_error: Half-widths of the error of a state read off one sample, shape (n,); infinite where that is none.
    """

    E: np.ndarray
    directions: tuple[str, ...]
    outputs: tuple[str, ...]
    steps: int
    window: int
    lower: np.ndarray
    explaining: np.ndarray
    upper: np.ndarray
    sensor: np.ndarray
    left: np.ndarray
    grows: tuple[str, ...]
    first_error: np.ndarray

    def __post_init__(self) -> None:
        self._make_arrays_read_only()

    def bounds(self, factor: float, *, of: str = "upper", first_error: Any = None) -> Bounds:
        """Returns bounds of a plant: half-widths found here, times a factor, >= 1, that you declare.

        Args:
            factor: That of disturbances.
            of: "upper", or "explaining" where outputs leave no upper bound.
            first_error: As of `Bounds`; by default `first_error`.

        Raises:
            ValueError: If the factor is below 1, a direction has no upper bound, or one sample does not tell the state.
        """
        factor = as_number(factor, "factor", low=1.0)
        if of not in ("upper", "explaining"):
            raise ValueError(f'of must be "upper" or "explaining", got {shown(of)}')
        half = factor * getattr(self, of)
        if not np.isfinite(half).all():
            name = self.directions[int(np.argmin(np.isfinite(half)))]
            advice = 'measure more, give fewer directions, or take of="explaining" (--of explaining)'
            raise ValueError(f"these outputs leave no upper bound of {name}: {advice}")
        if first_error is None:
            if not np.isfinite(self.first_error).all():
                raise ValueError("one sample of these outputs does not tell the state: give first_error")
            first_error = self.first_error
        is_identity = np.array_equal(self.E, np.eye(len(self.E)))
        disturbance = Box(-half, half) if is_identity else Through(self.E, half)
        return Bounds(disturbance, self.sensor, first_error)

    def __str__(self) -> str:
        noise = ", ".join(f"{name} {half:.3g}" for name, half in zip(self.outputs, self.sensor, strict=True))
        width = max(9, *map(len, self.directions))
        lines = [
            fill(f"Half-widths of the disturbance of a step, of {counted(self.steps, 'step')}, if sensor noise was "
                 f"within {noise}.", 80),
            f"{'direction':<{width}}  at least  explaining   at most  left [%]",
        ]  # fmt: skip
        for i, name in enumerate(self.directions):
            most = f"{self.upper[i]:.3g}" if np.isfinite(self.upper[i]) else "none"
            lines.append(
                f"{name:<{width}}  {self.lower[i]:8.3g}  {self.explaining[i]:10.3g}  {most:>8}  "
                f"{100.0 * self.left[i]:8.3g}"
            )
        ends = f", unless one did within {counted(self.window, 'step')} of its ends" if self.window > 1 else ""
        where = "" if np.isfinite(self.upper).all() else " where there is one"
        sentences = (
            'If the model is right, this record proves that disturbances as large as "at least" occurred, and none '
            f'beyond "at most"{where}{ends}.',
            "It does not prove that none larger will occur: up to "
            f"{100.0 * self.left.max():.3g} % of the second half's steps may exceed all of the first half's (left).",
            "The factor that you declare is your claim, which further records on other days support, and more steps of "
            "the same one do not.",
            *self.grows,
        )
        return "\n".join([*lines, *(fill(each, 80) for each in sentences)])


def bounds_from_recording(
    model: Model,
    inputs: Any,
    outputs: Any,
    E: Any = None,
    *,
    sensor: Any,
    weights: Any = None,
    labels: Mapping[str, Any] | None = None,
) -> RecordedBounds:
    """Returns half-widths of s and v in x+ = A x + B u + E s, y = H x + v that a recording proves.

    - `explaining` minimizes the weighted sum of max |s_i| over all s, v and first states that fit every sample, a
      sparse linear program; `lower` minimizes each max |s_i| alone.
    - `upper`: a combination l of the outputs of a window in which the state cancels and s_i counts once is
      s_i + l v + c s, so that |s_i| <= |l y| + |l| |v| + |c| |s| at the largest one.

    Args:
        model: The equations.
        inputs: Of each step, shape (N, m), absolute like the outputs, not deviations from the operating point.
        outputs: Sampled before the input, shape (N + 1, p), or (N, p), where the last input is not used.
        E: Directions of the disturbance, shape (n, q); the identity if None.
        sensor: Half-widths of sensor noise, a number or shape (p,), as of a data sheet.
        weights: Of `explaining`, shape (q,); by default the inverse of what each would be if it explained the record.
        labels: As of `LinearPlant`.

    Raises:
        ValueError: If shapes do not fit, a value is not finite, the record is too short, the outputs do not tell the
            state, or no disturbance along E explains the record.
    """
    if not isinstance(model, Model):
        raise ValueError(f"model must be a Model, got {shown(model)}")
    H, (n, m), p = model.H, model.B.shape, len(model.H)
    u, y = as_matrix(inputs, (None, m), "inputs") - model.input, as_matrix(outputs, (None, p), "outputs")
    if len(y) - len(u) not in (0, 1):
        raise ValueError(f"outputs must have as many rows as inputs, or one more, got {len(y):,} and {len(u):,}")
    u, late = u[: len(y) - 1], int(model.delays.max())
    taken = [u[late - each : max(len(u) - each, 0)] for each in range(late + 1)]  # by the steps that they are late
    pushed = sum(each @ np.where(model.delays == d, model.B, 0.0).T for d, each in enumerate(taken))
    u = np.column_stack([taken[d][:, j] for j, d in enumerate(model.delays.max(axis=0).tolist())])
    y = (y - H @ model.state)[late:]
    is_identity, E = E is None, np.eye(n) if E is None else as_matrix(E, (n, None), "E")
    if not np.abs(E).max(axis=0).all():
        raise ValueError("every direction of E must move a state, one is zero")
    known = as_setting(sensor)
    if known is None or known.shape not in ((), (p,)) or not (known >= 0.0).all():
        raise ValueError(f"sensor must be half-widths, a number or shape ({p},), got {shown(sensor)}")
    names = {"states": [f"x{i + 1}" for i in range(n)], "inputs": [f"u{i + 1}" for i in range(m)]}
    for each, default in names.items():
        names[each] = [*as_names([*(labels or {}).get(each, ())], tuple(default), f"names of {each}")]
    record = _Record(model, E, u, pushed, y)
    phi = np.broadcast_to(known, p).copy()
    explaining = record.explaining(phi, weights)
    upper, found, noise = record.upper(phi)
    lower = np.minimum(record.lower(phi), upper)
    half = len(found) // 2
    may_leave = np.abs(found[half:]) > (1.0 + _PRECISION) * np.abs(found[:half]).max(axis=0)
    one = np.linalg.pinv(H) if record.window == 1 else np.full((n, p), np.inf)
    directions = names["states"] if is_identity else [f"E{i + 1}" for i in range(E.shape[1])]
    measured = of_outputs(H, names["states"])
    signals = [*measured, *names["inputs"]]
    return RecordedBounds(
        E=E,
        directions=tuple(directions),
        outputs=tuple(measured),
        steps=len(u),
        window=record.window,
        lower=lower,
        explaining=explaining,
        upper=upper,
        sensor=phi,
        left=may_leave.mean(axis=0),
        grows=tuple(
            f"The disturbance {name} grows with |{signals[j]}|, by {change:.2g} times its mean (t = {t:.3g}): mend the "
            "model, since no bound of this record holds for larger ones."
            for name, (t, change, j) in zip(directions, record.growths(found, noise), strict=True)
            if t > _LEAST_T and change > _LEAST_GROWTH
        ),
        first_error=np.abs(one) @ phi if record.window == 1 else np.full(n, np.inf),
    )


class _Record:
    """A record, whose outputs over some steps are O x + (what inputs did) + S s + v.

    Attributes:
        u, y: Deviations, shapes (N, m) and (N + 1, p).
        pushed: What inputs add to each step, shape (N, n).
        index: Observability index nu.
        window: Number of steps of the windows that tell one disturbance, in their middle.
        read: Left inverse of O of nu samples, shape (n, nu p).
        y_unit, s_unit: Sizes of noise and of disturbances that explain the record alone, shapes (p,) and (q,).
    """

    def __init__(self, model: Model, E: np.ndarray, u: np.ndarray, pushed: Any, y: np.ndarray):
        self.model, self.E, self.u, self.pushed, self.y, n, p = model, E, u, pushed, y, len(model.A), len(model.H)
        self.index = nu = next((each for each in range(1, n + 1) if _rank(self.of_state(each - 1)) == n), 0)
        if not nu:
            raise ValueError("the model is not observable: its outputs never tell all states, measure another one")
        self.window = 1 if nu == 1 else 2 * (nu + _FURTHER) - 1
        least = self.window + FEWEST_WINDOWS - 1
        if len(u) < least:
            raise ValueError(f"the record is too short: it has {counted(len(u), 'step')}, {least} are needed")
        self.read = np.linalg.pinv(self.of_state(nu - 1))
        self.predict = np.hstack([-self.of_state(nu)[-p:] @ self.read, np.eye(p)])
        size = np.abs(self.windows(nu) @ self.predict.T).max(axis=0)
        self.y_unit = np.where(size > 0.0, size, 1.0)
        flat = np.tile(self.y_unit, self.window + 1)
        beside = _beside(self.of_state(self.window) / flat[:, None])
        of_one = beside @ (self.of_disturbance(self.window)[:, self.window // 2] / flat[:, None])
        largest = np.linalg.norm(self.windows(self.window) / flat @ beside.T, axis=1).max()
        self.s_unit = (largest or 1.0) / np.linalg.norm(of_one, axis=0)

    def of_state(self, steps: int) -> np.ndarray:
        """Returns what a state does to the outputs, O of shape ((steps + 1) p, n)."""
        return np.concatenate([self.model.H @ np.linalg.matrix_power(self.model.A, j) for j in range(steps + 1)])

    def of_disturbance(self, steps: int) -> np.ndarray:
        """Returns what s of each step does to the outputs, shape ((steps + 1) p, steps, q)."""
        p = len(self.model.H)
        later, found = self.of_state(steps) @ self.E, np.zeros(((steps + 1) * p, steps, self.E.shape[1]))
        for i in range(steps):
            found[(i + 1) * p :, i] = later[: (steps - i) * p]
        return found

    def windows(self, steps: int) -> np.ndarray:
        """Returns the outputs of windows without what inputs did, shape (windows, (steps + 1) p)."""
        count = len(self.u) - steps + 1
        seen, moved = [self.y[:count]], np.zeros((count, len(self.E)))
        for j in range(steps):
            moved = moved @ self.model.A.T + self.pushed[j : j + count]
            seen.append(self.y[j + 1 : j + 1 + count] - moved @ self.model.H.T)
        return np.hstack(seen)

    def explaining(self, phi: np.ndarray, weights: Any) -> np.ndarray:
        """Returns the half-widths of the smallest weighted sum, shape (q,)."""
        units = self.s_unit
        cost = 1.0 / units if weights is None else as_setting(weights)
        if cost is None or cost.shape != units.shape or not ((cost > 0.0) & (cost < np.inf)).all():
            raise ValueError(f"weights must be positive, shape {units.shape}, got {shown(weights)}")
        return units * self._least([*range(len(units))], cost * units / (cost * units).max(), phi)

    def lower(self, phi: np.ndarray) -> np.ndarray:
        """Returns the smallest half-width of each direction alone, the others free, shape (q,)."""
        starts = range(0, len(self.u) - self.index + 1, _PART)
        least = [
            max(self._least([i], np.ones(1), phi, slice(start, start + _PART))[0] for start in starts)
            for i in range(len(self.s_unit))
        ]
        return self.s_unit * np.maximum(np.array(least) - _PRECISION, 0.0)

    def _least(self, kept: list[int], cost: np.ndarray, phi: np.ndarray, part: slice = slice(None)) -> np.ndarray:
        """Returns the half-widths, in units, of the directions that are kept.

        Variables are v of each sample, s of each step, and the half-widths. The first nu samples of the part tell a
        state, if what is `beside` vanishes, and every further one is what the nu before it predict.
        """
        from scipy.optimize import linprog  # takes long to import
        from scipy.sparse import block_array, csr_array, eye_array, hstack, kron, vstack

        p, q, nu = len(self.y_unit), len(self.s_unit), self.index
        flat = np.tile(self.y_unit, nu + 1)
        data = self.windows(nu)[part] / flat
        N = len(data) + nu - 1
        predict = self.predict * flat / self.y_unit[:, None]
        beside = np.pad(_beside(self.of_state(nu - 1) / flat[:-p, None]), ((0, 0), (0, p)))
        through = (self.of_disturbance(nu) * self.s_unit / flat[:, None, None]).reshape(-1, nu * q)
        equal, told = [], []
        for seen, times in ((predict, len(data)), (beside, 1)):
            of_noise = _shifted(np.split(seen, nu + 1, axis=1), times, N + 1)
            equal.append(hstack([of_noise, _shifted(np.split(seen @ through, nu, axis=1), times, N)]))
            told.append((data[:times] @ seen.T).ravel())
        told, noises, count = np.concatenate(told), (N + 1) * p, len(kept)
        none = csr_array((N * count, noises))
        some, half = kron(eye_array(N), csr_array(np.eye(q)[kept])), kron(np.ones((N, 1)), eye_array(count))
        loudest = [(-each, each) for each in np.tile(phi / self.y_unit, N + 1).tolist()]
        program = {
            "c": np.concatenate([np.zeros(noises + N * q), cost]),
            "A_ub": block_array([[none, some, -half], [none, -some, -half]], format="csr"),
            "b_ub": np.zeros(2 * N * count),
            "A_eq": hstack([vstack(equal), csr_array((len(told), count))], format="csr"),
            "b_eq": told,
            "bounds": loudest + [(None, None)] * (N * q) + [(0.0, None)] * count,
        }
        for method in ("highs-ipm", "highs-ds"):
            found: Any = linprog(**program, method=method)
            if found.status == 0:
                return found.x[-count:]
            if found.status == 2:
                nothing = "no disturbance along E and no sensor noise within its half-widths explain the record"
                raise ValueError(f"{nothing}: give more directions or larger half-widths")
        raise ValueError(f"the linear program of the record was not solved, take another part of it: {found.message}")

    def upper(self, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns upper bounds, what combinations say of s in each window, and their shares of noise."""
        from scipy.optimize import linprog

        q, flat = len(self.s_unit), self.windows(self.window)
        rows = [[self._combination(i, phi, *each) for each in _MULTIPLES] for i in range(q)]
        noise_of, of_disturbance = np.tile(phi, self.window + 1), self.of_disturbance(self.window)
        unit, A_ub, b_ub = self.s_unit, [], []
        for i in range(q):
            for row in rows[i]:
                through = np.abs(np.tensordot(row, of_disturbance, 1))
                through[self.window // 2, i] = 0.0
                A_ub.append(np.eye(q)[i] - through.sum(axis=0) * unit / unit[i])
                b_ub.append((np.abs(flat @ row).max() + np.abs(row) @ noise_of) / unit[i])
        largest = [linprog(-np.eye(q)[i], A_ub=A_ub, b_ub=b_ub, method="highs") for i in range(q)]
        found = np.array([(1.0 + _PRECISION) * -each.fun if each.status == 0 else np.inf for each in largest])
        first = np.array([each[0] for each in rows])
        return unit * found, flat @ first.T, np.abs(first) @ noise_of

    def _combination(self, i: int, phi: np.ndarray, same: float, others: float) -> np.ndarray:
        """Returns l, in which the state cancels and s_i of the middle counts once, and noise and other s the least."""
        from scipy.optimize import linprog

        W, q = self.window, len(self.s_unit)
        noise = np.tile(np.maximum(phi, _PRECISION * self.y_unit), W + 1)
        weight = np.tile(np.where(np.arange(q) == i, same, others) * self.s_unit, W) / self.s_unit[i]
        own = W // 2 * q + i
        weight[own] = 0.0
        # l = z @ beside in units s_unit[i] / y_unit; with z come bounds of the sizes of l and of what it lets through.
        flat = np.tile(self.y_unit, W + 1)
        beside = _beside(self.of_state(W) / flat[:, None])
        through = (beside / flat @ self.of_disturbance(W).reshape(len(flat), -1)).T * self.s_unit[i]
        size = np.concatenate([beside.T, through])
        bounds = np.eye(len(size))
        found = linprog(
            np.concatenate([np.zeros(len(beside)), noise / flat, weight]),
            A_eq=[[*through[own], *np.zeros(len(size))]],
            b_eq=[1.0],
            A_ub=np.block([[size, -bounds], [-size, -bounds]]),
            b_ub=np.zeros(2 * len(size)),
            bounds=(None, None),
            method="highs",
        )
        if found.status != 0:
            raise ValueError(f"direction {i + 1} of E is not told by the outputs: {found.message}")
        z = found.x[: len(beside)]
        return z / (z @ through[own]) @ beside * self.s_unit[i] / flat

    def growths(self, found: np.ndarray, noise: np.ndarray) -> list[tuple[float, float, int]]:
        """Returns for each direction t, change and number of the output or input whose size it grows with the most."""
        seen = slice(self.window // 2, self.window // 2 + len(found))
        sizes = np.concatenate([np.abs(self.y[seen]), np.abs(self.u[seen])], axis=1)
        certain = np.maximum(np.abs(found) - noise, 0.0)
        return [max((*_slope(each, size), j) for j, size in enumerate(sizes.T)) for each in certain.T]


def _slope(values: np.ndarray, sizes: np.ndarray) -> tuple[float, float]:
    """Returns Student's t of the slope of values over sizes, and what that is over their range in means.

    Autocorrelated steps count as fewer independent ones (Bartlett).
    """
    a, b = values - values.mean(), sizes - sizes.mean()
    if not a.any() or not b.any():
        return 0.0, 0.0
    r = a @ b / np.sqrt((a @ a) * (b @ b))
    both = np.clip((a[1:] @ a[:-1]) * (b[1:] @ b[:-1]) / ((a @ a) * (b @ b)), 0.0, 1.0 - 1e-6)
    independent = len(a) * (1.0 - both) / (1.0 + both)
    t = r * np.sqrt(max(independent - 2.0, 0.0) / max(1.0 - r * r, 1e-12))
    return float(t), float(a @ b / (b @ b) * np.ptp(sizes) / values.mean())


def _rank(of_state: np.ndarray) -> int:
    return int(np.linalg.matrix_rank(of_state / np.maximum(np.abs(of_state).max(axis=0), 1e-300), rtol=_RANK_PRECISION))


def _shifted(blocks: list[np.ndarray], rows: int, columns: int) -> Any:
    """Returns the sparse matrix of block rows, each of which has these blocks one further to the right."""
    from scipy.sparse import csr_array, eye_array, kron

    return sum(kron(eye_array(rows, columns, k=j), csr_array(each)) for j, each in enumerate(blocks))


def _beside(of_state: np.ndarray) -> np.ndarray:
    """Returns orthonormal rows that no state moves."""
    return np.linalg.svd(of_state)[0][:, of_state.shape[1] :].T
