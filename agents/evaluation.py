"""Evaluates a policy: plays episodes side by side and counts what happens to the true state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from agents.loop import LoopConfig
from agents.results import Episode, Evaluation, Trajectory
from ncs_gym import NCSVectorEnv
from ncs_gym.envs.env import ncs_env
from ncs_gym.envs.spaces import read_actions
from shields.polytope import Polytope

# The largest number of episodes that are played side by side.
_MAX_PARALLEL_EPISODES = 1000

# Keeps the random numbers of evaluations apart from those of training with the same seed.
_SEED_STREAM = 0xE7A1

# Maps raw observations, shape (N, entries), and infos, arrays with N as first axis, to actions, shape (N, m).
Policy = Callable[[np.ndarray, dict[str, Any]], np.ndarray]


def evaluate(
    loop: LoopConfig,
    policy: Policy,
    episodes: int,
    seed: int,
    safe_set: np.ndarray | Polytope | None = None,
    on_progress: Callable[[int], None] | None = None,
    shown: int = 0,
) -> Evaluation:
    """Returns what a policy does in a number of episodes, played side by side.

    Args:
        loop: The control loop, whose penalties are left out. Every episode is played once, to its end, whatever
            autoreset the loop has.
        policy: Maps observations and infos to actions.
        episodes: Number of episodes, at least 1.
        seed: Seed of all random numbers (see `Episode.index`).
        safe_set: M, shape (n, n), or a polytope, for `Episode.times_safe_set`.
        on_progress: Called with the number of steps taken since its last call.
        shown: Number of the episode whose trajectory is returned.

    Raises:
        ValueError: If there is no episode to play or to show, episodes have no limit of steps, or the id is registered
            with SAME_STEP autoreset.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}")
    if not 0 <= shown < episodes:
        raise ValueError(f"shown must be the number of one of {episodes} episodes, got {shown}")
    if loop.episode_steps is None:
        raise ValueError(f"{loop.env} has no max_episode_steps, without which an evaluation may not end: give some")
    alone = loop.without_penalties.with_kwargs(autoreset_mode=None)
    finished: list[Episode] = []
    trajectory: Trajectory | None = None
    for first in range(0, episodes, _MAX_PARALLEL_EPISODES):
        indices = range(first, min(first + _MAX_PARALLEL_EPISODES, episodes))
        played, path = _played(alone, policy, indices, seed, safe_set, on_progress, shown)
        trajectory = trajectory or path
        finished += played
    return Evaluation(loop, finished, trajectory)  # type: ignore[arg-type]


def _played(
    loop: LoopConfig,
    policy: Policy,
    indices: range,
    seed: int,
    safe_set: np.ndarray | Polytope | None,
    on_progress: Callable[[int], None] | None,
    shown: int,
) -> tuple[list[Episode], Trajectory | None]:
    """Returns episodes played side by side, and the trajectory of one, None if it is not among them."""
    count, envs = len(indices), loop.vector(len(indices))
    inner: Any = envs.unwrapped
    if envs.metadata.get("autoreset_mode") is AutoresetMode.SAME_STEP:
        raise ValueError(f"{loop.env} is registered with SAME_STEP autoreset, whose infos are of the next episode")
    single = inner.single if isinstance(inner, NCSVectorEnv) else ncs_env(inner.envs[0])
    terminates, plant = single.terminate_on_violation, single.plant
    if terminates and isinstance(inner, NCSVectorEnv):
        # Episodes that end early are stepped on without being counted: the others' random numbers stay the same.
        envs = loop.vector(count, terminate_on_violation=False)
    env_seed = int(np.random.SeedSequence([seed, indices[0], _SEED_STREAM]).generate_state(1)[0] >> 1)
    observations, info = envs.reset(seed=env_seed)
    infos, nothing = [info], np.zeros(count, np.bool_)
    running, ended, guaranteed = ~nothing, nothing, ~nothing
    returns, largest = np.zeros(count), np.full(count, np.nan if safe_set is None else 0.0)
    names = ("steps", "violation_steps", "estimate_violation_steps", "interventions", "planned", "proved")
    totals = {name: np.zeros(count, np.int64) for name in names}
    while True:
        guaranteed &= info.get("shield_guaranteed", nothing).astype(np.bool_) | ~running
        if safe_set is not None:
            largest = np.maximum(largest, np.where(running, _times(info["state"], safe_set), 0.0))
        running &= ~ended
        if not running.any():
            break
        actions = policy(observations, info)
        observations, rewards, terminated, truncated, info = envs.step(actions)
        if shown in indices and running[shown - indices[0]]:
            # Filters of others need not report what was proposed to them.
            infos.append({"input_proposed": read_actions(plant, actions, count)[1].T} | info)
        returns += np.where(running, rewards, 0.0)
        happened = {
            "steps": ~nothing,
            "violation_steps": info["cost"] > 0.0,
            "estimate_violation_steps": plant.constraint_values(_estimates(info).T).max(axis=0) > 0.0,
            "interventions": info.get("shield_intervened", nothing).astype(np.bool_),
            "planned": info.get("shield_plan_length", nothing) > 0,
            "proved": info.get("shield_guaranteed", nothing).astype(np.bool_),
        }
        for name, where in happened.items():
            totals[name] += running & where
        ended = terminated | truncated
        if terminates:
            ended |= info["cost"] > 0.0
        if on_progress is not None:
            on_progress(count)
    envs.close()
    episodes = [
        Episode(
            index=index,
            episode_return=float(returns[e]),
            guaranteed=bool(guaranteed[e]),
            times_safe_set=float(largest[e]),
            **{name: int(total[e]) for name, total in totals.items()},
        )
        for e, index in enumerate(indices)
    ]
    if shown not in indices:
        return episodes, None
    return episodes, _trajectory(infos, shown - indices[0], single.downlink_protocol.input_delay)


def _times(states: np.ndarray, of: np.ndarray | Polytope) -> np.ndarray:
    """Returns how many times a safe set holds states, shape (N, n): 1 on its boundary."""
    if isinstance(of, Polytope):
        return of.gauge(states)
    return np.sqrt(np.maximum(np.einsum("ei,ij,ej->e", states, of, states), 0.0))


def _estimates(info: dict[str, np.ndarray]) -> np.ndarray:
    """Returns the estimates of the present states, shape (N, n); `estimate` is that of when the next action acts."""
    return info["state"] + info["estimation_error"]


def _trajectory(infos: list[dict[str, np.ndarray]], e: int, input_delay: int) -> Trajectory:
    """Returns the trajectory of an environment, whose inputs are applied some steps after they are decided."""
    steps = infos[1:]
    not_shielded = np.zeros(e + 1, np.bool_)
    inputs = np.array([info["input"][e] for info in steps])
    proposed, intervened = inputs.copy(), np.zeros(len(steps), np.bool_)
    for step, info in enumerate(steps[: max(len(steps) - input_delay, 0)], input_delay):
        proposed[step] = info["input_proposed"][e]
        intervened[step] = info.get("shield_intervened", not_shielded)[e]
    return Trajectory(
        states=np.array([info["state"][e] for info in infos]),
        estimates=np.array([_estimates(info)[e] for info in infos]),
        inputs=inputs,
        proposed=proposed,
        intervened=intervened,
        arrivals=np.array([info["packet_arrived"][e] for info in steps], dtype=np.bool_),
        violated=np.array([info["cost"][e] > 0.0 for info in steps], dtype=np.bool_),
    )
