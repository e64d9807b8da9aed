"""Environment steps per second of CPU time, ours against what a user would pick instead, in one run.

    python benchmarks/environment_speed.py [--seconds 1.0] [--brief | --ids | --ppo]

--brief, which CI prints, leaves out all but one environment and 1024 of them; --ids prints 1024 of every registered id,
after 200 steps, without those whose packages are missing; --ppo what share of PPO's time with the defaults of
stable-baselines3 four scalar environments take.
All alternatives of a table run in turn, in rounds; a machine that is slow for a while is slow for all of them. The CPU
time of all processes counts. In brackets stands the ratio to the first row, the median over rounds.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from plain_truck_trailer import PlainTruckTrailer
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnvWrapper

import ncs_gym  # noqa: F401
from agents import SB3VecEnv
from shields import SafetyShield, VectorSafetyShield

CRUISE, CASE_STUDY = "ncs_gym/TruckTrailerCruise-v0", "ncs_gym/TruckTrailer-v0"
ROUNDS = 10
PLAIN = "PlainTruckTrailer-v0"
gym.register(PLAIN, entry_point=PlainTruckTrailer, max_episode_steps=200)


def cpu_time() -> float:
    """CPU seconds of this process and its living children."""
    total = time.process_time()
    for child in multiprocessing.active_children():
        fields = Path(f"/proc/{child.pid}/stat").read_text().rsplit(")", 1)[1].split()
        total += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return total


class Stepper:
    """Steps an environment with the next of a few prepared actions."""

    def __init__(self, env, count: int, *, stacked: bool) -> None:
        self.env, self.count, self.calls = env, count, 0
        space = getattr(env, "single_action_space", env.action_space)
        rng = np.random.default_rng(0)
        if isinstance(space, gym.spaces.Discrete):
            self.actions = [rng.integers(space.n, size=count) for _ in range(16)]
        else:
            shape = (count, *space.shape) if stacked else space.shape
            self.actions = [rng.uniform(-1, 1, shape).astype(np.float32) for _ in range(16)]
        self.stacked = stacked

    def step(self) -> None:
        result = self.env.step(self.actions[self.calls % 16])
        self.calls += 1
        if not self.stacked and (result[2] or result[3]):
            self.env.reset()

    def rate(self, seconds: float) -> float:
        """Environment steps per CPU second, over at least so many wall-clock seconds."""
        start, cpu, calls = time.perf_counter(), cpu_time(), 0
        while calls == 0 or time.perf_counter() - start < seconds:
            self.step()
            calls += 1
        return self.count * calls / (cpu_time() - cpu)


def scalar(env) -> Stepper:
    env.reset(seed=0)
    return Stepper(env, 1, stacked=False)


def vector(env_id: str, count: int, *, shielded: bool = False) -> Stepper:
    env = gym.make_vec(env_id, num_envs=count, vectorization_mode="vector_entry_point")
    env = VectorSafetyShield(env) if shielded else env
    env.reset(seed=0)
    return Stepper(env, count, stacked=True)


def stable_baselines(kind, env_id: str, count: int) -> Stepper:
    env = kind([lambda: gym.make(env_id)] * count)
    env.reset()
    return Stepper(env, count, stacked=True)


def adapted(count: int) -> Stepper:
    env = SB3VecEnv(gym.make_vec(CRUISE, num_envs=count))
    env.reset()
    return Stepper(env, count, stacked=True)


def asynchronous(env_id: str, count: int) -> Stepper:
    env = gym.vector.AsyncVectorEnv([lambda: gym.make(env_id)] * count)
    env.reset(seed=0)
    return Stepper(env, count, stacked=True)


def table(title: str, rows: dict[str, Callable[[], Stepper]], seconds: float) -> None:
    """Prints rates, and ratios to the first row."""
    steppers = {name: make() for name, make in rows.items()}
    for stepper in steppers.values():
        stepper.rate(seconds)  # patterns of arrivals fill at first
    found = np.array([[each.rate(seconds / ROUNDS) for each in steppers.values()] for _ in range(ROUNDS)])
    ratios = np.median(found / found[:, :1], axis=0)
    print(f"\n{title}")
    for name, rate, ratio in zip(steppers, np.median(found, axis=0), ratios, strict=True):
        print(f"  {name:44s} {shown(rate):>9s}  ({ratio:.3g})")
    for stepper in steppers.values():
        stepper.env.close()


def shown(value: float) -> str:
    return f"{value / 1e6:.2f}M" if value >= 1e6 else f"{value / 1e3:.1f}k"


def first_steps() -> None:
    """Prints the CPU time of the first step and of 200 steps of 1024 shielded environments, certificate excluded."""
    certificate = VectorSafetyShield(gym.make_vec(CRUISE, num_envs=1)).certificate
    start = time.process_time()
    env = VectorSafetyShield(gym.make_vec(CRUISE, num_envs=1024), certificate)
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (200, 1024, 1)).astype(np.float32)
    env.step(actions[0])
    first = time.process_time() - start
    for each in actions[1:]:
        env.step(each)
    print(f"\nfirst step of 1024 shielded environments: {first:.2f} s of CPU, first 200 steps: ", end="")
    print(f"{time.process_time() - start:.2f} s\n  (made, reset and patterns of arrivals worked out)")


def every_id(seconds: float) -> None:
    """Prints for each registered id the rate of 1024 environments, bare and shielded, after 200 steps."""
    print("\nN = 1024, steps per CPU second after 200 steps")
    print(f"  {'':30s} {'bare':>9s} {'shielded':>9s}")
    for env_id in [name for name in gym.registry if name.startswith("ncs_gym/") and name != "ncs_gym/LinearNCS-v0"]:
        try:
            bare, shielded = (vector(env_id, 1024, shielded=each) for each in (False, True))
        except ModuleNotFoundError:
            continue
        rates = []
        for stepper in (bare, shielded):
            for _ in range(200):
                stepper.step()
            rates.append(shown(stepper.rate(seconds)))
        print(f"  {env_id.removeprefix('ncs_gym/'):30s} {rates[0]:>9s} {rates[1]:>9s}", flush=True)


class TimedVecEnv(VecEnvWrapper):
    """Adds up the CPU time of resets and steps."""

    seconds = 0.0

    def reset(self):
        return self._timed(self.venv.reset)

    def step_wait(self):
        return self._timed(self.venv.step_wait)

    def _timed(self, call):
        start = time.process_time()
        result = call()
        self.seconds += time.process_time() - start
        return result


def shares_of_ppo(seconds: float) -> None:
    """Prints what share of the CPU time of PPO is that of four scalar environments, after the first rollout."""
    modes = {"bare": None, "project": {}, "lookahead": {"mode": "lookahead"}}
    print("\nfour scalar environments in PPO's CPU time [%]")
    print(f"  {'':30s} " + " ".join(f"{mode:>9s}" for mode in modes))
    for name in ("CSTR", "TruckTrailerCruise", "CartPole"):
        shares = []
        for shield in modes.values():
            wrapper = None if shield is None else lambda env, given=shield: SafetyShield(env, **given)
            env = TimedVecEnv(make_vec_env(f"ncs_gym/{name}-v0", 4, seed=0, wrapper_class=wrapper))
            model = PPO("MlpPolicy", env, seed=0, device="cpu").learn(1)
            env.seconds, start = 0.0, time.process_time()
            model.learn(round(8192 * seconds), reset_num_timesteps=False)
            shares.append(100.0 * env.seconds / (time.process_time() - start))
        print(f"  {name:30s} " + " ".join(f"{share:9.0f}" for share in shares), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=1.0, help="per row")
    parser.add_argument("--brief", action="store_true", help="one environment, and 1024")
    parser.add_argument("--ids", action="store_true", help="1024 environments of every registered id")
    parser.add_argument("--ppo", action="store_true", help="the share of environments in PPO's time")
    options = parser.parse_args()
    seconds = options.seconds
    warnings.simplefilter("ignore")
    if options.ids:
        every_id(seconds)
        return
    if options.ppo:
        torch.set_num_threads(1)
        shares_of_ppo(seconds)
        return
    first_steps()
    one = {
        "gymnasium Pendulum": lambda: scalar(gym.make("Pendulum-v1")),
        "plain truck-trailer on filterpy": lambda: scalar(gym.make(PLAIN)),
        "ours, case study": lambda: scalar(gym.make(CASE_STUDY)),
        "ours, cruise": lambda: scalar(gym.make(CRUISE)),
        "ours, case study, shielded": lambda: scalar(SafetyShield(gym.make(CASE_STUDY))),
        "ours, cruise, shielded": lambda: scalar(SafetyShield(gym.make(CRUISE))),
    }
    table("one environment, steps per CPU second (ratio to Pendulum)", one, seconds)
    for count in (1024,) if options.brief else (64, 1024, 16384):
        rows = {
            "gymnasium CartPole, vector": lambda n=count: vector("CartPole-v1", n),
            "ours, case study": lambda n=count: vector(CASE_STUDY, n),
            "ours, cruise": lambda n=count: vector(CRUISE, n),
            "ours, case study, shielded": lambda n=count: vector(CASE_STUDY, n, shielded=True),
            "ours, cruise, shielded": lambda n=count: vector(CRUISE, n, shielded=True),
            "ours, cruise, SB3VecEnv": lambda n=count: adapted(n),
        }
        table(f"N = {count}, steps per CPU second (ratio to CartPole)", rows, seconds)
    if options.brief:
        return
    for count in (64, 1024):
        rows = {
            "plain truck-trailer, DummyVecEnv": lambda n=count: stable_baselines(DummyVecEnv, PLAIN, n),
            "gymnasium Pendulum, DummyVecEnv": lambda n=count: stable_baselines(DummyVecEnv, "Pendulum-v1", n),
            "ours, cruise": lambda n=count: vector(CRUISE, n),
            "ours, cruise, shielded": lambda n=count: vector(CRUISE, n, shielded=True),
        }
        table(f"N = {count}, steps per CPU second (ratio to the plain one under DummyVecEnv)", rows, seconds)
    rows = {
        "plain truck-trailer, DummyVecEnv": lambda: stable_baselines(DummyVecEnv, PLAIN, 8),
        "plain truck-trailer, SubprocVecEnv": lambda: stable_baselines(SubprocVecEnv, PLAIN, 8),
        "plain truck-trailer, AsyncVectorEnv": lambda: asynchronous(PLAIN, 8),
        "ours, cruise": lambda: vector(CRUISE, 8),
        "ours, cruise, shielded": lambda: vector(CRUISE, 8, shielded=True),
    }
    table("N = 8, steps per CPU second of all processes (ratio to the plain one under DummyVecEnv)", rows, seconds)


if __name__ == "__main__":
    main()
