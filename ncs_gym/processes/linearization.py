"""The linear plant that models a process, with a bound on what it leaves out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ncs_gym import exact
from ncs_gym.bounds import Bounds, Box, Sum
from ncs_gym.ellipsoid import Ellipsoid, rounded_up
from ncs_gym.limits import Limits
from ncs_gym.model import Model
from ncs_gym.plants.family import Remainder
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes.process import FunctionProcess, LinearProcess, Process
from ncs_gym.validation import as_count, as_matrix, as_number, as_setting, counted, shown, warn_caller

# Fresh samples that check a bound, as a fraction of those that it was found with.
HELD_OUT = 0.25
# Room for the rounding of samples and of sums, relative to a bound.
ROUNDING = 1e-9
# Steps that are taken twice before a bound counts as proved.
REPEATED = 50
# Rounds of reweighting: the largest remainder settles to about a percent.
ROUNDS = 60
# The ellipsoid around the samples is at most this much larger than the smallest one, in squared radii.
EXCESS = 0.01
MOST_UPDATES = 10_000
# Directions in which less than this fraction of the largest extent is left out, mostly by rounding, get that much.
THINNEST = 1e-4
# No sample loses all of its weight.
SMALLEST_WEIGHT = 1e-9
# The operating point is no equilibrium if a step moves it by more, in half-widths of the box.
NO_EQUILIBRIUM = 1e-6
# Results keep this many digits, so that other machines find the same numbers.
DIGITS = 9


_NOTHING = Bounds(disturbance=0.0, sensor=0.0, first_error=0.0)


class _Region(NamedTuple):
    """Where the remainder is bounded: low <= (x, u) <= high in deviations, shape (n + m,)."""

    low: np.ndarray
    high: np.ndarray

    @property
    def half(self) -> np.ndarray:
        return 0.5 * (self.high - self.low)

    @classmethod
    def of(cls, frame: LinearPlant) -> _Region:
        """Returns the one of a plant's limits; raises ValueError if a state lacks an end."""
        low, high = np.concatenate([frame.own_limits, frame.input_ends], axis=1)
        if not np.isfinite(low + high).all():
            first = int(np.argmin(np.isfinite(low + high))) + 1
            raise ValueError(f"the remainder needs two finite limits of every state, if generous ones: state {first}")
        return cls(low, high)


class _Steps(NamedTuple):
    """Steps of a process: states (n, N) in the box, inputs (m, N) within their limits, next states (n, N)."""

    states: np.ndarray
    inputs: np.ndarray
    moved: np.ndarray


