"""Certified error sets: what the estimation error never leaves, with or without a promise from the channel."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ncs_gym.network.contract import ChannelContract
from ncs_gym.plants.linear_plant import INFLATION, SIMULATED_REACH, LinearPlant
from ncs_gym.uncertainty.ellipsoid import is_inside
from ncs_gym.validation import ReadOnlyArrays


class ErrorSetError(ValueError):
    """No error set could be computed accurately enough."""


# Of a condition: shapes (outer, inner, size), the outer one of which must hold the inner one, computed to `size`.
Need = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False, kw_only=True)
class ErrorSet(ReadOnlyArrays):
    """The ellipsoids E(Sigma_j) that the estimation error never leaves, by the age j of the newest sample.

    Of a stable plant without a contract that is one set for every age, and no packet has to arrive:

        (E0) Sigma >= r0^2 I
        (E1) Sigma >= A Sigma A'/lam + D/(1 - lam)

    Under a contract with the largest age h they are h + 2 (docs/shield_proof.md, "Channel contracts"):

        (C0) Sigma_0 >= r0^2 I
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

    @property
    def rate(self) -> float:
        """The rate of the largest age that is promised."""
        return float(self.rates[-1])

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
