"""Processor time and memory, measured so that other jobs of the machine disturb little: in turns, and the least."""

from __future__ import annotations

import multiprocessing
import os
import resource
import subprocess
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np

T = TypeVar("T")


def timed(call: Callable[..., T], *arguments: Any, **keywords: Any) -> tuple[T, float]:
    """Returns what a call returns, and the processor time of this process that it took [s]."""
    start = time.process_time()
    return call(*arguments, **keywords), time.process_time() - start


def process_times(command: Sequence[str], **settings: Any) -> tuple[float, float, subprocess.CompletedProcess[str]]:
    """Returns processor time and time on the clock of a new process and its children [s], and how it ended."""
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    ended = subprocess.run(command, capture_output=True, text=True, **settings)
    after, clock = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - started
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, clock, ended


def cpu_time() -> float:
    """Returns the processor time of this process and its living children [s]."""
    total = time.process_time()
    for child in multiprocessing.active_children():
        fields = Path(f"/proc/{child.pid}/stat").read_text().rsplit(")", 1)[1].split()
        total += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return total


def resident() -> float:
    """Returns the resident memory of this process [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def least_times(works: Sequence[Callable[[], object]], blocks: int = 160, repeats: int = 5) -> np.ndarray:
    """Returns the time of a call of each of some works [s]: of the fastest of many short blocks, in turns."""
    least = np.full(len(works), np.inf)
    for _ in range(blocks):
        for k, work in enumerate(works):
            start = time.perf_counter()
            for _ in range(repeats):
                work()
            least[k] = min(least[k], (time.perf_counter() - start) / repeats)
    return least


def microseconds(decide: Callable[..., object], cases: Iterable[tuple[Any, ...]]) -> np.ndarray:
    """Returns the processor time of a call for each case, the better of two [us]."""
    return np.array([1e6 * min(timed(decide, *case)[1] for _ in range(2)) for case in cases])


class Steps:
    """An environment, or many side by side, stepped with the next of 16 prepared actions.

    Args:
        env: Of Gymnasium or stable-baselines3.
        actions: In place of random ones.
    """

    def __init__(self, env: Any, actions: Sequence[Any] | None = None) -> None:
        self.env, self.calls, self.count = env, 0, getattr(env, "num_envs", None)
        self.actions = _random_actions(env, self.count) if actions is None else actions
        env.reset()

    def step(self) -> None:
        """Steps; a single environment begins anew where its episode ends."""
        result = self.env.step(self.actions[self.calls % len(self.actions)])
        self.calls += 1
        if self.count is None and (result[2] or result[3]):
            self.env.reset()

    def seconds(self, at_least: float) -> float:
        """Returns the processor time of a step of one environment, over at least so much time on the clock [s]."""
        clock, start, calls = time.perf_counter(), cpu_time(), self.calls
        while calls == self.calls or time.perf_counter() - clock < at_least:
            self.step()
        return (cpu_time() - start) / ((self.count or 1) * (self.calls - calls))


def _random_actions(env: Any, count: int | None) -> list[Any]:
    """Returns actions of an environment, or of so many."""
    space, rng = getattr(env, "single_action_space", env.action_space), np.random.default_rng(0)
    if isinstance(space, gym.spaces.Discrete):
        return [rng.integers(space.n, size=count) for _ in range(16)]
    shape = space.shape if count is None else (count, *space.shape)
    return [rng.uniform(space.low, space.high, shape).astype(np.float32) for _ in range(16)]


def in_rounds(rows: dict[str, Steps], seconds: float, rounds: int = 10) -> np.ndarray:
    """Returns the processor time of a step of each, shape (rounds, rows) [s], measured in turns.

    A machine that is slow for a while is slow for all of them. What is computed once is not counted.
    """
    for each in rows.values():
        each.seconds(seconds)
    return np.array([[each.seconds(seconds / rounds) for each in rows.values()] for _ in range(rounds)])
