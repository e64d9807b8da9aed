"""Plant, channel and what surrounds them as compiled loops know them: packed into two arrays, cheap to hand over."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ncs_gym.compiled import inner
from ncs_gym.envs.env import NCSEnv
from ncs_gym.law import NOTHING, Law, law_of_disturbance, law_of_noise
from ncs_gym.network.channel import GilbertElliott
from ncs_gym.tasks.task import Regulation


class System(NamedTuple):
    """The control loop as compiled code knows it.

    Attributes:
        A, B, H, C: Of the plant, shapes (n, n), (n, m), (p, n), (k, n).
        u_max: Shape (m,).
        disturbance, process, sensor: What nature draws.
        period, delay, jitter: Of the channel [steps].
        most_lost: In a row; -1 if any number.
        bursts: Whether the channel's chain moves.
        losses, moves: Of the good and the bad state, shape (2,).
        step: Of the quantizer.
        uniforms: How many uniform numbers the channel needs per step.
        most_age: Of the contract; -1 without one.
        limit: Steps of an episode; -1 if it has no end.
        terminates: Whether a violation ends an episode.
        low, high: Bounds of the estimate in observations, shape (n,).
        pays: Whether the reward is -(x'Qx + u'Ru).
        Q, R: Shapes (n, n), (m, m).
        slots: Of rings, longest delay + 1.
        farthest: Of the plant, shape (n,).
    """

    A: np.ndarray
    B: np.ndarray
    H: np.ndarray
    C: np.ndarray
    u_max: np.ndarray
    disturbance: Law
    process: Law
    sensor: Law
    period: int
    delay: int
    jitter: int
    most_lost: int
    bursts: bool
    losses: np.ndarray
    moves: np.ndarray
    step: float
    uniforms: int
    most_age: int
    limit: int
    terminates: bool
    low: np.ndarray
    high: np.ndarray
    pays: bool
    Q: np.ndarray
    R: np.ndarray
    slots: int
    farthest: np.ndarray


def system_of(env: NCSEnv, max_episode_steps: int | None) -> System:
    """Returns the loop of a scalar environment."""
    plant, channel, task = env.plant, env.channel, env.task
    bursts, moves = isinstance(channel.loss, GilbertElliott), (0.0, 0.0)
    if isinstance(channel.loss, GilbertElliott):
        losses = channel.loss.loss_good, channel.loss.loss_bad
        moves = channel.loss.p_good_to_bad, channel.loss.p_bad_to_good
    else:
        losses = channel.loss, channel.loss
    drawn = law_of_disturbance(env.disturbance, plant)
    none = Law(NOTHING, np.zeros((plant.n, plant.n)))
    pays = type(task) is Regulation
    Q, R = task.costs(plant) if pays else (np.zeros((plant.n, plant.n)), np.zeros((plant.m, plant.m)))
    return System(
        A=plant.A,
        B=plant.B,
        H=plant.H,
        C=plant.C,
        u_max=plant.u_max,
        disturbance=none if drawn is None else drawn,
        process=none if env.disturbance.replaces_process_noise else law_of_noise(plant.process_noise),
        sensor=law_of_noise(plant.sensor_noise),
        period=channel.send_period,
        delay=channel.delay,
        jitter=channel.jitter,
        most_lost=-1 if channel.max_consecutive_losses is None else channel.max_consecutive_losses,
        bursts=bursts,
        losses=np.array(losses),
        moves=np.array(moves),
        step=channel.quantization_step,
        uniforms=3 if bursts else 2 if channel.jitter else 1 if max(losses) > 0.0 else 0,
        most_age=-1 if env.contract is None else env.contract.max_age,
        limit=-1 if max_episode_steps is None else max_episode_steps,
        terminates=env.terminate_on_violation,
        low=env.observation_space.low[: plant.n],
        high=env.observation_space.high[: plant.n],
        pays=pays,
        Q=Q,
        R=R,
        slots=channel.longest_delay + 1,
        farthest=plant.farthest,
    )


def packed(system: System) -> tuple[np.ndarray, np.ndarray]:
    """Returns the whole numbers and the others of a system, as `unpacked` wants them."""
    (n, m), (p, _), (k, _) = system.B.shape, system.H.shape, system.C.shape
    laws = system.disturbance, system.process, system.sensor
    counts = [n, m, p, k, *(law.kind for law in laws), system.period, system.delay, system.jitter, system.most_lost]
    counts += [system.bursts, system.uniforms, system.most_age, system.limit, system.terminates, system.pays]
    numbers = [system.A, system.B, system.H, system.C, system.u_max, *(law.factor for law in laws)]
    numbers += [system.losses, system.moves, system.low, system.high, system.Q, system.R, system.farthest]
    numbers += [np.array([*(law.energy for law in laws), system.step])]
    flat = np.concatenate([np.asarray(each, dtype=np.float64).ravel() for each in numbers])
    return np.array([*counts, system.slots], dtype=np.int64), flat


@inner
def _taken(numbers, start, rows, columns):
    """Returns a matrix and where the next begins."""
    end = start + rows * columns
    return numbers[start:end].reshape(rows, columns), end


@inner
def unpacked(counts, numbers):
    """Returns the `System` that was packed."""
    n, m, p, k = counts[0], counts[1], counts[2], counts[3]
    A, at = _taken(numbers, 0, n, n)
    B, at = _taken(numbers, at, n, m)
    H, at = _taken(numbers, at, p, n)
    C, at = _taken(numbers, at, k, n)
    u_max, at = _taken(numbers, at, 1, m)
    D, at = _taken(numbers, at, n, n)
    W, at = _taken(numbers, at, n, n)
    V, at = _taken(numbers, at, p, p)
    chain, at = _taken(numbers, at, 2, 2)
    bounds, at = _taken(numbers, at, 2, n)
    Q, at = _taken(numbers, at, n, n)
    R, at = _taken(numbers, at, m, m)
    farthest, at = _taken(numbers, at, 1, n)
    disturbance = Law(counts[4], D, numbers[at])
    process, sensor = Law(counts[5], W, numbers[at + 1]), Law(counts[6], V, numbers[at + 2])
    return System(
        A,
        B,
        H,
        C,
        u_max[0],
        disturbance,
        process,
        sensor,
        counts[7],
        counts[8],
        counts[9],
        counts[10],
        counts[11] != 0,
        chain[0],
        chain[1],
        numbers[at + 3],
        counts[12],
        counts[13],
        counts[14],
        counts[15] != 0,
        bounds[0],
        bounds[1],
        counts[16] != 0,
        Q,
        R,
        counts[17],
        farthest[0],
    )
