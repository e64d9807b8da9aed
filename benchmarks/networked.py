"""What `Networked` costs: a step of CartPole-v1, of 1024 of them, and of images, beside Gymnasium's DelayObservation.

    python benchmarks/networked.py [--seconds 2]

All rows of a table run in turn, in rounds. Times are processor time per step; the last column is the median over rounds
of the difference to the bare environment, or of the ratio of its time to theirs.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.wrappers import DelayObservation

from ncs_gym import Channel, GilbertElliott, Networked, VectorNetworked

ROUNDS = 10
BURSTS = Channel(loss=GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.3))
LOSSES = Channel(loss=0.2, delay=1)


class Images(gym.Env):
    """A new image at each step."""

    observation_space, action_space = Box(0, 255, (84, 84, 4), np.uint8), Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros((84, 84, 4), np.uint8), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return np.zeros((84, 84, 4), np.uint8), 0.0, False, False, {}


def seconds_per_step(env: Any, actions: Any, seconds: float) -> float:
    """Processor time of a step, over at least so much time."""
    start, steps, is_single = time.process_time(), 0, not hasattr(env, "num_envs")
    while time.process_time() - start < seconds:
        for action in actions:
            result = env.step(action)
            if is_single and (result[2] or result[3]):
                env.reset()
        steps += len(actions)
    return (time.process_time() - start) / steps


def table(title: str, rows: dict[str, Callable[[], Any]], actions: Any, seconds: float, *, ratio: bool) -> None:
    envs = {name: make() for name, make in rows.items()}
    for env in envs.values():
        env.reset(seed=0)
        seconds_per_step(env, actions, seconds / ROUNDS)
    found = np.array(
        [[seconds_per_step(env, actions, seconds / ROUNDS) for env in envs.values()] for _ in range(ROUNDS)]
    )
    last = np.median(found[:, :1] / found, axis=0) if ratio else 1e6 * np.median(found - found[:, :1], axis=0)
    print(f"\n{title:44s}{'us per step':>14s}{'bare / this' if ratio else 'more [us]':>14s}")
    for name, each, own in zip(envs, np.median(found, axis=0), last, strict=True):
        print(f"  {name:42s}{1e6 * each:14.1f}{own:14.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=2.0, help="per row")
    seconds = parser.parse_args().seconds
    alternating = [k % 2 for k in range(100)]

    def cart_pole() -> gym.Env:
        return gym.make("CartPole-v1")

    one = {
        "bare": cart_pole,
        "DelayObservation, 2 steps": lambda: DelayObservation(cart_pole(), 2),
        "Networked, delay=2": lambda: Networked(cart_pole(), Channel(delay=2)),
        "Networked, bursts": lambda: Networked(cart_pole(), BURSTS),
        "Networked, losses both ways": lambda: Networked(cart_pole(), LOSSES, LOSSES, neutral=0),
        "Networked, bursts, age and pending actions": lambda: Networked(
            cart_pole(), BURSTS, observe=("age", "pending_actions")
        ),
    }
    table("CartPole-v1", one, alternating, seconds, ratio=False)

    def many() -> Any:
        return gym.make_vec("CartPole-v1", num_envs=1024, vectorization_mode="vector_entry_point")

    rng = np.random.default_rng(0)
    batches = {
        "bare": many,
        "VectorNetworked, delay=2": lambda: VectorNetworked(many(), Channel(delay=2)),
        "VectorNetworked, bursts": lambda: VectorNetworked(many(), BURSTS),
        "VectorNetworked, losses both ways": lambda: VectorNetworked(many(), LOSSES, LOSSES, neutral=0),
    }
    table("1024 CartPole-v1", batches, rng.integers(0, 2, (16, 1024)), seconds, ratio=True)
    images = {
        "bare": Images,
        "DelayObservation, 2 steps": lambda: DelayObservation(Images(), 2),
        "Networked, bursts": lambda: Networked(Images(), BURSTS),
    }
    table("images of 84 x 84 x 4", images, alternating, seconds, ratio=False)


if __name__ == "__main__":
    main()
