"""Measures how many pictures per second render mode "rgb_array" draws, steps included.

python benchmarks/rendering.py
"""

import time

import gymnasium as gym
import numpy as np

import ncs_gym  # noqa: F401
from ncs_gym.registration import ENVIRONMENTS

FRAMES, REPEATS = 200, 5


def main() -> None:
    print(f"{'environment':<38}{'step [ms]':>10}{'picture [ms]':>14}{'pictures/s':>12}")
    for env_id in ENVIRONMENTS:
        if env_id == "ncs_gym/LinearNCS-v0":
            continue
        try:
            env = gym.make(env_id, render_mode="rgb_array", terminate_on_violation=False).unwrapped
        except ModuleNotFoundError as missing:
            print(f"{env_id:<38}{missing}")
            continue
        step, picture = [min(times) for times in zip(*(measured(env) for _ in range(REPEATS)), strict=True)]
        print(f"{env_id:<38}{1e3 * step:>10.2f}{1e3 * picture:>14.2f}{1.0 / (step + picture):>12.0f}")


def measured(env: gym.Env) -> tuple[float, float]:
    """Returns the mean times of a step and of a picture in an episode of small random actions [s]."""
    env.reset(seed=0)
    env.render()
    rng, step, picture = np.random.default_rng(0), 0.0, 0.0
    for _ in range(FRAMES):
        action = rng.uniform(-0.2, 0.2, env.action_space.shape).astype(np.float32)
        started = time.perf_counter()
        env.step(action)
        between = time.perf_counter()
        env.render()
        step, picture = step + between - started, picture + time.perf_counter() - between
    return step / FRAMES, picture / FRAMES


if __name__ == "__main__":
    main()
