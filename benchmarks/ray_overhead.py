"""What Ray and the driver cost per training run, without the run's own work; docs/scaling.md uses these figures.

    python benchmarks/ray_overhead.py [--runs 1000]

Starts a Ray on this machine. The empty runs return nothing; the others return the result of a small trained agent,
which is computed once, so that its way back is measured and its work is not.
"""

from __future__ import annotations

import argparse
import pickle
import tempfile
import time
import tracemalloc
import warnings
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import gymnasium as gym

from agents.loop import LoopConfig, ShieldSettings
from experiments.backends import ray_backend
from experiments.backends.execution import execute
from experiments.runs.run_store import RunStore
from experiments.runs.training_run import TrainingRun
from experiments.settings import BackendSettings, SweepSettings
from ncs_gym.envs.env import ncs_env
from shields import synthesize

ENV = "ncs_gym/TruckTrailerCruise-v0"


def through_ray(function, runs: list[TrainingRun], store: RunStore | None = None) -> tuple[float, float]:
    """Milliseconds per run: until all are collected, and of the driver's processor."""
    task = ray_backend._remote(function, BackendSettings(engine="ray"))

    def execute_all(some: list[TrainingRun]) -> int:
        collected = set()

        def keep(run: TrainingRun, result) -> None:
            collected.add(run.index)
            if store is not None:
                store.save(run, result)

        execute(some, nullcontext(ray_backend.RayCluster(task)), keep)
        return len(collected)

    execute_all(runs[:50])  # starts the workers
    start, busy = time.perf_counter(), time.process_time()
    assert execute_all(runs) == len(runs)
    took, used = time.perf_counter() - start, time.process_time() - busy
    return 1e3 * took / len(runs), 1e3 * used / len(runs)


def per_call(function, items) -> float:
    """Milliseconds per item."""
    start = time.perf_counter()
    for item in items:
        function(item)
    return 1e3 * (time.perf_counter() - start) / len(items)


def example(episodes: int) -> TrainingRun:
    """A small run that trains."""
    certificate = synthesize(ncs_env(gym.make(ENV)).plant)
    settings = dict(n_envs=4)
    loop = LoopConfig(env=ENV, shield=ShieldSettings(certificate, "project"))
    return TrainingRun(
        arm="shielded",
        policy_kind="trained",
        training_loop=loop,
        loop=loop,
        seed=0,
        index=0,
        steps=4096,
        episodes=episodes,
        certificate=certificate,
        algorithm="PPO",
        settings=settings,
    )


def memory(item, count: int) -> float:
    """Kilobytes that each of many takes in memory."""
    content = pickle.dumps(item)
    shared = {"certificate": item.certificate, "settings": item.settings} if isinstance(item, TrainingRun) else {}
    tracemalloc.start()
    kept = []
    for _ in range(count):
        one = pickle.loads(content)
        kept.append(replace(one, **shared))  # runs share what they are made with
    taken = tracemalloc.get_traced_memory()[0] / len(kept) / 1e3
    tracemalloc.stop()
    return taken


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=1000)
    count = parser.parse_args().runs
    warnings.simplefilter("ignore")
    run = example(episodes=100)
    result = run.execute(lambda steps: None)
    runs = [replace(run, index=index) for index in range(count)]

    def empty(expected, content):
        return None

    def full(expected, content):
        return result

    with ray_backend._connected("local"):
        for name, function in (("empty", empty), ("with a result", full)):
            took, used = through_ray(function, runs)
            print(f"{count} runs, {name}: {took:.2f} ms per run, driver {used:.2f} ms", flush=True)
        with tempfile.TemporaryDirectory() as folder:
            took, used = through_ray(full, runs, RunStore(Path(folder)))
            print(
                f"{count} runs, with a result that is stored: {took:.2f} ms per run, driver {used:.2f} ms", flush=True
            )
    with tempfile.TemporaryDirectory() as folder:
        store = RunStore(Path(folder))
        few = runs[:200]
        print(f"key: {per_call(lambda one: one.key, few):.2f} ms")
        print(f"storing: {per_call(lambda one: store.save(one, replace(result, index=one.index)), few):.2f} ms")
        print(f"loading: {per_call(store.load, few):.2f} ms")
        disk = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file()) / len(few)
    light = replace(result, files={})
    print(f"a result of {run.episodes} episodes: {disk / 1e3:.0f} kB stored in 3 files, ", end="")
    print(f"{memory(light, 100):.0f} kB in memory, {memory(result, 100):.0f} kB with the agent's files")
    print(f"settings of a run: {len(pickle.dumps(run)) / 1e3:.1f} kB pickled, {memory(run, 1000):.1f} kB in memory")
    start = time.perf_counter()
    defaults = SweepSettings()
    replace(run, steps=defaults.training_steps, settings=defaults.all_hyperparams).execute(lambda steps: None)
    print(f"a run of ncs sweep with its default budget: {time.perf_counter() - start:.1f} s on one core")


if __name__ == "__main__":
    main()
