"""Certified error sets: what an estimation error never leaves, with or without a promise of the channel; finds them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ncs_gym import exact
from ncs_gym.ellipsoid import INFLATION, SMALLEST_MULTIPLIER, is_inside, joined, outer_sum, rounded_up
from ncs_gym.network.channel import ChannelContract
from ncs_gym.plants.linear_plant import SIMULATED_REACH, LinearPlant
from ncs_gym.plants.lqr import regulator_gain
from ncs_gym.validation import ReadOnlyArrays


class ErrorSetError(ValueError):
    """No error set could be computed accurately enough."""


# Of a condition: shapes (outer, inner, size), the outer one of which must hold the inner one, computed to `size`.
Need = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False, kw_only=True)
class ErrorSet(ReadOnlyArrays):
    """The ellipsoids E(Sigma_j) that the estimation error never leaves, by the age j of the newest sample.

    Of a stable plant without a contract that is one set for every age, and no packet has to arrive:

        (E0) Sigma >= X0
        (E1) Sigma >= A Sigma A'/lam + D/(1 - lam)

    Under a contract with the largest age h they are h + 2 (docs/shield_proof.md, "Channel contracts"):

        (C0) Sigma_0 >= X0
        (C1) Sigma_{j+1} >= A Sigma_j A'/lam_j + D/(1-lam_j)                             j = 0..h
        (C2) Sigma_0 >= (I-T_j H) Sigma_j (I-T_j H)'/mu_j + T_j N T_j'/(1-mu_j)          j = 1..h+1

    with room for the rounding of an estimate that is updated (docs/shield_proof.md, "Rounding").

    Attributes:
        shapes: Sigma_j, shape (h + 2, n, n), or (1, n, n) without a contract [squares of the units of the state].
        rates: lam_j in (0, 1), shape (h + 1,), or (1,): they carry the set of one age into that of the next.
        contract: The promise of the channel that they rest on; None for none.
        gains: T_1 .. T_{h+1} under a contract, shape (h + 1, n, p).
        multipliers: mu_1 .. mu_{h+1}, shape (h + 1,).
        noise: N of the contract's quantizer, shape (p, p).
    """

    shapes: np.ndarray
    rates: np.ndarray
    contract: ChannelContract | None = None
    gains: np.ndarray = field(default_factory=lambda: np.empty((0, 0, 0)))
    multipliers: np.ndarray = field(default_factory=lambda: np.empty(0))
    noise: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))

    def __post_init__(self) -> None:
        self._make_arrays_read_only()

    @property
    def oldest(self) -> int:
        """Age of the last set: no older sample makes a difference."""
        return len(self.shapes) - 1

    @property
    def promised(self) -> np.ndarray:
        """Those of promised ages, shape (k, n, n): the error at every decision lies in one of them."""
        return self.shapes[: len(self.rates)]

    @property
    def Sigma(self) -> np.ndarray:
        """That of the largest age that is promised, shape (n, n)."""
        return self.promised[-1]

    def shape_at(self, age: int) -> np.ndarray | None:
        """Returns the certified shape, (n, n), for a newest sample `age` steps old; None beyond the contract."""
        if self.contract is None:
            return self.shapes[0]
        return self.shapes[age] if age < len(self.shapes) else None

    def rate_at(self, age: int) -> float:
        """Returns the rate that carries the set of one age into that of the next."""
        return float(self.rates[0 if self.contract is None else age])

    def remains_certified(self, certified: bool, age: int, predicted: np.ndarray) -> bool:
        """Returns whether an error is certified a step later, by (E1) or (C1).

        Args:
            certified: Whether it was.
            age: Of the newest sample before the step.
            predicted: Shape of the ellipsoid that holds the error after it, (n, n).
        """
        if self.contract is None:
            return certified or is_inside(predicted, self.shapes[0])
        return certified and age < self.oldest

    def larger(self, factor: float) -> ErrorSet:
        """Returns them with every shape larger by a factor of at least 1; their conditions keep holding."""
        return replace(self, shapes=factor * self.shapes)

    def needs(self, plant: LinearPlant) -> dict[str, list[Need]]:
        """Returns what has to hold, by the name of the condition."""
        D, identity = plant.disturbance.shape_matrix, np.eye(plant.n)
        first = congruence_sum((identity, plant.initial_error.shape_matrix, 1.0))
        grown = [
            congruence_sum((plant.A, self.shapes[j], 1.0 / rate), (identity, D, 1.0 / (1.0 - rate)))
            for j, rate in enumerate(self.rates)
        ]
        kept = [identity - gain @ plant.H for gain in self.gains]
        updated = [
            congruence_sum(
                (kept[j], self.shapes[j + 1], INFLATION / self.multipliers[j]),
                (self.gains[j], self.noise, INFLATION / (1.0 - self.multipliers[j])),
                (identity, self.rounding_of_update(plant, j), 1.0),
            )
            for j in range(len(self.gains))
        ]
        letter = "E" if self.contract is None else "C"
        return {
            f"({letter}0)": [(self.shapes[0], *first)],
            f"({letter}1)": [(self.shapes[min(j + 1, self.oldest)], *inner) for j, inner in enumerate(grown)],
            f"({letter}2)": [(self.shapes[0], *inner) for inner in updated],
        }

    def rounding_of_update(self, plant: LinearPlant, j: int) -> np.ndarray:
        """Returns F for an update with T_{j+1}, shape (n, n): at least the plant's `estimate_rounding`.

        With x_hat up to SIMULATED_REACH half-widths out, and a residual of an error in E(Sigma_{j+1}) and noise in
        E(N), x_hat + T (y - H x_hat) is rounded by at most half of r (docs/shield_proof.md, "What the room covers").
        """
        gain, H, reach = np.abs(self.gains[j]), np.abs(plant.H), SIMULATED_REACH * plant.half_widths
        residual = H @ np.sqrt(self.shapes[j + 1].diagonal()) + np.sqrt(self.noise.diagonal())
        r = np.finfo(float).eps * (plant.n * gain @ (H @ reach) + (plant.p + 1) * gain @ residual + reach)
        room = 2.0 * plant.n / (INFLATION - 1.0) * r**2
        return np.diag(np.maximum(room, plant.estimate_rounding.diagonal()))


def congruence_sum(*terms: tuple[np.ndarray, np.ndarray, float]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the sum of w F P F' over terms (F, P, w), and of w |F| |P| |F|', with which its rounding grows."""
    total = sum(weight * factor @ shape @ factor.T for factor, shape, weight in terms)
    size = sum(weight * np.abs(factor) @ np.abs(shape) @ np.abs(factor).T for factor, shape, weight in terms)
    return np.asarray(total), np.asarray(size)


