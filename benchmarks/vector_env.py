"""Environment steps per second, ours against others', in one run; and what an environment costs in memory.

    python benchmarks/vector_env.py [--seconds 2.0] [--warm 3.0]

Ours run the cruise and the case study after `--warm` seconds of stepping (the gain table fills with patterns of
arrivals at first; compiling is excluded too), with random actions. In brackets the ratio to gymnasium's CartPole vector
environment of the same size, the median over rounds.
"""

from __future__ import annotations

import argparse
import time
import warnings

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv

import ncs_gym  # noqa: F401
from agents import SB3VecEnv
from ncs_gym.draws import fill_keys, fill_normal, fill_truncated
from shields import VectorSafetyShield

SIZES = (1, 64, 1024, 16384)
ROUNDS = 20
CRUISE, CASE_STUDY = "ncs_gym/TruckTrailerCruise-v0", "ncs_gym/TruckTrailer-v0"


def run_for(step, seconds: float) -> float:
    """Calls per second."""
    start, calls = time.perf_counter(), 0
    while calls == 0 or time.perf_counter() - start < seconds:
        step()
        calls += 1
    return calls / (time.perf_counter() - start)


def rate(step, count: int, seconds: float, warm: float) -> float:
    """Median over five stretches of results per second, `count` a call."""
    run_for(step, warm)
    return float(np.median([count * run_for(step, seconds / 5) for _ in range(5)]))


def stepper(env, actions):
    """A function that steps with the next of a few prepared batches of actions."""
    state = [0]

    def step() -> None:
        env.step(actions[state[0] % len(actions)])
        state[0] += 1

    return step


def vector(env_id: str, count: int, *, shielded: bool = False):
    env = gym.make_vec(env_id, num_envs=count)
    if shielded:
        env = VectorSafetyShield(env)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    if isinstance(env.single_action_space, gym.spaces.Discrete):
        actions = [rng.integers(env.single_action_space.n, size=count) for _ in range(16)]
    else:
        actions = [rng.uniform(-1, 1, env.action_space.shape).astype(np.float32) for _ in range(16)]
    return env, stepper(env, actions)


def dummy(env_id: str, count: int):
    env = DummyVecEnv([lambda: gym.make(env_id)] * count)
    env.reset()
    rng = np.random.default_rng(0)
    return env, stepper(
        env, [rng.uniform(-1, 1, (count, *env.action_space.shape)).astype(np.float32) for _ in range(16)]
    )


def adapter(env_id: str, count: int):
    env = SB3VecEnv(gym.make_vec(env_id, num_envs=count))
    env.reset()
    rng = np.random.default_rng(0)
    return env, stepper(
        env, [rng.uniform(-1, 1, (count, *env.action_space.shape)).astype(np.float32) for _ in range(16)]
    )


def memory(count: int) -> float:
    """Bytes per environment of all arrays that a vector environment keeps, shared tables excluded."""
    inner = gym.make_vec(CRUISE, num_envs=count).unwrapped
    inner.reset(seed=0)
    inner.step(np.zeros((count, 1), np.float32))
    arrays = [*inner._kept, inner._doubts, inner._residuals, inner._memory, inner._done, inner.episodes, inner.starts]
    return sum(array.nbytes for array in arrays) / count


def column(rows: dict, count: int, options: argparse.Namespace) -> dict[str, str]:
    """Cells for one number of environments: medians over rounds in which everything runs in turn.

    A machine that is slow for a while is slow for all of them.
    """
    steppers = {name: make(count) for name, make in rows.items()}
    running = {name: step for name, step in steppers.items() if step is not None}
    for step in running.values():
        run_for(step, options.warm)
    share = options.seconds / ROUNDS
    found = np.array([[count * run_for(step, share) for step in running.values()] for _ in range(ROUNDS)])
    ratios = np.median(found / found[:, :1], axis=0)
    cells = {
        name: f"{shown(each)} ({ratio:.2f})"
        for name, each, ratio in zip(running, np.median(found, axis=0), ratios, strict=True)
    }
    return {name: cells.get(name, "-") for name in rows}


def shown(value: float) -> str:
    return f"{value / 1e6:.2f}M" if value >= 1e6 else f"{value / 1e3:.1f}k"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--warm", type=float, default=3.0)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = {
        "gymnasium CartPole, vector": lambda n: vector("CartPole-v1", n)[1],
        "ours, case study": lambda n: vector(CASE_STUDY, n)[1],
        "ours, case study, shielded": lambda n: vector(CASE_STUDY, n, shielded=True)[1],
        "ours, cruise": lambda n: vector(CRUISE, n)[1],
        "ours, cruise, shielded": lambda n: vector(CRUISE, n, shielded=True)[1],
        "ours, cruise, SB3VecEnv": lambda n: adapter(CRUISE, n)[1],
        "ours, cruise, DummyVecEnv": lambda n: dummy(CRUISE, n)[1] if n <= 64 else None,
        "gymnasium Pendulum, DummyVecEnv": lambda n: dummy("Pendulum-v1", n)[1] if n <= 64 else None,
    }
    columns = {count: column(rows, count, options) for count in SIZES}
    print(f"{'environment steps per second':34s}" + "".join(f"{f'N = {n}':>17s}" for n in SIZES))
    for name in rows:
        print(f"{name:34s}" + "".join(f"{columns[count][name]:>17s}" for count in SIZES))
    decide(options)
    draws(options)
    print("bytes per environment: " + ", ".join(f"{memory(count):.0f} at N = {count}" for count in SIZES[1:]))


def draws(options: argparse.Namespace) -> None:
    """Prints what a normal number costs drawn by numpy and in compiled loops, and how large the gain tables become."""
    rng, block, keys = np.random.default_rng(0), np.zeros((2, 1024)), np.empty(1024, np.uint64)
    fill_keys(np.uint64(0), keys)
    numpys = rate(lambda: rng.standard_normal(out=block), block.size, options.seconds, 0.1)
    ours = rate(lambda: fill_normal(keys, 0, 1.0, np.inf, block), block.size, options.seconds, 0.1)
    truncated = rate(lambda: fill_truncated(keys, 0, 6.0, 2, block), block.size, options.seconds, 0.1)
    print(f"a normal number: numpy {1e9 / numpys:.1f} ns, ours {1e9 / ours:.1f} ns, truncated {1e9 / truncated:.1f} ns")
    for name in ("TruckTrailer", "TruckTrailerCruise", "CartPole", "BatchReactor"):
        env, step = vector(f"ncs_gym/{name}-v0", 1024)
        for _ in range(400):
            step()
        print(f"patterns of arrivals after 400 steps of 1024, {name}: {len(env.unwrapped.patterns[0])}")


def decide(options: argparse.Namespace) -> None:
    """Prints what a batched decision costs per environment."""
    for env_id in (CRUISE, CASE_STUDY):
        env, step = vector(env_id, 1024, shielded=True)
        for _ in range(500):
            step()
        proposed = env.unwrapped.inputs_of(np.random.default_rng(0).uniform(-1, 1, (1024, 1)))
        batch, estimate, numbers = env._batch, env._estimate, env._shape_number

        def once(batch=batch, estimate=estimate, numbers=numbers, proposed=proposed) -> None:
            batch.decide(estimate, numbers, proposed)

        decisions = rate(once, 1024, options.seconds, 0.2)
        share = batch.decide(estimate, numbers, proposed).intervened.mean()
        cost = f"{1e6 / decisions:.3f} us per environment at N = 1024, {share:.0%} overridden"
        print(f"decision of the vector shield, {env_id}: {cost}")


if __name__ == "__main__":
    main()
