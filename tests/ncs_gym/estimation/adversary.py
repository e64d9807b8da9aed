"""Errors, disturbances, noise and traffic that do many estimators the most harm their assumptions allow."""

from __future__ import annotations

import numpy as np

from ncs_gym import Channel, ChannelContract, LinearPlant, certified_error_set
from ncs_gym.estimation.arrival_histories import histories_of
from ncs_gym.estimation.vector_estimator import VectorEstimator
from tests.ncs_gym.envs.same_draws import holding_gain

# Points on a boundary are pulled in by more than their rounding.
PULL = 1.0 - 1e-10
# The adversary aims this many steps ahead.
AIM = 12


def extreme_points(shape: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Boundary points of E(shape) that are the farthest in directions (n, N), shape (n, N)."""
    images = shape @ directions
    heights = np.sqrt(np.maximum((directions * images).sum(axis=0), 1e-300))
    return PULL * images / heights


class Traffic:
    """Decides which samples arrive: a few, many at once, late, in any order, or none for as long as is allowed.

    Args:
        channel: Its longest delay is the age of the oldest sample that can arrive.
        max_age: Of the contract; None without one.
        count: N.
    """

    def __init__(self, channel: Channel, max_age: int | None, count: int) -> None:
        self.oldest, self.max_age, self.count = channel.longest_delay, max_age, count
        self.received = np.zeros((self.oldest + 1, count), np.bool_)
        self.newest = np.zeros(count, np.int64)
        self.habits = np.zeros((self.oldest + 1, count))

    def arrivals(self, rng: np.random.Generator, step: int) -> list[tuple[int, np.ndarray]]:
        """Returns the ages of the samples that arrive at a step, oldest first, each with the environments (N,)."""
        if step % 25 == 1:  # new habits: how likely samples of each age are to come
            likely = rng.choice([0.0, 0.02, 0.2, 0.6], (1, self.count))
            self.habits = np.where(rng.random((self.oldest + 1, self.count)) < 0.5, likely, 0.02)
        ages = np.arange(self.oldest + 1)[:, None]
        self.received = np.concatenate([np.zeros((1, self.count), np.bool_), self.received[:-1]])
        self.newest += 1
        comes = (rng.random(self.received.shape) < self.habits) & ~self.received & (ages < step)
        if self.max_age is not None:
            newest = np.where(comes.any(axis=0), comes.argmax(axis=0), self.newest)
            due = np.flatnonzero(np.minimum(newest, self.newest) > self.max_age)
            # The contract would be broken: something must come, and as a rule it is as old as it may be.
            age = np.where(rng.random(due.size) < 0.6, self.max_age, rng.integers(0, self.max_age + 1, due.size))
            comes[age, due] = True
        self.received |= comes
        self.newest = np.where(comes.any(axis=0), np.minimum(comes.argmax(axis=0), self.newest), self.newest)
        return [(age, comes[age]) for age in range(self.oldest, -1, -1) if comes[age].any()]


class Attack:
    """N estimators under attack.

    Args:
        plant: The plant.
        channel: Gives the quantizer's error and the longest delay.
        contract: What the traffic keeps to; none if None.
        count: N.
        seed: Of everything.

    Attributes:
        many: The estimators.
        error: x_hat - x, shape (n, N).
        largest: The largest gauge of an error in its running ellipsoid so far.
        seen: Error shapes that occurred, as bytes of float64, each with its true age. (Numbers of statistics belong to
            a graph of histories, and there is a new one when it has grown large.)
    """

    def __init__(
        self, plant: LinearPlant, channel: Channel, contract: ChannelContract | None, count: int, seed: int
    ) -> None:
        self.plant, self.rng, self.count = plant, np.random.default_rng(seed), count
        self.error_set = certified_error_set(plant, contract)
        self.many = VectorEstimator(plant, histories_of(plant, channel, self.error_set), count)
        self.traffic = Traffic(channel, None if contract is None else contract.max_age, count)
        self.noise = plant.sensor_error_with(channel.quantization_step).shape_matrix
        self.axes = self._axes()
        self.error = extreme_points(plant.initial_error.shape_matrix, self.axes)
        self.many.begin(np.ones(count, np.bool_), self.error)
        self.state = np.zeros((plant.n, count))
        self.gain = plant.u_max[:, None] * holding_gain(plant)
        self.history: list[np.ndarray] = []
        self.step, self.largest = 0, 0.0
        self.seen: set[tuple[bytes, int]] = set()

    def _axes(self) -> np.ndarray:
        """Random directions in units of the box, shape (n, N)."""
        return self.rng.standard_normal((self.plant.n, self.count)) / self.plant.half_widths[:, None]

    def advance(self) -> None:
        """One step: the worst disturbance, input, the worst noise, arrivals."""
        plant, many = self.plant, self.many
        if self.step % AIM == 0:
            self.axes = self._axes()
        shapes = many.histories.table.shapes.take(many.statistics, axis=0)
        u = self.gain @ many.mean + 0.05 * self.rng.uniform(-1.0, 1.0, (plant.m, self.count)) * plant.u_max[:, None]
        # A third of the environments aims at a direction some steps ahead, the others push the error outwards.
        aims = np.arange(self.count) % 3 == 0
        ahead = np.linalg.matrix_power(plant.A.T, AIM - 1 - self.step % AIM) @ self.axes
        outwards = np.linalg.solve(shapes, (plant.A @ self.error).T[:, :, None])[:, :, 0].T
        d = -extreme_points(plant.disturbance.shape_matrix, np.where(aims, ahead, outwards))
        self.state = plant.A @ self.state + plant.B @ u + d
        e = plant.A @ self.error - d
        turn = np.where(np.arange(self.count) % 5 == 1, -1.0, 1.0)
        v = extreme_points(self.noise, turn * (plant.H @ np.where(aims, self.axes, e)))
        samples = plant.H @ self.state + v
        self.history = [samples, *self.history[: self.traffic.oldest]]
        self.step += 1
        many.advance(u, samples, self.traffic.arrivals(self.rng, self.step))
        self.error = many.mean - self.state
        self._check()

    def _check(self) -> None:
        many = self.many
        shapes = many.histories.table.shapes.take(many.statistics, axis=0)
        inward = np.linalg.solve(shapes, self.error.T[:, :, None])[:, :, 0].T
        self.largest = max(self.largest, float(np.sqrt((self.error * inward).sum(axis=0)).max()))
        assert self.largest <= 1.0
        assert not many.alarm.any()
        self.seen.update(zip((shape.tobytes() for shape in shapes), many.age.tolist(), strict=True))