# Digits of sets, relative to their extents, of gains and of rates: what differs between processors is cut off.
AGE_DIGITS = 10
# The sets are made for noise this much larger than allowed, so that at run time good gains nearly always fit in.
NOISE_MARGIN = 1.2
# Strict inequalities at the end.
MARGIN = 1.0 + 1e-7
# Growth per iteration; it doubles now and then, which ends cycles between multipliers that are equally good.
SMALLEST_GROWTH, DOUBLING = 1e-6, 50.0
# Multipliers mu that gains are chosen from: fine sensors want it close to 1.
MULTIPLIERS_BY_AGE = np.round(np.concatenate([np.linspace(0.01, 0.99, 99), 1.0 - np.logspace(-2.1, -4.0, 20)]), 12)
ITERATIONS = 1000
# No set is thinner than this in any direction, in units of the weight: an input under way is known exactly.
THINNEST_BY_AGE = 1e-5
# The regulator whose answer to an error counts, in units of the box and of the input limits, and how much it counts.
EFFORT, ANSWER = 10.0, 10.0
# Digits of that regulator.
REGULATOR_DIGITS = 6
# Sets this much larger than the safe box are of no use.
LARGEST = 1e6


def _iterated_sets(plant: LinearPlant, contract: ChannelContract) -> ErrorSet:
    """Returns error sets by age.

    From Sigma_0 = X0: carry it through the longest gap, update after every possible gap with the set-membership
    gain, and let Sigma_0 be the smallest ellipsoid around the results that pairwise joins give; until it holds what
    comes of it, which is (C0), (C1) and (C2). Shares minimize traces weighted with what errors cost.
    """
    # Coordinates z = T^-1 x with W = (T T')^-1, so that units do not matter.
    inverse = np.linalg.cholesky(_cost(plant)).T
    T = np.linalg.inv(inverse)
    A, H = inverse @ plant.A @ T, plant.H @ T
    D = inverse @ plant.disturbance.shape_matrix @ inverse.T
    D = D + 1e-9 * float(np.trace(D)) / plant.n * np.eye(plant.n)
    first = inverse @ plant.initial_error.shape_matrix @ inverse.T + THINNEST_BY_AGE**2 * np.eye(plant.n)
    rounding = inverse @ plant.estimate_rounding @ inverse.T
    allowed = plant.sensor_error_with(contract.quantization_step).shape_matrix
    noise = NOISE_MARGIN * allowed + 1e-12 * np.diag(np.diag(H @ H.T)) * float(np.trace(D)) / plant.n
    start, steps = first, contract.max_age + 1
    for turn in range(ITERATIONS):
        shapes = _carried(start, A, D, steps)
        _require_bounded(shapes[-1], LARGEST**2, plant, T)
        updates = [_update(shape, H, noise) for shape in shapes[1:]]
        grown = first
        for _, _, shape in reversed(updates):
            grown = joined(grown, shape + rounding)
        _require_bounded(grown, LARGEST, plant, T)
        if is_inside(MARGIN * grown, start):
            break
        start = (1.0 + SMALLEST_GROWTH * 2.0 ** (turn / DOUBLING)) * grown
    else:
        raise ErrorSetError(f"the sets did not settle in {ITERATIONS} rounds")
    shapes = _carried(start, A, D, steps)
    gains, multipliers, _ = zip(*(_update(shape, H, noise) for shape in shapes[1:]), strict=True)
    return ErrorSet(
        contract=contract,
        shapes=np.stack([_symmetric(T @ shape @ T.T) for shape in shapes]),
        rates=np.array([_rate(shape, A, D) for shape in shapes[:-1]]),
        gains=np.stack([T @ gain for gain in gains]),
        multipliers=np.array(multipliers),
        noise=allowed,
    )


