"""The step of the plant: what really moves, with disturbances, noise and sensors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ncs_gym.bounds import Bounds
from ncs_gym.disturbances import BY_NAME, ROUNDING, Disturbance, checked
from ncs_gym.ellipsoid import Ellipsoid
from ncs_gym.limits import acting
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes.process import FamilyProcess, LinearProcess, Process, own_process
from ncs_gym.validation import guarded, read_only

# Noise is drawn for about this many environment steps at once, for this many steps of one environment at most.
BLOCK_SIZE, LONGEST_BLOCK = 4096, 256


class BlockSampler:
    """Draws samples for many steps at once, and hands them out step by step.

    Args:
        draw: Returns `count` samples, shape (n, count), given a source of randomness and `count`.
        size: Number of environments, the last axis of what is handed out; None for one without that axis.
    """

    def __init__(self, draw: Callable[[np.random.Generator, int], np.ndarray], size: int | None) -> None:
        self._draw, self._size = draw, size
        self._count = LONGEST_BLOCK if size is None else min(max(BLOCK_SIZE // size, 1), LONGEST_BLOCK)
        self._left: list[np.ndarray] = []

    def next(self, rng: np.random.Generator) -> np.ndarray:
        """Returns samples of a step, shape (n,) or (n, size)."""
        if not self._left:
            samples = self._draw(rng, self._count * (self._size or 1))
            steps = samples.T if self._size is None else samples.reshape(len(samples), self._count, -1).swapaxes(0, 1)
            self._left = list(np.ascontiguousarray(steps))
        return self._left.pop()

    def forget(self) -> None:
        """Forgets what is left."""
        self._left = []


class PlantSimulation:
    """x+ = f(x, u) + d and y = H x + v, simulated; the last axis of every array is the environment.

    Beside a process other than the plant's own equations, d is within what the plant declares beside its remainder, or
    nothing if the process cannot be put into a state.

    Args:
        plant: The plant with its bounds, the certified model of what moves.
        disturbance: What acts on it; process noise is added unless it replaces that.
        allow_assumption_violation: Let disturbances outside the certified bound pass instead of raising.
        size: Number of environments; None for one without that axis.
        noise: One of `NOISES`.
        process: What moves; that of `own_process` by default.

    Attributes:
        plant: The plant whose noise and disturbances are drawn: without the remainder beside another process.
        alarm: Whether x+ - A x - B u lay outside E(D) in a step of this episode; shape (N,) for many environments.

    Raises:
        ValueError: If the process does not fit the plant, or a disturbance of the user's cannot act on it.
    """

    def __init__(
        self,
        plant: LinearPlant,
        disturbance: Disturbance,
        allow_assumption_violation: bool,
        size: int | None = None,
        *,
        noise: str = "truncated",
        process: Process | None = None,
    ) -> None:
        given = own_process(plant) if process is None else process
        # The plant's own equations move all states; any other process has its past inputs kept beside it.
        self._is_linear, moves_all = isinstance(given, LinearProcess), isinstance(given, LinearProcess | FamilyProcess)
        self._moved = plant if moves_all or not plant.past else _without_past_inputs(plant)
        self.process = given.opened(self._moved, size)
        self._acting = None if self._moved is plant else acting(plant.model.delays, plant.past)
        self.plant, self._model = plant if self._is_linear else without_remainder(plant), plant
        self.disturbance, self.size = disturbance, size
        self._truncated, self._is_extreme = noise != "gaussian", noise == "extreme"
        self._allow = allow_assumption_violation
        self._limit = plant.state_limit if np.isfinite(plant.state_limit).all() else None
        if size is not None and self._limit is not None:
            self._limit = self._limit[:, None]
        self._is_drawn_ahead = disturbance.memoryless and disturbance.vectorized
        self._trusted = type(disturbance) in BY_NAME.values()  # those lie in E(D) by construction
        self._may_leave = allow_assumption_violation and not self._trusted
        if not self._trusted and not self.process.is_written:
            raise ValueError("a disturbance of your own can act only on a process with write_state: give it one")
        acts = not self._trusted or bool(np.any(self.plant.nominal_disturbance.shape_matrix))
        self._is_disturbed = self.process.is_written and acts
        self.sensor_noise = BlockSampler(self._draw_sensor_noise, size)
        self.process_noise = BlockSampler(self._draw_process_noise, size)
        self.alarm: Any = False if size is None else np.zeros(size, np.bool_)

    def read_parameters(self, given: Any) -> np.ndarray | None:
        """Returns what `Process.read_parameters` does, anywhere if assumptions may be violated."""
        return self.process.read_parameters(given, anywhere=self._allow)

    def _draw_process_noise(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Returns process noise, with the disturbance where that depends on chance alone, shape (n, count)."""
        plant, source = self.plant, self.disturbance
        noise = np.zeros((plant.n, count))
        if not source.replaces_process_noise:
            noise = plant.process_noise.sample(rng, count, truncated=self._truncated).T
        if not self._is_drawn_ahead:
            return noise
        d = source.draw(rng, plant, noise if self._trusted else noise.copy(), None, None)
        fits = self._trusted or np.shape(d) == noise.shape  # another shape could be broadcast; the check refuses it
        return self._sum(d, noise if fits else None, count)

    def _sum(self, d: Any, noise: np.ndarray | None, count: int | None) -> np.ndarray:
        """Returns disturbance plus process noise, shape (n,) or (n, count), inside E(D) unless noise has no bound.

        What the disturbance may be is decided with the noise pulled back onto the ellipsoid of its truncation; what was
        pulled back is added afterwards. There is no noise where the disturbance replaces it.
        """
        if self._trusted:
            return d if noise is None else d + noise
        excess = None
        if noise is not None:
            inside = noise
            if not self._truncated:
                inside = noise / np.maximum(self.plant.process_noise.bound.gauge(noise.T), 1.0)
                excess = noise - inside
            d = d + inside
        total = checked(self.plant, d, count, allow_assumption_violation=self._allow)
        return total if excess is None else total + excess

    def _draw_sensor_noise(self, rng: np.random.Generator, count: int) -> np.ndarray:
        if self._is_extreme:
            return (1.0 - ROUNDING) * self.plant.nominal_sensor_error.sample_boundary(rng, count).T
        return self.plant.of_sensor.drawn(rng, count, truncated=self._truncated).T

    def first_error(self, rng: np.random.Generator, count: int | None = None) -> np.ndarray:
        """Returns the error of a first estimate, shape (n,), or of `count` of them, shape (n, count)."""
        if self._is_extreme:
            return (1.0 - ROUNDING) * self.plant.nominal_initial_error.sample_boundary(rng, count).T
        return self.plant.of_first_error.drawn(rng, count, truncated=self._truncated).T

    def forget(self) -> None:
        """Forgets noise drawn ahead, so that everything depends on a new seed alone."""
        self.sensor_noise.forget()
        self.process_noise.forget()

    def start(
        self, rng: np.random.Generator, state: np.ndarray, initial: Ellipsoid | None, fixed: np.ndarray | None = None
    ) -> tuple[np.ndarray, Ellipsoid | np.ndarray]:
        """Starts an episode; returns its first state, shape (n,), and what that is known to lie in, the set or itself.

        Args:
            rng: Source of randomness.
            state: Where it is to start, shape (n,).
            initial: The set that this was drawn from; None for a given state, which a process may refuse.
            fixed: What `read_parameters` returned; None to draw all parameters.
        """
        self._require_written(initial)
        self.process.choose(rng, None, fixed)
        started = self._of_moved(lambda x: self.process.start(rng, x, None), state)
        self.alarm = False
        if initial is not None and (started is state or initial.contains(started)):
            return started, initial
        return started, read_only(started)

    def start_many(
        self,
        rng: np.random.Generator,
        states: np.ndarray,
        initial: Ellipsoid | None,
        mask: np.ndarray,
        fixed: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Starts the k episodes that a mask, shape (size,), chooses.

        Returns:
            The first states, shape (n, k), and what is known of them, shape (k, n): a row of NaN for a state in the
            initial set, the state itself for another one.
        """
        self._require_written(initial)
        chosen = np.flatnonzero(mask)
        self.process.choose(rng, chosen, fixed)
        started = self._of_moved(lambda x: self.process.start(rng, x, chosen), states)
        self.alarm = self.alarm & ~mask
        known = started.T.copy()
        if initial is not None:
            known[... if started is states else initial.gauge(known) <= 1.0] = np.nan
        return started, known

    def _require_written(self, initial: Ellipsoid | None) -> None:
        if initial is None and not self.process.is_written:
            raise ValueError("this process cannot start at a given state: give its GymProcess write_state")

    def begin(self, rng: np.random.Generator, count: int | None = None) -> Any:
        """Returns what the disturbance keeps for an episode, or for `count` of them."""
        if count is None:
            return self.disturbance.begin(rng, self.plant)
        return self.disturbance.begin_many(rng, self.plant, count)

    def advance(self, rng: np.random.Generator, state: np.ndarray, u: np.ndarray, steps: Any, memory: Any) -> Any:
        """Returns the next state, shape (n,) or (n, size), given what `begin` returned and the steps of the episode.

        Raises:
            ValueError: If a disturbance lies outside its bound and that is not allowed, or the process cannot move.
        """
        nominal = self._model.A.dot(state) + self._model.B.dot(u)
        if self._is_linear:
            x_next = self._limited(nominal + self.draw_disturbance(rng, nominal, steps, memory))
            return self._watched(x_next, nominal) if self._may_leave else x_next
        step = self.process.step if self.size is None else self.process.step_many
        x, past = state[: self._moved.n], state[self._moved.n :]
        due = u if self._acting is None else np.concatenate([past, u])[self._acting]
        x_next = np.array(step(self._moved, guarded(x), due))  # which others may write over
        if len(past):
            x_next = np.concatenate([x_next, past[len(u) :], u])
        if self._is_disturbed:
            x_next = x_next + self.draw_disturbance(rng, x_next, steps, memory)
        if self.process.is_written:
            x_next = self._limited(x_next)
        if self._is_disturbed:
            x_next = self._of_moved(self.process.write, x_next)
        return self._watched(x_next, nominal)

    def _of_moved(self, change: Callable[[np.ndarray], np.ndarray], state: np.ndarray) -> np.ndarray:
        """Returns a state of which a process changes all but past inputs that are kept beside it."""
        n = self._moved.n
        return change(state) if len(state) == n else np.concatenate([change(state[:n]), state[n:]])

    def _watched(self, x_next: np.ndarray, nominal: np.ndarray) -> np.ndarray:
        """Returns x+, with the alarm where x+ - A x - B u lies outside E(D)."""
        gauge = self._model.disturbance.gauge((x_next - nominal).T)  # NaN where it overflows
        self.alarm = self.alarm | np.logical_not(gauge <= 1.0)
        return x_next

    def _limited(self, state: np.ndarray) -> np.ndarray:
        return state if self._limit is None else np.minimum(np.maximum(state, -self._limit), self._limit)

    def draw_disturbance(self, rng: np.random.Generator, nominal: np.ndarray, steps: Any, memory: Any) -> np.ndarray:
        """Returns process noise and disturbance, of the shape of A x + B u."""
        source = self.disturbance
        if self._is_drawn_ahead:
            return self.process_noise.next(rng)
        draw = source.draw if self.size is None else source.draw_many
        if not self._trusted:  # code of others may write into what it is given
            nominal, steps = nominal.copy(), steps if self.size is None else steps.copy()
        d = draw(rng, self.plant, nominal, steps, memory)
        return self._sum(d, None if source.replaces_process_noise else self.process_noise.next(rng), self.size)

    def close(self) -> None:
        """Closes what the process opened."""
        self.process.close()

    def measure(self, rng: np.random.Generator, state: np.ndarray) -> np.ndarray:
        """Returns y = H x + v, shape (p,) or (p, size)."""
        return self.plant.H.dot(state) + self.sensor_noise.next(rng)


def without_remainder(plant: LinearPlant) -> LinearPlant:
    """Returns the same plant without its remainder."""
    return replace(plant, bounds=replace(plant.bounds, disturbance=plant.bounds.disturbance.declared))


def _without_past_inputs(plant: LinearPlant) -> LinearPlant:
    """Returns the plant of the own states alone, of which nothing uncertain is declared."""
    point = plant.operating_state[: plant.n - plant.past], plant.operating_input
    model = replace(plant.model, at=point, offset=None, delays=0)
    limits = replace(plant.limits.absolute(plant.model), rate=None)
    return LinearPlant(model, limits, Bounds(disturbance=0.0, sensor=0.0, first_error=0.0), plant.labels)
