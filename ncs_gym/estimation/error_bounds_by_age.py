"""Finds error sets by age: how far an estimate may be off when its newest sample is j steps old."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ncs_gym import exact
from ncs_gym.estimation.error_sets import ErrorSet, ErrorSetError, congruence_sum
from ncs_gym.network.contract import ChannelContract
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.plants.lqr import regulator_gain
from ncs_gym.uncertainty.ellipsoid import SMALLEST_MULTIPLIER, is_inside, joined, outer_sum, rounded_up

# Digits of sets, relative to their extents, of gains and of rates: what differs between processors is cut off.
DIGITS = 10
# The sets are made for noise this much larger than allowed, so that at run time good gains nearly always fit in.
NOISE_MARGIN = 1.2
# Strict inequalities at the end.
MARGIN = 1.0 + 1e-7
# Growth per iteration; it doubles now and then, which ends cycles between multipliers that are equally good.
SMALLEST_GROWTH, DOUBLING = 1e-6, 50.0
# Multipliers mu that gains are chosen from: fine sensors want it close to 1.
MULTIPLIERS = np.round(np.concatenate([np.linspace(0.01, 0.99, 99), 1.0 - np.logspace(-2.1, -4.0, 20)]), 12)
ITERATIONS = 1000
# No set is thinner than this in any direction, in units of the weight: an input under way is known exactly.
THINNEST = 1e-5
# The regulator whose answer to an error counts, in units of the box and of the input limits, and how much it counts.
EFFORT, ANSWER = 10.0, 10.0
# Digits of that regulator.
REGULATOR_DIGITS = 6
# Sets this much larger than the safe box are of no use.
LARGEST = 1e6


def error_sets_by_age(plant: LinearPlant, contract: ChannelContract) -> ErrorSet:
    """Returns error sets by age; raises ErrorSetError if the iteration finds none that float64 can hold."""
    with np.errstate(all="ignore"):
        try:
            return _iterated_sets(plant, contract)
        except np.linalg.LinAlgError:
            raise ErrorSetError("the numbers of the sets are out of reach of float64") from None


def in_round_numbers(sets: ErrorSet) -> ErrorSet:
    """Returns the sets, a little larger, in numbers that hardly depend on the processor; they are to be checked."""
    units = 10.0 ** np.floor(0.5 * np.log10(np.maximum(np.diag(sets.noise), 1e-300)))  # of the outputs
    return replace(
        sets,
        shapes=np.stack([rounded_up(shape, DIGITS) for shape in sets.shapes]),
        rates=np.round(sets.rates, DIGITS),
        gains=np.stack([exact.rounded(gain * units, DIGITS, axis=1) / units for gain in sets.gains]),
    )


def _iterated_sets(plant: LinearPlant, contract: ChannelContract) -> ErrorSet:
    """Returns error sets by age.

    From Sigma_0 = r0^2 I: carry it through the longest gap, update after every possible gap with the set-membership
    gain, and let Sigma_0 be the smallest ellipsoid around the results that pairwise joins give; until it holds what
    comes of it, which is (C0), (C1) and (C2). Shares minimize traces weighted with what errors cost.
    """
    # Coordinates z = T^-1 x with W = (T T')^-1, so that units do not matter.
    inverse = np.linalg.cholesky(_cost(plant)).T
    T = np.linalg.inv(inverse)
    A, H = inverse @ plant.A @ T, plant.H @ T
    D = inverse @ plant.disturbance.shape_matrix @ inverse.T
    D = D + 1e-9 * float(np.trace(D)) / plant.n * np.eye(plant.n)
    first = inverse @ plant.initial_error.shape_matrix @ inverse.T + THINNEST**2 * np.eye(plant.n)
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
    traces = (sizes / (MULTIPLIERS[:, None] + (1.0 - MULTIPLIERS[:, None]) * gains)).sum(axis=1)
    mu = float(MULTIPLIERS[int(np.argmin(traces))])
    spread = shape @ H.T / mu
    gain = np.linalg.solve(H @ spread + noise / (1.0 - mu), spread.T).T
    updated, _ = congruence_sum((np.eye(len(shape)) - gain @ H, shape, 1.0 / mu), (gain, noise, 1.0 / (1.0 - mu)))
    return gain, mu, _symmetric(updated)


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return 0.5 * (matrix + matrix.T)
