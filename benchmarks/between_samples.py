"""What it costs that the box counts between samples, too, for registered environments with a model in continuous time.

    python benchmarks/between_samples.py [--ids TruckTrailerCruise CSTR] [--points 4] [--steps 4000] [--search-gain]

Each id has two lines: at sampling instants alone, and at all times. "S" and "P" are the shares of the safe box's volume
that ellipsoid and polytope fill, "rows" those of P, "s" the time of both searches and proofs, and "bears" how much
larger all disturbances and errors could be for some ellipsoid ("tolerated_scale"). "overridden" and "reward" (per step)
are those of an LQR behind the shield with P in mode "project", in the same episodes. "left" is the largest |c x|
between two samples inside the box, without a shield, under random inputs of full size. "decision", "step" and "x 64"
(steps of 64 environments) are times, least of many in turns, next to those of the first line. Where nothing certifies,
the line says why.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from polytope import behind

import ncs_gym  # noqa: F401  (registers the environments)
from ncs_gym import LinearPlant
from shields import Certificate, Infeasible, SafetyFilter, synthesize

IDS = dict.fromkeys(("TruckTrailer", "TruckTrailerCruise", "TruckTrailerCruiseTwoWay"), 8) | dict.fromkeys(
    ("CartPole", "CartPoleTwoWay", "BatchReactor", "CSTR", "Convoy", "LaneKeeping"), 4
)
BLOCKS, REPEATS = 200, 10


def left(name: str, plant: LinearPlant, steps: int) -> float:
    """Returns the largest |c x| between two samples inside the box, under random inputs of full size."""
    settings: dict[str, Any] = {"plant": plant, "terminate_on_violation": True, "max_episode_steps": 200}
    envs, most = gym.make_vec(f"ncs_gym/{name}-v0", num_envs=100, **settings), 0.0
    rng, u = np.random.default_rng(0), np.ones((100, plant.m))
    _, info = envs.reset(seed=0)
    for _ in range(steps // 100):
        before, u = info["constraint_values"], np.where(rng.random(u.shape) < 0.2, -u, u)
        *_, info = envs.step(u.astype(np.float32))
        inside = np.maximum(before, info["constraint_values"]).max(axis=1) <= 0.0
        most = max(most, 1.0 + float(info["worst_constraint_values"][inside].max(initial=-1.0)))
    return most


def ratios(works: list[Callable[[], object]]) -> list[float]:
    """Returns the least times of works, in turns, in units of the first's."""
    least = [np.inf] * len(works)
    for _ in range(BLOCKS):
        for k, work in enumerate(works):
            begin = time.perf_counter()
            for _ in range(REPEATS):
                work()
            least[k] = min(least[k], time.perf_counter() - begin)
    return [each / least[0] for each in least]


def stepping(name: str, plant: LinearPlant, number: int) -> Callable[[], object]:
    """Returns a step of an environment, or of many."""
    settings = {"plant": plant, "terminate_on_violation": False}
    path = f"ncs_gym/{name}-v0"
    env = gym.make(path, **settings).unwrapped if number == 1 else gym.make_vec(path, num_envs=number, **settings)
    action = 0.0 * env.action_space.sample()
    env.reset(seed=0)
    for _ in range(300):  # patterns of arrivals are worked out when they occur first
        env.step(action)
    return lambda: env.step(action)


def deciding(plant: LinearPlant, certificate: Certificate, inside: Certificate) -> Callable[[], object]:
    """Returns decisions about 64 estimates in the polytope of a certificate, and random inputs."""
    rng, shield, safe = np.random.default_rng(0), SafetyFilter(certificate, plant), inside.safe_set
    estimates = (safe.sample_boundary(rng, 64) * rng.uniform(0.2, 0.9, (64, 1))).T.copy()
    proposals = rng.uniform(-1.0, 1.0, (plant.m, 64)) * plant.u_max[:, None]
    errors = shield.errors_of(0.5 * certificate.error_shapes[0]).batch().of(np.zeros(64, np.int64))
    return lambda: shield.decide_columns(estimates, errors, proposals)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ids", nargs="*", default=list(IDS))
    parser.add_argument("--points", type=int, default=0)
    parser.add_argument("--steps", type=int, default=8000)
    parser.add_argument("--search-gain", action="store_true")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    print(
        "id                        N      S      P  rows     s bears  overridden   reward   left  decision  step  x 64"
    )
    for name in options.ids:
        env = gym.make(f"ncs_gym/{name}-v0").unwrapped
        plants = [env.plant, replace(env.plant, between_samples=options.points or IDS.get(name, 8))]
        found, seconds = [], []
        for plant in plants:
            begin = time.perf_counter()
            try:
                found.append(synthesize(plant, contract=env.certificate_contract, search_gain=options.search_gain))
            except Infeasible as none:
                print(f"{name:<24} {plant.between_samples or 1:>2} {none}", flush=True)
                break
            seconds.append(time.perf_counter() - begin)
        if len(found) < len(plants):
            continue
        works = [[deciding(p, c, found[1]) for p, c in zip(plants, found, strict=True)]]
        works += [[stepping(name, plant, number) for plant in plants] for number in (1, 64)]
        times = [ratios(pair) for pair in works]
        for k, (plant, certificate) in enumerate(zip(plants, found, strict=True)):
            recorded, rows = certificate.provenance, getattr(certificate.polytope, "rows", ())
            overridden, reward = behind(name, certificate, certificate.K, options.steps, plant=plant)
            print(
                f"{name:<24} {plant.between_samples or 1:>2} {recorded['share_of_box']:>6.1%}"
                f" {recorded.get('polytope_share_of_box', np.nan):>6.1%} {len(rows):>5} {seconds[k]:>5.1f}"
                f" {recorded['tolerated_scale']:>5.2f} {overridden:>11.1%} {reward:>8.4f}"
                f" {left(name, plant, options.steps):>6.3f}"
                f" {times[0][k]:>9.2f} {times[1][k]:>5.2f} {times[2][k]:>5.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
