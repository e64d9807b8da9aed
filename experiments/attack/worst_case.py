"""Nature and agents that do harm within the assumptions."""

from __future__ import annotations

import itertools
from typing import Any, ClassVar

import numpy as np

from ncs_gym import AdversarialDisturbance, Disturbance, Ellipsoid, LinearPlant, NCSVectorEnv
from shields import Certificate

# Points on a boundary are pulled in by rounding.
INWARD = 1.0 - 1e-12
# Behind a downlink the first inputs of an episode are zero: starts on the boundary of S would leave it.
START_BEHIND_DOWNLINK = 0.3


def start_set(certificate: Certificate, downlink: Any) -> Ellipsoid:
    """Returns the set on whose boundary episodes start: S, behind a downlink a part of it."""
    return certificate.ellipsoid if downlink is None else Ellipsoid(START_BEHIND_DOWNLINK**2 * certificate.L)


def _push_out_of(certificate: Certificate) -> AdversarialDisturbance:
    """Returns the disturbance that takes the next state farthest out of the set that a shield keeps."""
    if certificate.polytope is None:
        return AdversarialDisturbance(certificate.M)
    return AdversarialDisturbance(rows=certificate.polytope.rows)


class _OnBoundary(NCSVectorEnv):
    """Episodes that start on the boundary of the initial set."""

    def _first(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns starts and first errors, shape (n, count) each."""
        states = self.single.initial_set.sample_boundary(self.np_random, count)
        return (1.0 - 1e-9) * states.T, self._process.first_error(self.np_random, count)


class WorstCaseVectorEnv(_OnBoundary):
    """Disturbances that push the next state farthest out of S; starts, first errors and sensor noise of full size.

    Args:
        num_envs: N.
        certificate: Certificate of the safe set S.
        pushes_to_box: Whether disturbances push towards the nearest face of the safe box instead.
        settings: Those of `NCSEnv` without disturbance and initial set.
    """

    def __init__(
        self, num_envs: int, certificate: Certificate, *, pushes_to_box: bool = False, **settings: Any
    ) -> None:
        push = AdversarialDisturbance() if pushes_to_box else _push_out_of(certificate)
        initial_set = start_set(certificate, settings.get("downlink"))
        super().__init__(num_envs, disturbance=push, initial_set=initial_set, noise="extreme", **settings)


class BoundedPush(Disturbance):
    """What pushes the next state farthest out of S of all that is bounded by declaration; process noise is added.

    It is the worst point of the ball of squared radius gamma, plus the worst one of `disturbance_bound` after that.

    Args:
        M: Shape (n, n), of S.
    """

    vectorized: ClassVar[bool] = True

    def __init__(self, M: np.ndarray) -> None:
        self.M = M

    def draw(self, rng, plant, nominal_next, step, memory):  # noqa: D102
        d = np.zeros(nominal_next.shape)
        for bound in (Ellipsoid(plant.gamma * np.eye(plant.n)), plant.disturbance_bound):
            if bound is not None and np.any(bound.shape_matrix):
                d = d + INWARD * bound.farthest_point((nominal_next + d).T, self.M).T
        return d


class GaussianVectorEnv(_OnBoundary):
    """Gaussian noise without a bound, and the worst of what is bounded by declaration; starts on the boundary of S.

    Args:
        num_envs: N.
        certificate: Certificate of the safe set S.
        settings: Those of `NCSEnv` without disturbance, noise and initial set.
    """

    def __init__(self, num_envs: int, certificate: Certificate, **settings: Any) -> None:
        settings |= {"noise": "gaussian", "disturbance": BoundedPush(certificate.M)}
        super().__init__(num_envs, initial_set=start_set(certificate, settings.get("downlink")), **settings)


def starts_in_set(rng: np.random.Generator, certificate: Certificate, count: int) -> np.ndarray:
    """Returns starts on the boundary of the safe set, shape (count, n), pulled in by more than rounding."""
    center = certificate.resting_state
    return center + (1.0 - 1e-9) * (certificate.safe_set.sample_boundary(rng, count) - center)


def starts_in_box(rng: np.random.Generator, plant: LinearPlant, certificate: Certificate, count: int) -> np.ndarray:
    """Returns starts, shape (count, n): half on the boundary of the safe set, half drawn uniformly from the box.

    States whose ends are open are drawn within `half_widths`.
    """
    states, ends = starts_in_set(rng, certificate, count), plant.own_limits
    low, high = np.where(np.isfinite(ends), ends, [-plant.half_widths, plant.half_widths])
    chosen, missing = np.arange(count) % 2 == 1, np.arange(count) % 2 == 1
    while missing.any():
        states[missing] = rng.uniform(low, high, (int(missing.sum()), plant.n))
        missing = chosen & (plant.constraint_values(states.T).max(axis=0) > 0.0)
    return states


class HostileAgents:
    """Actions for N environments, a quarter each: random, outwards, the certified gain turned round, and bang-bang.

    Args:
        num_envs: N.
        plant: The plant.
        certificate: Whose set and gain they turn against.
        rng: Source of randomness.
    """

    def __init__(self, num_envs: int, plant: LinearPlant, certificate: Certificate, rng: np.random.Generator) -> None:
        self._rng = rng
        self._rest = certificate.resting_state
        self._outwards = (plant.B.T @ certificate.M @ plant.A).T
        self._turned = -1e3 * (certificate.K / plant.input_half[:, None]).T
        ends = [num_envs * quarter // 4 for quarter in range(5)]
        self._random, self._out, self._back, self._bang = (slice(*pair) for pair in itertools.pairwise(ends))
        self._actions = np.zeros((num_envs, plant.m), np.float32)
        self._signs = rng.choice([-1.0, 1.0], self._actions[self._bang].shape)

    def act(self, estimates: np.ndarray) -> np.ndarray:
        """Returns the actions, shape (N, m), for estimates (N, n); the array is used again."""
        actions, estimates = self._actions, estimates - self._rest
        actions[self._random] = self._rng.uniform(-1.0, 1.0, actions[self._random].shape)
        actions[self._out] = np.sign(estimates[self._out] @ self._outwards)
        actions[self._back] = np.clip(estimates[self._back] @ self._turned, -1.0, 1.0)
        actions[self._bang] = self._signs
        return actions


class HostileRequests:
    """Requests for N environments, by turns: never, at random, and where they are of little use, as the truth says.

    The last two ask where the true error is smaller than in half of the environments, and where the true state is far
    inside S.

    Args:
        num_envs: N.
        certificate: Of S.
        rng: Source of randomness.
    """

    def __init__(self, num_envs: int, certificate: Certificate, rng: np.random.Generator) -> None:
        self._rng, self._M = rng, certificate.M
        self._kinds = np.arange(num_envs) % 4

    def ask(self, info: dict[str, Any]) -> np.ndarray:
        """Returns where samples are asked for, shape (N,), after a step or reset that returned an info."""
        errors, levels = (
            np.einsum("ki,ij,kj->k", info[name], self._M, info[name]) for name in ("estimation_error", "state")
        )
        never, sometimes = np.zeros(len(levels), np.bool_), self._rng.random(len(levels)) < 0.3
        return np.choose(self._kinds, [never, sometimes, errors < np.median(errors), levels < 0.5])
