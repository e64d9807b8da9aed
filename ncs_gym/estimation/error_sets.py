"""Certified error sets: what the estimation error never leaves, with or without a promise from the channel."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Literal, Self, overload

import numpy as np

from ncs_gym.network.contract import ChannelContract
from ncs_gym.plants.hard_bounds import INFLATION, SIMULATED_REACH
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.uncertainty.shape_matrices import is_inside
from ncs_gym.validation import ReadOnlyArrays


class ErrorSetError(ValueError):
    """No error set could be computed accurately enough."""


# Of a condition: shapes (outer, inner, size), the outer one of which must hold the inner one, computed to `size`.
Need = tuple[np.ndarray, np.ndarray, np.ndarray]


class ErrorSet(ReadOnlyArrays, ABC):
    """The ellipsoids that the estimation error never leaves, by the age of the newest sample.

    Attributes:
        contract: The promise of the channel that they rest on; None for none.
        Sigma: Shape of the set of the largest age promised, (n, n) [squares of the units of the state].
        rate: The rate of the largest age promised, in (0, 1).
        shapes: Of all of them, shape (s, n, n).
        promised: Of the ages that are promised, shape (k, n, n): whatever an input is decided from lies in one of them.
        rates: lam of each of these, shape (k,): it carries the set of one age into that of the next.
        gains: Those that lead from every age above 0 back into the set of age 0, shape (s - 1, n, p).
    """

    contract: ChannelContract | None
    Sigma: np.ndarray
    rate: float
    shapes: np.ndarray
    promised: np.ndarray
    rates: np.ndarray
    gains: np.ndarray

    @property
    def oldest(self) -> int:
        """Age of the last set: no older sample makes a difference."""
        return len(self.shapes) - 1

    @overload
    def shape_at(self, age: Literal[0]) -> np.ndarray: ...

    @overload
    def shape_at(self, age: int) -> np.ndarray | None: ...

    @abstractmethod
    def shape_at(self, age: int) -> np.ndarray | None:
        """Returns the certified shape, (n, n), for a newest sample `age` steps old; None beyond the contract."""

    @abstractmethod
    def rate_at(self, age: int) -> float:
        """Returns the rate that carries the set of one age into that of the next."""

    @abstractmethod
    def remains_certified(self, certified: bool, age: int, predicted: np.ndarray) -> bool:
        """Returns whether an error is in the set of its age, and stays in those that follow, a step later.

        Args:
            certified: Whether it was.
            age: Of the newest sample before the step.
            predicted: Shape of the ellipsoid that holds the error after it, (n, n).
        """

    @abstractmethod
    def larger(self, factor: float) -> Self:
        """Returns them with every shape larger by a factor of at least 1; their conditions keep holding."""

    @abstractmethod
    def needs(self, plant: LinearPlant) -> dict[str, list[Need]]:
        """Returns what has to hold, by the name of the condition."""


@dataclass(frozen=True, eq=False, kw_only=True)
class InvariantErrorSet(ErrorSet):
    """One set for every age, of a stable plant: no packet has to arrive.

        (E0) Sigma >= r0^2 I
        (E1) Sigma >= A Sigma A'/rate + D/(1 - rate)

    Attributes:
        Sigma: Shape (n, n) [squares of the units of the state].
        rate: lam_e in (0, 1).
    """

    Sigma: np.ndarray
    rate: float

    def __post_init__(self) -> None:
        self._make_arrays_read_only()

    @property
    def contract(self) -> None:
        """None: nothing is promised."""

    @property
    def shapes(self) -> np.ndarray:
        """Sigma, shape (1, n, n)."""
        return self.Sigma[None]

    @property
    def promised(self) -> np.ndarray:
        """Sigma, shape (1, n, n)."""
        return self.shapes

    @property
    def rates(self) -> np.ndarray:
        """lam_e, shape (1,)."""
        return np.array([self.rate])

    @property
    def gains(self) -> np.ndarray:
        """None: an update that would lead out of the set is left out."""
        return np.empty((0, 0, 0))

    def shape_at(self, age: int) -> np.ndarray:
        """Returns Sigma."""
        return self.Sigma

    def rate_at(self, age: int) -> float:
        """Returns lam_e."""
        return self.rate

    def remains_certified(self, certified: bool, age: int, predicted: np.ndarray) -> bool:
        """Returns whether it lies inside, where it stays, by (E1)."""
        return certified or is_inside(predicted, self.Sigma)

    def larger(self, factor: float) -> Self:
        """Returns it with a larger Sigma."""
        return replace(self, Sigma=factor * self.Sigma)

    def needs(self, plant: LinearPlant) -> dict[str, list[Need]]:
        """Returns what (E0) and (E1) ask for."""
        identity, Sigma, rate = np.eye(plant.n), self.Sigma, self.rate
        first = congruence_sum((identity, plant.initial_error.shape_matrix, 1.0))
        grown = congruence_sum(
            (plant.A, Sigma, 1.0 / rate), (identity, plant.disturbance.shape_matrix, 1.0 / (1.0 - rate))
        )
        return {"(E0)": [(Sigma, *first)], "(E1)": [(Sigma, *grown)]}


@dataclass(frozen=True, eq=False, kw_only=True)
class ErrorSetsByAge(ErrorSet):
    """E(Sigma_0) .. E(Sigma_{h+1}), h the contract's largest age (docs/shield_proof.md, "Channel contracts").

        (C0) Sigma_0 >= r0^2 I
        (C1) Sigma_{j+1} >= A Sigma_j A'/lam_j + D/(1-lam_j)                             j = 0..h
        (C2) Sigma_0 >= (I-T_j H) Sigma_j (I-T_j H)'/mu_j + T_j N T_j'/(1-mu_j)          j = 1..h+1

    (C2) holds with room for the rounding of an estimate that is updated (docs/shield_proof.md, "Rounding").

    Attributes:
        contract: The promise they rest on.
        shapes: Sigma_j, shape (h+2, n, n).
        rates: lam_j, shape (h+1,).
        gains: T_1 .. T_{h+1}, shape (h+1, n, p).
        multipliers: mu_1 .. mu_{h+1}, shape (h+1,).
        noise: N of the contract's quantizer, shape (p, p).
    """

    contract: ChannelContract
    shapes: np.ndarray
    rates: np.ndarray
    gains: np.ndarray
    multipliers: np.ndarray
    noise: np.ndarray

    def __post_init__(self) -> None:
        self._make_arrays_read_only()

    @property
    def promised(self) -> np.ndarray:
        """Sigma_0 .. Sigma_h, shape (h+1, n, n)."""
        return self.shapes[:-1]

    @property
    def Sigma(self) -> np.ndarray:
        """Sigma_h, shape (n, n)."""
        return self.shapes[-2]

    @property
    def rate(self) -> float:
        """lam_h."""
        return float(self.rates[-1])

    def shape_at(self, age: int) -> np.ndarray | None:
        """Returns Sigma_age, shape (n, n); None beyond Sigma_{h+1}."""
        return self.shapes[age] if age < len(self.shapes) else None

    def rate_at(self, age: int) -> float:
        """Returns lam_age."""
        return float(self.rates[age])

    def remains_certified(self, certified: bool, age: int, predicted: np.ndarray) -> bool:
        """Returns whether (C1) leads on from the set of its age."""
        return certified and age < self.oldest

    def larger(self, factor: float) -> Self:
        """Returns them with larger shapes; gains and multipliers stay."""
        return replace(self, shapes=factor * self.shapes)

    def needs(self, plant: LinearPlant) -> dict[str, list[Need]]:
        """Returns what (C0) to (C2) ask for; in (C2) with the rounding of the estimate that is updated with T_j."""
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
        return {
            "(C0)": [(self.shapes[0], *first)],
            "(C1)": [(self.shapes[j + 1], *inner) for j, inner in enumerate(grown)],
            "(C2)": [(self.shapes[0], *inner) for inner in updated],
        }

    def rounding_of_update(self, plant: LinearPlant, j: int) -> np.ndarray:
        """Returns F for an update with T_{j+1}, shape (n, n): at least the plant's `estimate_rounding`.

        With x_hat up to SIMULATED_REACH half-widths out, and a residual that an error in E(Sigma_{j+1}) and noise in
        E(N) leave, x_hat + T (y - H x_hat) is rounded by at most half of r (docs/shield_proof.md, "What the room
        covers").
        """
        gain, H, reach = np.abs(self.gains[j]), np.abs(plant.H), SIMULATED_REACH * plant.half_widths
        residual = H @ np.sqrt(self.shapes[j + 1].diagonal()) + np.sqrt(self.noise.diagonal())
        r = np.finfo(float).eps * (plant.n * gain @ (H @ reach) + (plant.p + 1) * gain @ residual + reach)
        room = 2.0 * plant.n / (INFLATION - 1.0) * r**2
        return np.diag(np.maximum(room, plant.estimate_rounding.diagonal()))


def congruence_sum(*terms: tuple[np.ndarray, np.ndarray, float]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the sum of w F P F' over terms (F, P, w), and that of w |F| |P| |F|', with which its rounding grows."""
    total = sum(weight * factor @ shape @ factor.T for factor, shape, weight in terms)
    size = sum(weight * np.abs(factor) @ np.abs(shape) @ np.abs(factor).T for factor, shape, weight in terms)
    return np.asarray(total), np.asarray(size)
