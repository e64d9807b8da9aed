"""Nature, a network and an agent that do the most harm the assumptions allow.

It takes numbers of plants and nothing else of the product, so that a mistake there is not made here, too. In all arrays
the environment is the last axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import expm

# Points on a boundary are pulled in by more than their rounding.
PULL = 1.0 - 1e-10
# Tactics change every so many steps; the error is aimed at a direction so many steps ahead.
PATIENCE, AIM = 25, 12
FINE = 100


def farthest(shape: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Boundary points of {z: z' shape^-1 z <= 1} that are the farthest in directions (n, N), shape (n, N)."""
    images = shape @ directions
    return PULL * images / np.sqrt(np.maximum((directions * images).sum(axis=0), 1e-300))


def inward(shapes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """shape^-1 z of points z (n, N), each with a shape of its own (N, n, n), or all with one (n, n)."""
    scales = np.sqrt(np.diagonal(shapes, axis1=-2, axis2=-1))
    alike = shapes / (scales[..., :, None] * scales[..., None, :])
    return (np.linalg.solve(alike, (points.T / scales)[..., None])[..., 0] / scales).T


def gauges(shapes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """sqrt(z' shape^-1 z), shape (N,): above 1 outside."""
    return np.sqrt((points * inward(shapes, points)).sum(axis=0))


@dataclass(frozen=True, eq=False)
class Ball:
    """The ellipsoid {x: x' shape^-1 x <= 1}."""

    shape: np.ndarray

    def gauges(self, points: np.ndarray) -> np.ndarray:
        return gauges(self.shape, points)

    def outward(self, points: np.ndarray) -> np.ndarray:
        """Normals of the boundary, shape (n, N)."""
        return inward(self.shape, points)

    def push(self, points: np.ndarray, D: np.ndarray) -> np.ndarray:
        """What of E(D) moves points farthest out, by ascent."""
        d = np.zeros_like(points)
        for _ in range(4):
            d = farthest(D, self.outward(points + d))
        return d


@dataclass(frozen=True, eq=False)
class Faces:
    """The polytope {x: |row x| <= 1 for all rows}."""

    rows: np.ndarray

    def gauges(self, points: np.ndarray) -> np.ndarray:
        return np.abs(self.rows @ points).max(axis=0)

    def outward(self, points: np.ndarray, reach: Any = 0.0) -> np.ndarray:
        """The normals of the nearest faces, those nearest after a push that reaches so far, shape (n, N)."""
        values = self.rows @ points
        worst = (np.abs(values) + np.reshape(reach, (-1, 1))).argmax(axis=0)
        return self.rows[worst].T * np.where(values[worst, np.arange(points.shape[1])] < 0.0, -1.0, 1.0)

    def push(self, points: np.ndarray, D: np.ndarray) -> np.ndarray:
        """What of E(D) moves points farthest out: along the row with the least room."""
        return farthest(D, self.outward(points, np.sqrt(np.einsum("ri,ij,rj->r", self.rows, D, self.rows))))


def region_of(safe_set: Any) -> Ball | Faces:
    """The safe set of a certificate as the adversary sees it; ends that differ it is given besides."""
    if not hasattr(safe_set, "rows"):
        return Ball(safe_set.shape_matrix)
    half = np.where(safe_set.low == -safe_set.high, safe_set.high, 1.0)
    return Faces(safe_set.rows / half[:, None])


def box_of(plant: Any) -> Faces:
    return Faces(plant.box)


def boundary(region: Ball | Faces, scale: np.ndarray, rng: np.random.Generator, count: int) -> np.ndarray:
    """Points of a region's boundary in random directions, which are spread by `scale`, shape (n, count)."""
    z = scale[:, None] * rng.standard_normal((len(scale), count))
    return (1.0 - 1e-9) * z / region.gauges(z)


class Between:
    """How far out of the box a step gets on a fine grid of times, under the disturbance that is worst at each time."""

    def __init__(self, plant: Any) -> None:
        assert (np.abs(plant.box_ends) == 1.0).all()
        G = np.pad(plant.model.continuous, ((0, plant.m), (0, 0)))
        times = plant.dt * np.arange(FINE + 1) / FINE
        self.rows = plant.box @ np.array([expm(G * tau)[: plant.n] for tau in times])
        D = plant.nominal_disturbance.shape_matrix
        self.reach = np.sqrt(np.einsum("ri,ij,rj->r", plant.box, D, plant.box))

    def gauges(self, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """Largest |c x(tau)| of steps from states (n, N) with inputs (m, N), shape (N,)."""
        return (np.abs(self.rows @ np.concatenate([states, inputs])) + self.reach[:, None]).max(axis=(0, 1))


class Adversary:
    """Chooses disturbances, sensor noise and proposals, by a tactic per environment that changes now and then.

    Args:
        plant: Its A, B, H, box, limits.
        certificate: Its safe set and gain, which the adversary may know, too.
        rng: Source of randomness.
        count: N.
    """

    def __init__(self, plant: Any, certificate: Any, rng: np.random.Generator, count: int) -> None:
        self.plant, self.certificate, self.rng, self.count = plant, certificate, rng, count
        self.safe, self.box, self.step = region_of(certificate.safe_set), box_of(plant), 0
        self.error, self.shapes = np.zeros((plant.n, count)), certificate.Sigma
        self.plan = np.empty((0, plant.m))
        self.axes = self._axes()

    def begin_step(self, error: np.ndarray, shapes: np.ndarray) -> None:
        """Learns the true error x_hat - x, (n, N), and the shapes it is claimed to lie in, (n, n) or (N, n, n)."""
        self.error, self.shapes, self.step = error, shapes, self.step + 1
        if self.step % AIM == 0:
            self.axes = self._axes()

    def tactic(self, many: int) -> np.ndarray:
        """Which of so many tactics each environment follows now, shape (N,)."""
        return (np.arange(self.count) + self.step // PATIENCE) % many

    def proposals(self, estimates: np.ndarray) -> np.ndarray:
        """Inputs, shape (m, N): outwards, anything, always the same, against the certified gain, to and fro."""
        plant, limits = self.plant, self.plant.largest_input[:, None]
        shape = limits * np.ones((1, self.count))
        away = self.safe.outward(plant.A @ estimates)
        outwards = np.where(plant.B.T @ away < 0.0, -limits, limits)
        return np.choose(
            self.tactic(5),
            [
                outwards,
                self.rng.uniform(-1.0, 1.0, shape.shape) * limits,
                shape if self.step // 8 % 2 else outwards,
                np.clip(-1e3 * (self.certificate.K @ estimates), -limits, limits),
                np.where(self.rng.random(shape.shape) < 0.5, outwards, -shape),
            ],
        )

    def disturbances(self, nominal: np.ndarray, D: np.ndarray) -> np.ndarray:
        """What of E(D) acts after nominal next states (n, N): out of S, out of the box, on the error, on the plan."""
        to_error, moved = self.axes, self.plant.A @ self.error
        ahead = np.linalg.matrix_power(self.plant.A.T, AIM - 1 - self.step % AIM) @ to_error
        choices = [
            self.safe.push(nominal, D),
            self.box.push(nominal, D),
            -farthest(D, inward(self.shapes, moved + 1e-12 * to_error)),
            -farthest(D, ahead),
            self._against_plan(nominal, D),
        ]
        return np.choose(self.tactic(len(choices)), choices)

    def noise(self, N: np.ndarray) -> np.ndarray:
        """Sensor noise on the boundary of E(N), shape (p, N): it hides errors, shows them twice, or is aimed."""
        H, moved = self.plant.H, self.plant.A @ self.error
        turn = np.where(np.arange(self.count) % 5 == 1, -1.0, 1.0)
        aims = self.tactic(5) == 3
        return farthest(N, turn * (H @ np.where(aims, self.axes, moved + 1e-12 * self.axes)))

    def _axes(self) -> np.ndarray:
        """Random directions in units of the box, shape (n, N)."""
        return self.rng.standard_normal((self.plant.n, self.count)) / self.plant.half_widths[:, None]

    def _against_plan(self, nominal: np.ndarray, D: np.ndarray) -> np.ndarray:
        """For the row and step of a plan under way with the least room; every other time for where the plan ends."""
        plant, center, power, spread = self.plant, nominal, np.eye(self.plant.n), 0.0
        if not len(self.plan):
            return self.box.push(nominal, D)
        least, best = np.inf, plant.box[0]
        for u in (None, *self.plan):
            if u is not None:
                center, power = plant.A @ center + plant.B @ u[:, None], plant.A @ power
            values, pulled = (plant.box @ center)[:, 0], plant.box @ power
            spread = spread + np.sqrt(np.einsum("ri,ij,rj->r", pulled, D, pulled))
            rooms = 1.0 - np.abs(values) - spread
            if (row := int(rooms.argmin())) >= 0 and rooms[row] < least:
                least, best = rooms[row], np.copysign(1.0, values[row]) * pulled[row]
        if self.rng.random() < 0.5:
            end = self.safe.outward(center)
            best = power.T @ end[:, 0]
        return farthest(D, np.tile(best[:, None], (1, self.count)))


class Traffic:
    """Decides which packets arrive: a few, many at once, late, in any order, or none for as long as is allowed.

    Args:
        oldest: Age of the oldest packet that can arrive.
        max_age: How old the newest one may become; None for any age.
        count: N.
    """

    def __init__(self, oldest: int, max_age: int | None, count: int) -> None:
        self.oldest, self.max_age, self.count = oldest, max_age, count
        self.received = np.zeros((oldest + 1, count), np.bool_)
        self.newest = np.zeros(count, np.int64)
        self.habits = np.zeros((oldest + 1, count))

    def arrivals(self, rng: np.random.Generator, step: int) -> list[tuple[int, np.ndarray]]:
        """The ages of the packets that arrive at a step 1, 2, ..., oldest first, each with the environments (N,)."""
        if step % PATIENCE == 1:  # new habits: how likely packets of each age are to come
            likely = rng.choice([0.0, 0.02, 0.2, 0.6], (1, self.count))
            self.habits = np.where(rng.random((self.oldest + 1, self.count)) < 0.5, likely, 0.02)
        ages = np.arange(self.oldest + 1)[:, None]
        self.received = np.concatenate([np.zeros((1, self.count), np.bool_), self.received[:-1]])
        self.newest += 1
        comes = (rng.random(self.received.shape) < self.habits) & ~self.received & (ages < step)
        if self.max_age is not None:
            newest = np.where(comes.any(axis=0), comes.argmax(axis=0), self.newest)
            due = np.flatnonzero(np.minimum(newest, self.newest) > self.max_age)
            # Something must come, and as a rule it is as old as it may be.
            most = min(self.max_age, self.oldest)
            age = np.where(rng.random(due.size) < 0.6, most, rng.integers(0, most + 1, due.size))
            comes[np.minimum(age, step - 1), due] = True
        self.received |= comes
        self.newest = np.where(comes.any(axis=0), np.minimum(comes.argmax(axis=0), self.newest), self.newest)
        return [(age, comes[age]) for age in range(self.oldest, -1, -1) if comes[age].any()]