def _require_bounded(shape: np.ndarray, largest: float, plant: LinearPlant, T: np.ndarray) -> None:
    """Raises ErrorSetError, naming a state, unless a set of errors T z has a trace below the largest in z."""
    if not float(np.trace(shape)) < largest:
        sizes = np.diag(T @ shape @ T.T) / plant.half_widths**2
        state = plant.state_names[int(np.argmax(np.nan_to_num(sizes, nan=np.inf)))]
        raise ErrorSetError(f"the bound on the error of {state} outgrows the safe box by far")


def _cost(plant: LinearPlant) -> np.ndarray:
    """Returns W: the size of an error in the box, and that of a regulator's answer to it."""
    inverse = np.linalg.cholesky(plant.weight).T
    T = np.linalg.inv(inverse)
    K = regulator_gain(inverse @ plant.A @ T, inverse @ plant.B * plant.input_half, EFFORT, decay=1.0)
    if K is None:
        return plant.weight
    K = exact.rounded(K @ inverse, REGULATOR_DIGITS)
    return plant.weight + ANSWER * K.T @ K


def _carried(start: np.ndarray, A: np.ndarray, D: np.ndarray, steps: int) -> list[np.ndarray]:
    """Returns Sigma_0 .. Sigma_steps, each a little more than the trace-smallest ellipsoid the last one moves into."""
    shapes = [start]
    for _ in range(steps):
        shapes.append(MARGIN * _symmetric(outer_sum(A @ shapes[-1] @ A.T, D, np.eye(len(A)))))
    return shapes


def _rate(shape: np.ndarray, A: np.ndarray, D: np.ndarray) -> float:
    """Returns the lam of `_carried`."""
    a, b = np.sqrt(np.trace(A @ shape @ A.T)), np.sqrt(np.trace(D))
    return float(np.clip(a / (a + b), SMALLEST_MULTIPLIER, 1.0 - SMALLEST_MULTIPLIER))


