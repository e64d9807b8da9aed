"""Evaluates a policy: plays episodes side by side and counts what happens to the true state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from agents.loop import LoopConfig
from agents.results import Episode, Evaluation, Trajectory
from ncs_gym import NCSVectorEnv
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
    level_matrix: np.ndarray | Polytope | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> Evaluation:
    """Returns what a policy does in a number of episodes, played side by side.

    Args:
        loop: The control loop, whose penalties are left out.
        policy: Maps observations and infos to actions.
        episodes: Number of episodes, at least 1.
        seed: Seed of all random numbers (see `Episode.index`).
        level_matrix: M, shape (n, n), for `Episode.largest_level`; or a polytope, of which the gauge is squared.
        on_progress: Called with the number of steps taken since its last call.

    Raises:
        ValueError: If there is no episode to play.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}")
    finished: list[Episode] = []
    trajectory: Trajectory | None = None
    for first in range(0, episodes, _MAX_PARALLEL_EPISODES):
        count = min(_MAX_PARALLEL_EPISODES, episodes - first)
        rollout = _Rollout(loop.without_penalties, count, level_matrix)
        infos = rollout.run(policy, [seed, first, _SEED_STREAM], trajectory is None, on_progress)
        trajectory = trajectory or _first_trajectory(infos)
        finished += rollout.episodes(first)
    return Evaluation(finished, trajectory)  # type: ignore[arg-type]


class _Rollout:
    """Episodes played side by side, each from its start to its end, with running totals in arrays.

    Args:
        loop: The control loop, without penalties.
        count: Number of episodes.
        level_matrix: M, shape (n, n), a polytope, or None.
    """

    def __init__(self, loop: LoopConfig, count: int, level_matrix: np.ndarray | Polytope | None) -> None:
        # Episodes that end early are stepped on without being counted: the others' random numbers stay the same.
        prototype = ncs_env(loop.single())
        self._terminates = prototype.terminate_on_violation
        self._envs, self._C, self._level_matrix = loop.vector(count), prototype.plant.box_rows, level_matrix
        if self._terminates and isinstance(self._envs.unwrapped, NCSVectorEnv):
            self._envs = loop.vector(count, terminate_on_violation=False)
        self._running = np.ones(count, np.bool_)
        names = ("return", "steps", "violations", "estimate_violations", "interventions", "planned")
        self._totals = {name: np.zeros(count) for name in names}
        self._guaranteed, self._level = np.ones(count, np.bool_), np.zeros(count)

    def run(
        self, policy: Policy, seed: list[int], keep_infos: bool, on_progress: Callable[[int], None] | None
    ) -> list[dict[str, Any]]:
        """Plays all episodes; returns the infos of the reset and, if kept, of the first episode's steps."""
        env_seed = int(np.random.SeedSequence(seed).generate_state(1)[0] >> 1)
        observations, info = self._envs.reset(seed=env_seed)
        self._update_guarantees(info)
        infos = [info]
        while self._running.any():
            observations, rewards, terminated, truncated, info = self._envs.step(policy(observations, info))
            if keep_infos and self._running[0]:
                infos.append(info)
            self._add(rewards, info)
            self._running &= ~(terminated | truncated)
            if self._terminates:
                self._running &= ~(info["cost"] > 0.0)
            if on_progress is not None:
                on_progress(len(self._running))
        self._envs.close()
        return infos

    def episodes(self, first: int) -> list[Episode]:
        """Returns the finished episodes; the first has the given index."""
        totals = self._totals
        return [
            Episode(
                index=first + e,
                steps=int(totals["steps"][e]),
                episode_return=float(totals["return"][e]),
                violation_steps=int(totals["violations"][e]),
                estimate_violation_steps=int(totals["estimate_violations"][e]),
                interventions=int(totals["interventions"][e]),
                planned=int(totals["planned"][e]),
                guaranteed=bool(self._guaranteed[e]),
                largest_level=float(self._level[e]) if self._level_matrix is not None else float("nan"),
            )
            for e in range(len(self._running))
        ]

    def _add(self, rewards: np.ndarray, info: dict[str, Any]) -> None:
        values = {
            "return": rewards,
            "steps": 1,
            "violations": info["cost"] > 0.0,
            "estimate_violations": np.abs(info["estimate"] @ self._C.T).max(axis=1) > 1.0,
            "interventions": info.get("shield_intervened", np.zeros(len(rewards), np.bool_)),
            "planned": info.get("shield_plan_length", np.zeros(len(rewards), np.int64)) > 0,
        }
        for name, value in values.items():
            self._totals[name] += np.where(self._running, value, 0)
        self._update_guarantees(info)

    def _update_guarantees(self, info: dict[str, Any]) -> None:
        """Updates whether the guarantee held, and the largest levels, of the running episodes."""
        guaranteed = info.get("shield_guaranteed", np.zeros(len(self._running), np.bool_)).astype(np.bool_)
        self._guaranteed &= guaranteed | ~self._running
        if self._level_matrix is not None:
            levels = _levels(info["state"], self._level_matrix)
            self._level = np.maximum(self._level, np.where(self._running, levels, 0.0))


def _levels(states: np.ndarray, of: np.ndarray | Polytope) -> np.ndarray:
    """Returns x'Mx of states, shape (N, n), or the squares of their gauges in a polytope: 1 on the boundary."""
    return of.gauge(states) ** 2 if isinstance(of, Polytope) else np.einsum("ei,ij,ej->e", states, of, states)


def _first_trajectory(infos: list[dict[str, np.ndarray]]) -> Trajectory:
    """Returns the trajectory of the first environment from the infos of its reset and of its steps."""
    steps = infos[1:]
    not_shielded = np.zeros(1, np.bool_)
    return Trajectory(
        states=np.array([info["state"][0] for info in infos]),
        estimates=np.array([info["estimate"][0] for info in infos]),
        inputs=np.array([info["input"][0] for info in steps]),
        proposed=np.array([info.get("input_proposed", info["input"])[0] for info in steps]),
        intervened=np.array([info.get("shield_intervened", not_shielded)[0] for info in steps], dtype=np.bool_),
        arrivals=np.array([info["packet_arrived"][0] for info in steps], dtype=np.bool_),
    )