def linear_model(
    process: Process | Callable[[np.ndarray, np.ndarray], np.ndarray],
    limits: Limits,
    bounds: Bounds,
    dt: float,
    *,
    at: tuple[Any, Any] | None = None,
    H: Any = None,
    labels: Mapping[str, Any] | None = None,
    matrices: tuple[Any, Any] | None = None,
    jacobian_bounds: tuple[Any, Any] | None = None,
    samples: int = 20_000,
    safety_factor: float = 1.25,
    seed: int = 0,
) -> LinearPlant:
    """Returns x+ = A x + B u + r + d as a plant, r in a bound on what A x + B u leaves out within the limits.

    By sampling, A and B make the largest remainder of the samples small, and the smallest ellipsoid around these
    remainders, `safety_factor` times as large, is an *assumption*. From bounds on the Jacobian it is *proved* by the
    mean value theorem: A and B are the middle of the interval, and |r_i| <= |f_i(0, 0)| + sum_j (half-width of J_ij)
    (largest |z_j|), z = (x, u). Fresh samples confirm either. `plant.remainder` says how the bound is known.

    Args:
        process: What really moves, or a step function (x, u) -> x+; in deviations from the operating point, near which
            f(0, 0) = 0.
        limits: With two finite ends of every state.
        bounds: Of what is uncertain beside the remainder.
        dt: Duration of a step [s].
        at: As of a `Model`; it also says how many states and inputs there are, which otherwise the limits do.
        H: Output matrix, shape (p, n); the identity by default.
        labels: As of a `LinearPlant`.
        matrices: A and B, in place of fitted ones.
        jacobian_bounds: Smallest and largest values of [df/dx, df/du] within the limits, two arrays (n, n + m).
        samples: Number of steps that are sampled.
        safety_factor: Of a sampled bound, >= 1.
        seed: Seed of the samples.

    Warns:
        NoEquilibriumWarning: If a step from (0, 0) leads elsewhere, with how far.

    Raises:
        ValueError: If the remainder is too large for the box, fresh samples contradict the bound, a state lacks a
            limit, a disturbance moves the operating point, the process cannot be put into a state, or is no function of
            it where a proof is asked for, or an argument is wrong.
    """
    if isinstance(process, LinearProcess):
        raise ValueError("the linear process is its own model: give what really moves")
    moving = process if isinstance(process, Process) else FunctionProcess(process)
    if not isinstance(limits, Limits):
        raise ValueError(f"limits must be Limits, got {shown(limits)}")
    if limits.state is None:
        raise ValueError("the remainder is bounded over limits of every state: give Limits(state=...)")
    n, m = (_size_of(each, of) for each, of in zip((limits.state, limits.input), at or (None, None), strict=True))
    own = replace(limits, rate=None)
    frame = LinearPlant(Model(np.zeros((n, n)), np.zeros((n, m)), None, dt, at), own, _NOTHING)
    region = _Region.of(frame)
    if matrices is not None and jacobian_bounds is not None:
        raise ValueError("give matrices, or jacobian_bounds, whose middle they are")
    rng = np.random.default_rng(as_count(seed, "seed", low=0))
    drawn, fresh, origin, spread = _steps_of(moving, frame, region, as_count(samples, "samples", low=100), rng)
    widths = region.half[: frame.n]
    if jacobian_bounds is not None:
        if spread > ROUNDING:
            differ = f"steps from the same state with the same input differ by {spread:.3g} half-widths"
            raise ValueError(f"{differ}: bounds on a Jacobian prove nothing of noise, or of memory beyond the state")
        A, B, bound = _from_jacobians(jacobian_bounds, region, origin)
        basis = "from bounds on its Jacobian"
    else:
        A, B = fitted_matrices(*drawn, widths) if matrices is None else matrices
        A, B = as_matrix(A, (n, n), "A of matrices"), as_matrix(B, (n, m), "B of matrices")
        factor = as_number(safety_factor, "safety_factor", low=1.0)
        bound = Ellipsoid(factor**2 * surrounding_shape(_left_out(A, B, drawn), widths))
        basis = f"from {counted(samples, 'sample')} with safety factor {factor:g}"
    largest, count = _confirmed(bound, _left_out(A, B, fresh), widths), fresh.states.shape[1]
    basis = f"{basis}, with at most {largest:.0%} of the bound in {count:,} fresh samples"
    if (off := float((np.abs(origin) / widths).max())) > max(NO_EQUILIBRIUM, spread):
        moves = f"a step from (0, 0) moves it by {off:.3g} half-widths, which the remainder has to hold"
        warn_caller(f"the operating point is no equilibrium: {moves}", NoEquilibriumWarning)
    reached = np.sqrt(np.diag(bound.shape_matrix)) / widths
    if reached.max() >= 1.0:
        moves = f"moves state {reached.argmax() + 1} by {reached.max():.3g} half-widths in one step"
        raise ValueError(f"the remainder of the linear model alone {moves}: shrink the box, the input limits or dt")
    model = Model(A, B, H, dt, at)
    remainder = Remainder(bound, jacobian_bounds is not None, basis, None, LinearPlant(model, own, _NOTHING).region)
    return LinearPlant(model, limits, replace(bounds, disturbance=Sum((bounds.disturbance, remainder))), labels)


class NoEquilibriumWarning(UserWarning):
    """The point that deviations are counted from does not stay where it is."""


def _size_of(limits: Any, point: Any) -> int:
    numbers = as_setting(limits if point is None else point)
    if numbers is None:  # a number and a vector
        return max((np.size(end) for end in limits), default=1) if isinstance(limits, tuple) else 1
    if point is None and numbers.shape == (2,) and numbers[0] <= 0.0:  # ends of one, no half-widths of two
        return 1
    return numbers.shape[-1] if numbers.ndim else 1