def _update(shape: np.ndarray, H: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Returns the set-membership gain T, its multiplier mu and the updated shape, of the smallest trace."""
    values, vectors = np.linalg.eigh(shape)
    factor = vectors * np.sqrt(np.maximum(values, 0.0))
    seen = H @ factor
    gains, basis = np.linalg.eigh(seen.T @ np.linalg.solve(noise, seen))
    axes, gains = factor @ basis, np.maximum(gains, 0.0)
    sizes = (axes * axes).sum(axis=0)
    traces = (sizes / (MULTIPLIERS_BY_AGE[:, None] + (1.0 - MULTIPLIERS_BY_AGE[:, None]) * gains)).sum(axis=1)
    mu = float(MULTIPLIERS_BY_AGE[int(np.argmin(traces))])
    spread = shape @ H.T / mu
    gain = np.linalg.solve(H @ spread + noise / (1.0 - mu), spread.T).T
    updated, _ = congruence_sum((np.eye(len(shape)) - gain @ H, shape, 1.0 / mu), (gain, noise, 1.0 / (1.0 - mu)))
    return gain, mu, _symmetric(updated)


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return 0.5 * (matrix + matrix.T)


# Growth c of the optimal set: slack in (E1), and room for updates (docs/shield_proof.md).
GROWTH = 1.1
# Digits of a set relative to its extents, and of 1 - rate: what differs between processors beyond them is cut off.
DIGITS, RATE_DIGITS = 11, 4
# Beyond this many roundings of the largest entry a checked inequality is taken to hold.
ROUNDINGS = 100.0
# Smaller singular values, and distances from the unit circle, count as zero in the test of detectability.
UNDETECTABLE = 1e-8
# Flat disturbances are thickened by this fraction of their mean extent, so that (E1) has slack in every direction.
THICKENING = 1e-9
# No set is thinner than this, in half-widths of the safe box (a perfectly known plant has no error at all).
THINNEST = 1e-6


class UnstablePlantError(ValueError):
    """Without a promise from the channel no error bound exists for a plant that is not Schur stable."""


def certified_error_set(plant: LinearPlant, contract: ChannelContract | None = None) -> ErrorSet:
    """Returns the error set of a plant: of a stable one without a contract, of any under one.

    Raises:
        UnstablePlantError: If the plant is not Schur stable and there is no contract.
        ErrorSetError: If none is found, or the plant is too ill-conditioned to compute it.
    """
    key = plant.fingerprint, contract
    if key not in _known:
        found, rounded = _unconditional_set(plant) if contract is None else _conditional_set(plant, contract)
        require_error_set(found, plant)
        with suppress(ErrorSetError):
            require_error_set(rounded, plant)
            found = rounded
        _known[key] = found
    return _known[key]


_known: dict[tuple[str, ChannelContract | None], ErrorSet] = {}


def _conditional_set(plant: LinearPlant, contract: ChannelContract) -> tuple[ErrorSet, ErrorSet]:
    """Returns the sets, and others, a little larger, in numbers that hardly depend on the processor."""
    try:
        with np.errstate(all="ignore"):
            sets = _iterated_sets(plant, contract)
    except (ErrorSetError, np.linalg.LinAlgError) as error:
        if (unseen := unseen_state(plant.A, plant.H, plant.half_widths, plant.state_names)) is not None:
            raise ErrorSetError(
                f"no error set exists: the outputs do not show {unseen}, whose errors never decay"
            ) from None
        reason = error if isinstance(error, ErrorSetError) else "the numbers of the sets are out of reach of float64"
        raise ErrorSetError(
            f"no error set was found under a contract of max_age = {contract.max_age}: promise less age, or give finer "
            f"sensors, since {reason}"
        ) from None
    units = 10.0 ** np.floor(0.5 * np.log10(np.maximum(np.diag(sets.noise), 1e-300)))  # of the outputs
    return sets, replace(
        sets,
        shapes=np.stack([rounded_up(shape, AGE_DIGITS) for shape in sets.shapes]),
        rates=np.round(sets.rates, AGE_DIGITS),
        gains=np.stack([exact.rounded(gain * units, AGE_DIGITS, axis=1) / units for gain in sets.gains]),
    )


def unseen_state(A: np.ndarray, H: np.ndarray, widths: np.ndarray, names: Sequence[str]) -> str | None:
    """Returns the state with the largest part in a mode that neither decays nor shows in the outputs; None without one.

    The test of Popov, Belevitch and Hautus for detectability, states being in units of widths, (n,); of the transposed
    model it is that for stabilizability.
    """
    A, H = A * widths / widths[:, None], H * widths
    H = H / np.maximum(np.abs(H).max(axis=1, keepdims=True), np.finfo(float).tiny)
    for mode in np.linalg.eigvals(A):
        if abs(mode) >= 1.0 - UNDETECTABLE:
            _, shown, directions = np.linalg.svd(np.vstack([A - mode * np.eye(len(A)), H]))
            if shown[-1] <= UNDETECTABLE * shown[0]:
                return names[int(np.argmax(np.abs(directions[-1])))]
    return None


def require_error_set(error_set: ErrorSet, plant: LinearPlant) -> None:
    """Raises ErrorSetError, naming the condition, unless all of a set hold by more than the rounding of this check."""
    for name, triples in error_set.needs(plant).items():
        if not all(_holds(*triple) for triple in triples):
            raise ErrorSetError(
                f"no error set found: the plant is too ill-conditioned for {name} to hold in float64; give states "
                "units in which the half-widths of the box are of similar size"
            )


def _holds(outer: np.ndarray, inner: np.ndarray, size: np.ndarray) -> bool:
    """Returns whether outer - inner is positive definite by more than rounding, each state in units of the outer set.

    The rounding of the inner shape grows with `size`, entry by entry.
    """
    with np.errstate(all="ignore"):
        scale = 1.0 / np.sqrt(np.diag(outer))
        units = np.outer(scale, scale)
        gap, rounded = units * (outer - inner), units * (np.abs(outer) + size)
        if not (np.isfinite(gap).all() and np.isfinite(rounded).all()):
            return False
        return bool(np.linalg.eigvalsh(gap)[0] > ROUNDINGS * len(outer) * np.finfo(float).eps * rounded.max())


def _unconditional_set(plant: LinearPlant) -> tuple[ErrorSet, ErrorSet]:
    """Returns the error set of a stable plant in closed form (docs/shield_proof.md, (E0) and (E1)), and as above.

    For a fixed rate the smallest solution of (E1) is a Lyapunov series; where it does not cover the first estimate, the
    missing part is added as a source to the same series. The rate minimizes tr(W Sigma), W the weight of the safe box.
    """
    from scipy.optimize import minimize_scalar  # takes long to import

    radius = plant.spectral_radius
    if not radius < 1.0:
        raise UnstablePlantError(
            f"no error bound exists without packets: the spectral radius of A is {radius:.6g}, it must be < 1; give "
            "the estimator error_set=certified_error_set(plant, contract) with the channel's contract"
        )
    # In coordinates z = T^-1 x, with W = (T T')^-1, the weight is the identity and units do not matter.
    inverse, identity = np.linalg.cholesky(plant.weight).T, np.eye(plant.n)
    T = np.linalg.inv(inverse)
    A = inverse @ plant.A @ T
    D = inverse @ plant.disturbance.shape_matrix @ inverse.T
    D = D + THICKENING * float(np.trace(D)) / plant.n * identity
    first = inverse @ plant.initial_error.shape_matrix @ inverse.T + THINNEST**2 * identity

    def size(rate: float) -> float:
        return float(np.trace(_smallest_solution(A, D, first, rate)))

    slowest = max(radius**2, 1e-6)
    margin = 1e-4 * (1.0 - slowest)
    bounds, options = (slowest + margin, 1.0 - margin), {"xatol": margin}
    best: Any = minimize_scalar(size, bounds=bounds, method="bounded", options=options)
    rate = 1.0 - float(exact.rounded(1.0 - best.x, RATE_DIGITS))
    Sigma = T @ (GROWTH * _smallest_solution(A, D, first, rate)) @ T.T
    found = ErrorSet(shapes=0.5 * (Sigma + Sigma.T)[None], rates=np.array([rate]))
    return found, replace(found, shapes=rounded_up(found.Sigma, DIGITS)[None])


def _smallest_solution(A: np.ndarray, D: np.ndarray, first: np.ndarray, rate: float) -> np.ndarray:
    """Returns the Lyapunov solution of (E1) for one rate, enlarged to cover `first`; infinite where there is none."""
    try:
        solution = _lyapunov(A / np.sqrt(rate), D / (1.0 - rate))
        values, vectors = np.linalg.eigh(first - solution)
        if values[-1] > 0.0:
            missing = (vectors * np.maximum(values, 0.0)) @ vectors.T
            solution = solution + _lyapunov(A / np.sqrt(rate), missing)
    except np.linalg.LinAlgError:
        return np.full_like(A, np.inf)
    return 0.5 * (solution + solution.T)


def _lyapunov(A: np.ndarray, source: np.ndarray) -> np.ndarray:
    """Returns X = A X A' + source by the direct method (the other fails silently)."""
    from scipy.linalg import LinAlgWarning, solve_discrete_lyapunov  # takes long to import

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LinAlgWarning)
        return solve_discrete_lyapunov(A, source, method="direct")
