"""What Ray and the driver cost per unit, without the unit's own work; docs/scaling.md reckons with these figures.

    python benchmarks/ray_overhead.py [--units 1000]

Starts a Ray on this machine. The empty units return nothing; the others return the result of a small trained agent,
which is computed once, so that its way back is paid and its work is not.
"""

from __future__ import annotations

import argparse
import pickle
import tempfile
import time
import tracemalloc
import warnings
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import gymnasium as gym

from agents.settings import PPOSettings
from experiments.backends import ray_backend as ray_engine
from experiments.backends.ray_cluster import AHEAD, FEWEST, Need, collect, stream
from experiments.runs.provenance import versions
from experiments.runs.run_store import UnitStore
from experiments.runs.training_run import Unit, run_unit
from experiments.settings.learning import SweepSettings
from ncs_gym.envs.env import ncs_env
from shields import synthesize

ENV = "ncs_gym/TruckTrailerCruise-v0"
NEED = Need(1.0, 0.0)


def through_ray(function, units: list[Unit], room: int, store: UnitStore | None = None) -> tuple[float, float]:
    """Milliseconds per unit: until all are collected, and of the driver's processor."""
    task, expected = ray_engine._task(function, NEED), versions()

    def submit(unit: Unit):
        return task.remote(expected, pickle.dumps(unit))

    def run(some: list[Unit]) -> int:
        collected = set()

        def keep(unit: Unit, result) -> None:
            collected.add(unit.index)
            if store is not None:
                store.save(unit, result)

        batches = stream(some, submit, ray_engine.finished, ray_engine._cancel, lambda: room)
        with closing(batches):
            collect(batches, ray_engine._result, keep)
        return len(collected)

    run(units[:50])  # starts the workers
    start, busy = time.perf_counter(), time.process_time()
    assert run(units) == len(units)
    took, used = time.perf_counter() - start, time.process_time() - busy
    return 1e3 * took / len(units), 1e3 * used / len(units)


def per_call(function, items) -> float:
    """Milliseconds per item."""
    start = time.perf_counter()
    for item in items:
        function(item)
    return 1e3 * (time.perf_counter() - start) / len(items)


def example(episodes: int) -> Unit:
    """A small unit that trains."""
    certificate = synthesize(ncs_env(gym.make(ENV)).plant)
    settings = PPOSettings(envs=4)
    return Unit(
        arm="shielded",
        learner="agent",
        env=ENV,
        seed=0,
        index=0,
        steps=4096,
        episodes=episodes,
        certificate=certificate,
        mode="project",
        algorithm="PPO",
        settings=settings,
    )


def memory(item, count: int) -> float:
    """Kilobytes that each of many takes in memory."""
    content = pickle.dumps(item)
    shared = {"certificate": item.certificate, "settings": item.settings} if isinstance(item, Unit) else {}
    tracemalloc.start()
    kept = []
    for _ in range(count):
        one = pickle.loads(content)
        kept.append(replace(one, **shared))  # units share what they are made with
    taken = tracemalloc.get_traced_memory()[0] / len(kept) / 1e3
    tracemalloc.stop()
    return taken


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--units", type=int, default=1000)
    count = parser.parse_args().units
    warnings.simplefilter("ignore")
    unit = example(episodes=100)
    result = run_unit(unit, lambda steps: None)
    units = [replace(unit, index=index) for index in range(count)]

    def empty(expected, content):
        return None

    def full(expected, content):
        return result

    with ray_engine._connected("local"):
        for name, function in (("empty", empty), ("with a result", full)):
            for room in (FEWEST, AHEAD * 1000):
                took, used = through_ray(function, units, room)
                print(
                    f"{count} units, {name}, {room} under way: {took:.2f} ms per unit, driver {used:.2f} ms", flush=True
                )
        with tempfile.TemporaryDirectory() as folder:
            took, used = through_ray(full, units, FEWEST, UnitStore(Path(folder)))
            print(
                f"{count} units, with a result that is stored: {took:.2f} ms per unit, driver {used:.2f} ms", flush=True
            )
    with tempfile.TemporaryDirectory() as folder:
        store = UnitStore(Path(folder))
        few = units[:200]
        print(f"key: {per_call(lambda one: one.key, few):.2f} ms")
        print(f"storing: {per_call(lambda one: store.save(one, replace(result, index=one.index)), few):.2f} ms")
        print(f"loading: {per_call(store.load, few):.2f} ms")
        disk = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file()) / len(few)
    light = replace(result, files={})
    print(f"a result of {unit.episodes} episodes: {disk / 1e3:.0f} kB stored in 3 files, ", end="")
    print(f"{memory(light, 100):.0f} kB in memory, {memory(result, 100):.0f} kB with the agent's files")
    print(f"a unit: {len(pickle.dumps(unit)) / 1e3:.1f} kB pickled, {memory(unit, 1000):.1f} kB in memory")
    start = time.perf_counter()
    defaults = SweepSettings()
    run_unit(replace(unit, steps=defaults.steps, settings=defaults.ppo), lambda steps: None)
    print(f"a run of ncs sweep with its default budget: {time.perf_counter() - start:.1f} s on one core")


if __name__ == "__main__":
    main()
