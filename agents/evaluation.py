"""Plays episodes with a policy and counts what happens to the true state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import gymnasium as gym
import numpy as np

from agents.training import Shielding, make_env

# Episodes played side by side, so that a network's prediction is shared.
SIDE_BY_SIDE = 25

# Maps raw observations, shape (N, entries), and their infos to actions, shape (N, m).
Policy = Callable[[np.ndarray, list[dict]], np.ndarray]


@dataclass(frozen=True)
class Episode:
    """One finished episode.

    Attributes:
        seed: The environment was reset with it.
        steps: Length.
        episode_return: Sum of the environment's rewards, without shield penalties.
        violation_steps: Steps after which the true state violated the safe box.
        interventions: Steps in which the shield intervened.
        guaranteed: Whether the shield's proof held at every step; False without a shield.
        largest_level: Largest x'Mx of the true state; NaN without a certificate.
    """

    seed: int
    steps: int
    episode_return: float
    violation_steps: int
    interventions: int
    guaranteed: bool
    largest_level: float


def evaluate(
    env_id: str,
    policy: Policy,
    episodes: int,
    first_seed: int,
    shielding: Shielding | None = None,
    level_matrix: np.ndarray | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> list[Episode]:
    """Returns one record per episode; episode i is reset with seed first_seed + i, so that policies can be paired.

    Args:
        env_id: A registered `ncs_gym` id.
        policy: Maps observations and infos to actions.
        episodes: How many.
        first_seed: Seed of the first.
        shielding: None plays unshielded.
        level_matrix: M, shape (n, n), for `Episode.largest_level`.
        on_progress: Called with the number of finished episodes since its last call.
    """
    envs = [make_env(env_id, shielding) for _ in range(min(episodes, SIDE_BY_SIDE))]
    records: list[Episode] = []
    for start in range(0, episodes, len(envs)):
        seeds = range(first_seed + start, first_seed + min(start + len(envs), episodes))
        records += _play(envs[: len(seeds)], policy, seeds, shielding, level_matrix)
        if on_progress is not None:
            on_progress(len(seeds))
    return records


def _play(
    envs: list[gym.Env], policy: Policy, seeds: range, shielding: Shielding | None, level_matrix: np.ndarray | None
) -> list[Episode]:
    """Plays one episode in each environment, side by side."""
    penalty = 0.0 if shielding is None else shielding.penalty
    starts = [env.reset(seed=seed) for env, seed in zip(envs, seeds, strict=True)]
    observations, infos = [list(part) for part in zip(*starts, strict=True)]
    tallies = [_Tally(seed, level_matrix, info) for seed, info in zip(seeds, infos, strict=True)]
    running = list(range(len(envs)))
    while running:
        actions = policy(np.stack([observations[i] for i in running]), [infos[i] for i in running])
        for i, action in zip(list(running), actions, strict=True):
            observations[i], reward, terminated, truncated, infos[i] = envs[i].step(action)
            tallies[i].add(float(reward) + penalty * infos[i].get("shield_intervened", False), infos[i])
            if terminated or truncated:
                running.remove(i)
    return [tally.episode() for tally in tallies]


class _Tally:
    """Running totals of one episode."""

    def __init__(self, seed: int, level_matrix: np.ndarray | None, info: dict) -> None:
        self._seed, self._level_matrix = seed, level_matrix
        self._return, self._steps = 0.0, 0
        self._guaranteed, self._level = True, 0.0
        self._violations = 0
        self._observe(info)

    def add(self, reward: float, info: dict) -> None:
        self._return += reward
        self._steps += 1
        self._violations += info["cost"] > 0.0
        self._observe(info)

    def episode(self) -> Episode:
        info = self._info
        return Episode(
            seed=self._seed,
            steps=self._steps,
            episode_return=self._return,
            violation_steps=self._violations,
            interventions=int(info.get("episode_interventions", 0)),
            guaranteed=self._guaranteed,
            largest_level=self._level if self._level_matrix is not None else float("nan"),
        )

    def _observe(self, info: dict) -> None:
        self._info = info
        self._guaranteed &= bool(info.get("shield_guaranteed", False))
        if self._level_matrix is not None:
            self._level = max(self._level, float(info["state"] @ self._level_matrix @ info["state"]))
