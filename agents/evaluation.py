"""Plays episodes with a policy and counts what happens to the true state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from agents.control_loop import ControlLoop
from agents.trajectory import Trajectory, trajectory_of
from ncs_gym import NCSVectorEnv
from ncs_gym.envs.env import ncs_env

# Episodes played side by side at most.
SIDE_BY_SIDE = 1000

# Sets the draws of evaluations apart from those of training with the same seed.
STREAM = 0xE7A1

# Maps raw observations, shape (N, entries), and infos, arrays with N as first axis, to actions, shape (N, m).
Policy = Callable[[np.ndarray, dict[str, Any]], np.ndarray]


@dataclass(frozen=True)
class Episode:
    """One finished episode.

    Attributes:
        index: Its number within the evaluation; with the same seed and number of episodes, episodes of equal index meet
            the same start, disturbances and channel, whatever the policy and the shield.
        steps: Length.
        episode_return: Sum of the environment's rewards, without penalties of shield or violations.
        violation_steps: Steps after which the true state violated the safe box.
        estimate_violation_steps: Steps after which the estimate lay outside of it.
        interventions: Steps in which the shield intervened, or would have (mode "monitor").
        guaranteed: Whether the shield's proof held at every step; False without a shield.
        largest_level: Largest x'Mx of the true state; NaN without a certificate.
    """

    index: int
    steps: int
    episode_return: float
    violation_steps: int
    estimate_violation_steps: int
    interventions: int
    guaranteed: bool
    largest_level: float


@dataclass(frozen=True)
class Evaluation:
    """Finished episodes.

    Attributes:
        episodes: All of them.
        trajectory: The first, step by step.
    """

    episodes: list[Episode]
    trajectory: Trajectory


def evaluate(
    loop: ControlLoop,
    policy: Policy,
    episodes: int,
    seed: int,
    level_matrix: np.ndarray | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> Evaluation:
    """Returns what a policy does in a number of episodes, played side by side.

    Args:
        loop: What it is evaluated in; penalties are left out.
        policy: Maps observations and infos to actions.
        episodes: How many, >= 1.
        seed: Of all draws, see `Episode.index`.
        level_matrix: M, shape (n, n), for `Episode.largest_level`.
        on_progress: Called with the number of steps taken since its last call.
    """
    records: list[Episode] = []
    trajectory: Trajectory | None = None
    for first in range(0, episodes, SIDE_BY_SIDE):
        count = min(SIDE_BY_SIDE, episodes - first)
        play = _Play(loop.unpriced, count, level_matrix)
        infos = play.run(policy, [seed, first, STREAM], keep=trajectory is None, on_progress=on_progress)
        trajectory = trajectory or trajectory_of(infos, 0)
        records += play.records(first)
    return Evaluation(records, trajectory)  # type: ignore[arg-type]


class _Play:
    """Episodes side by side, each from its start to its end, with running totals in arrays."""

    def __init__(self, loop: ControlLoop, count: int, level_matrix: np.ndarray | None) -> None:
        # Episodes that end early go on unseen, so that the others' draws do not depend on them.
        prototype = ncs_env(loop.single())
        self._ends = prototype.terminate_on_violation
        self._envs, self._C, self._level_matrix = loop.vector(count), prototype.plant.C, level_matrix
        if self._ends and isinstance(self._envs.unwrapped, NCSVectorEnv):
            self._envs = loop.vector(count, terminate_on_violation=False)
        self._alive = np.ones(count, np.bool_)
        self._totals = {name: np.zeros(count) for name in ("return", "steps", "violations", "estimate", "acted")}
        self._guaranteed, self._level = np.ones(count, np.bool_), np.zeros(count)

    def run(
        self, policy: Policy, seed: list[int], keep: bool, on_progress: Callable[[int], None] | None
    ) -> list[dict[str, Any]]:
        """Plays; returns the infos until the first episode ends if they are to be kept."""
        word = int(np.random.SeedSequence(seed).generate_state(1)[0] >> 1)
        observations, info = self._envs.reset(seed=word)
        self._watch(info)
        kept = [info]
        while self._alive.any():
            observations, rewards, terminated, truncated, info = self._envs.step(policy(observations, info))
            if keep and self._alive[0]:
                kept.append(info)
            self._add(rewards, info)
            self._alive &= ~(terminated | truncated)
            if self._ends:
                self._alive &= ~(info["cost"] > 0.0)
            if on_progress is not None:
                on_progress(len(self._alive))
        self._envs.close()
        return kept

    def records(self, first: int) -> list[Episode]:
        """Returns one record per episode; the first has the given number."""
        totals = self._totals
        return [
            Episode(
                index=first + e,
                steps=int(totals["steps"][e]),
                episode_return=float(totals["return"][e]),
                violation_steps=int(totals["violations"][e]),
                estimate_violation_steps=int(totals["estimate"][e]),
                interventions=int(totals["acted"][e]),
                guaranteed=bool(self._guaranteed[e]),
                largest_level=float(self._level[e]) if self._level_matrix is not None else float("nan"),
            )
            for e in range(len(self._alive))
        ]

    def _add(self, rewards: np.ndarray, info: dict[str, Any]) -> None:
        """Adds a step of the episodes that are not over."""
        outside = np.abs(info["estimate"] @ self._C.T).max(axis=1) > 1.0
        acted = info.get("shield_intervened", np.zeros(len(rewards), np.bool_))
        values = {"return": rewards, "steps": 1, "violations": info["cost"] > 0.0, "estimate": outside, "acted": acted}
        for name, value in values.items():
            self._totals[name] += np.where(self._alive, value, 0)
        self._watch(info)

    def _watch(self, info: dict[str, Any]) -> None:
        """Takes note of guarantees and levels."""
        proven = info.get("shield_guaranteed", np.zeros(len(self._alive), np.bool_)).astype(np.bool_)
        self._guaranteed &= proven | ~self._alive
        if self._level_matrix is not None:
            levels = np.einsum("ei,ij,ej->e", info["state"], self._level_matrix, info["state"])
            self._level = np.maximum(self._level, np.where(self._alive, levels, 0.0))
