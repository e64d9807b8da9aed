"""Evaluates a policy: plays episodes side by side and counts what happens to the true state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from agents.loop import LoopConfig
from agents.results import Episode, Evaluation
from ncs_gym import Ellipsoid, NCSVectorEnv
from ncs_gym.envs.env import ncs_env
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
    safe_set: Ellipsoid | Polytope | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> Evaluation:
    """Returns what a policy does in a number of episodes, played side by side.

    Args:
        loop: The control loop, whose penalties are left out, and whose autoreset counts for nothing.
        policy: Maps observations and infos to actions.
        episodes: How many, at least 1.
        seed: Seed of all random numbers (see `Episode.index`).
        safe_set: For `Episode.times_safe_set`.
        on_progress: Called with the number of steps taken since its last call.

    Raises:
        ValueError: If there is no episode to play, episodes have no limit of steps, or the id is registered with
            SAME_STEP autoreset.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}")
    if loop.episode_steps is None:
        raise ValueError(f"{loop.env} has no max_episode_steps, without which an evaluation may not end: give some")
    alone = loop.without_penalties.with_kwargs(autoreset_mode=None)
    finished: list[Episode] = []
    for first in range(0, episodes, _MAX_PARALLEL_EPISODES):
        indices = range(first, min(first + _MAX_PARALLEL_EPISODES, episodes))
        finished += _played(alone, policy, indices, seed, safe_set, on_progress)
    return Evaluation(finished)


def _played(
    loop: LoopConfig,
    policy: Policy,
    indices: range,
    seed: int,
    safe_set: Ellipsoid | Polytope | None,
    on_progress: Callable[[int], None] | None,
) -> list[Episode]:
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
    nothing = np.zeros(count, np.bool_)
    running, ended, guaranteed = ~nothing, nothing, ~nothing
    returns, largest = np.zeros(count), np.full(count, np.nan if safe_set is None else 0.0)
    names = ("steps", "violation_steps", "estimate_violation_steps", "interventions", "planned", "proved")
    totals = {name: np.zeros(count, np.int64) for name in names}
    while True:
        guaranteed &= info.get("shield_guaranteed", nothing).astype(np.bool_) | ~running
        if safe_set is not None:
            largest = np.maximum(largest, np.where(running, safe_set.gauge(info["state"]), 0.0))
        running &= ~ended
        if not running.any():
            break
        observations, rewards, terminated, truncated, info = envs.step(policy(observations, info))
        returns += np.where(running, rewards, 0.0)
        estimates = info["state"] + info["estimation_error"]  # "estimate" is that of when the next action acts
        happened = {
            "steps": ~nothing,
            "violation_steps": info["cost"] > 0.0,
            "estimate_violation_steps": plant.constraint_values(estimates.T).max(axis=0) > 0.0,
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
    return [
        Episode(
            index=index,
            episode_return=float(returns[e]),
            guaranteed=bool(guaranteed[e]),
            times_safe_set=float(largest[e]),
            **{name: int(total[e]) for name, total in totals.items()},
        )
        for e, index in enumerate(indices)
    ]