def _steps_of(
    process: Process, frame: LinearPlant, region: _Region, count: int, rng: np.random.Generator
) -> tuple[_Steps, _Steps, np.ndarray, float]:
    """Returns `count` sampled steps, fewer fresh ones, f(0, 0), and by how many half-widths repeated steps differ."""
    moving = process.opened(frame, None)
    try:
        if not moving.is_written:
            raise ValueError("a linear model needs steps from chosen states: give GymProcess write_state")
        origin = _first_step(moving, frame)
        drawn = _sampled(moving, frame, region, count, rng)
        fresh = _sampled(moving, frame, region, max(int(HELD_OUT * count), 100), rng)
        again = _moved(moving, frame, drawn.states[:, :REPEATED], drawn.inputs[:, :REPEATED], rng)
        spread = float(np.max(np.abs(again - drawn.moved[:, :REPEATED]) / region.half[: frame.n, None]))
        return drawn, fresh, origin, spread
    finally:
        moving.close()


def _first_step(moving: Process, frame: LinearPlant) -> np.ndarray:
    n, m = frame.n, frame.m
    try:
        return moving.step(frame, moving.write(np.zeros(n)), np.zeros(m))
    except (IndexError, TypeError, ValueError) as error:
        sizes = f"{counted(n, 'state')} and {counted(m, 'input')}, the sizes of limits and at"
        raise ValueError(f"the process cannot move with {sizes}: {error}") from error


def _sampled(moving: Process, frame: LinearPlant, region: _Region, count: int, rng: np.random.Generator) -> _Steps:
    """Returns steps from random points of the region, half of them with coordinates on its boundary.

    Points that limits of several coordinates forbid are pulled towards zero onto their boundary.
    """
    low, high = (side[:, None] for side in region)
    points = rng.uniform(-1.0, 1.0, (len(low), count))
    at_end = rng.random(points.shape) < np.where(np.arange(count) % 2 == 0, 0.0, rng.random(count))
    inside = np.clip(0.5 * (low + high) + 0.5 * (high - low) * points, low, high)
    points = np.where(at_end, np.where(points < 0.0, low, high), inside)
    of_sums = np.count_nonzero(frame.box, axis=1) > 1
    states_alone = np.hstack([frame.box[of_sums], np.zeros((of_sums.sum(), frame.m))])
    values = np.concatenate([states_alone, frame.mixed_rows]) @ points
    ends = np.concatenate([frame.box_ends[:, of_sums], frame.mixed_ends], axis=1)[:, :, None]
    points = points / np.maximum(values / ends, 1.0).max(axis=(0, 1), initial=1.0)
    states, inputs = points[: frame.n], points[frame.n :]
    return _Steps(states, inputs, _moved(moving, frame, states, inputs, rng))


def _moved(
    moving: Process, frame: LinearPlant, states: np.ndarray, inputs: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    if moving.vectorized:
        return moving.step(frame, states, inputs)
    x_next = np.empty_like(states)
    for each in range(states.shape[1]):
        if moving.terminated or moving.truncated:
            moving.start(rng, states[:, each], None)
        x_next[:, each] = moving.step(frame, moving.write(states[:, each]), inputs[:, each])
    return x_next


def _left_out(A: np.ndarray, B: np.ndarray, steps: _Steps) -> np.ndarray:
    return (steps.moved - A @ steps.states - B @ steps.inputs).T


def _from_jacobians(
    bounds: tuple[Any, Any], region: _Region, origin: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Ellipsoid]:
    n, size = len(origin), len(region.low)
    if not isinstance(bounds, (tuple, list)) or len(bounds) != 2:
        raise ValueError(f"jacobian_bounds must be two arrays of shape ({n}, {size}), got {shown(bounds)}")
    low, high = (as_matrix(bound, (n, size), "jacobian_bounds") for bound in bounds)
    if (low > high).any():
        raise ValueError("jacobian_bounds must be the smallest values, then the largest")
    middle = 0.5 * (low + high)
    farthest = np.maximum(-region.low, region.high)
    sizes = np.abs(origin) + exact.product(np.maximum(high - middle, middle - low), farthest)
    sizes = np.where(sizes > 0.0, sizes * (1.0 + ROUNDING), 0.0)
    return middle[:, :n], middle[:, n:], Box(-sizes, sizes).ellipsoid()


def _confirmed(bound: Ellipsoid, remainders: np.ndarray, widths: np.ndarray) -> float:
    """Returns the largest size of fresh remainders, shape (N, n), in units of their bound: at most 1."""
    padded = Ellipsoid(bound.shape_matrix + np.diag((ROUNDING * widths) ** 2))
    largest = float(padded.gauge(remainders).max())
    if largest > 1.0:
        advice = "use more samples, a larger safety_factor, or correct the jacobian_bounds"
        raise ValueError(f"a fresh sample of the remainder is {largest:.3g} times as large as its bound: {advice}")
    return largest


def fitted_matrices(
    states: np.ndarray, inputs: np.ndarray, moved: np.ndarray, widths: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns A and B for which the largest remainder of the samples, in half-widths of the box, is nearly smallest.

    Lawson's algorithm: least squares again and again, each sample weighted with its remainders so far. The samples are
    states (n, N), inputs (m, N) and next states (n, N).
    """
    regressors = np.concatenate([states, inputs]).T
    units = np.maximum(np.abs(regressors).max(axis=0), np.finfo(float).tiny)
    regressors = regressors / units
    targets = (moved / widths[:, None]).T
    weights, best, smallest = np.ones(len(targets)), None, np.inf
    for _ in range(ROUNDS):
        root = np.sqrt(weights)[:, None]
        matrix = np.linalg.lstsq(root * regressors, root * targets, rcond=None)[0]
        sizes = np.linalg.norm(targets - regressors @ matrix, axis=1)
        if sizes.max() < smallest:
            best, smallest = matrix, sizes.max()
        weights = weights * (sizes + SMALLEST_WEIGHT * sizes.max() + np.finfo(float).tiny)
        weights /= weights.sum()
    if best is None:
        raise ValueError("the sampled steps are not finite: no linear model fits them")
    fitted = (np.round(best, DIGITS) * widths / units[:, None]).T
    return fitted[:, : len(states)], fitted[:, len(states) :]


def surrounding_shape(points: np.ndarray, widths: np.ndarray) -> np.ndarray:
    """Returns P of nearly the smallest ellipsoid E(P) around points, (N, n), in units of widths, and their negatives.

    Khachiyan's algorithm in the principal axes of the points; an axis without extent gets a little of it.
    """
    scaled = points / widths
    if not np.any(scaled):
        return np.zeros((len(widths), len(widths)))
    axes = np.linalg.svd(scaled, full_matrices=False)[2]
    coordinates = scaled @ axes.T
    extents = np.abs(coordinates).max(axis=0)
    extents = np.maximum(extents, THINNEST * extents.max())
    whitened = np.concatenate([coordinates / extents, np.eye(len(widths))])
    n, weights = len(widths), np.full(len(whitened), 1.0 / len(whitened))
    for _ in range(MOST_UPDATES):
        moments = whitened.T @ (weights[:, None] * whitened)
        sizes = np.einsum("ij,jk,ik->i", whitened, np.linalg.inv(moments), whitened)
        farthest = int(sizes.argmax())
        if sizes[farthest] <= n * (1.0 + EXCESS):
            break
        step = (sizes[farthest] / n - 1.0) / (sizes[farthest] - 1.0) if n > 1 else 1.0
        weights *= 1.0 - step
        weights[farthest] += step
    moments = whitened.T @ (weights[:, None] * whitened)
    sizes = np.einsum("ij,jk,ik->i", whitened, np.linalg.inv(moments), whitened)
    factor = widths[:, None] * axes.T * extents
    return rounded_up(sizes.max() * factor @ moments @ factor.T, DIGITS)
