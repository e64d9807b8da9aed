"""What a polytope in place of the ellipsoid gives, and what it costs, for registered environments.

    python benchmarks/polytope.py [--ids CartPole BatchReactor] [--steps 2000]

"share" is the part of the safe box's volume that the safe set fills: of the ellipsoid, and of the polytope. "s" is the
time for finding and proving the polytope, "flint" that of the second engine. "x 1", "x 64" and "x 1024" compare a
decision with the polytope to one with the ellipsoid, for one loop and for batches. "overridden" and "reward per step"
are those of an LQR behind either shield, in the same episodes.
"""

from __future__ import annotations

import argparse
import time
import warnings
from typing import Any

import gymnasium as gym
import numpy as np

import ncs_gym  # noqa: F401  (registers the environments)
from experiments.baselines import controller
from shields import Certificate, SafetyFilter, VectorSafetyShield, synthesize, verify
from shields.synthesis.certification import with_polytope

IDS = ("TruckTrailerCruise", "CartPole", "BatchReactor", "Pendulum")
BLOCKS, REPEATS = 160, 5  # short blocks: the least of many is what nothing else disturbed


def per_decision(shields: list[SafetyFilter], count: int) -> list[float]:
    """Returns the least time of a block of decisions, in turns, for estimates in the polytope and random proposals."""
    rng = np.random.default_rng(0)
    plant, polytope = shields[0].plant, shields[1].certificate.polytope
    assert polytope is not None
    estimates = (polytope.sample_boundary(rng, count) * rng.uniform(0.2, 1.0, (count, 1))).T.copy()
    proposals = rng.uniform(-1.0, 1.0, (plant.m, count)) * plant.u_max[:, None]
    shape = 0.5 * shields[0].certificate.error_shapes[0]
    least = [np.inf] * len(shields)
    for _ in range(BLOCKS):
        for k, shield in enumerate(shields):
            errors, begin = shield.errors_of(shape), time.perf_counter()
            if count == 1:
                for _ in range(REPEATS):
                    shield.decide_knowing(estimates[:, 0], errors, proposals[:, 0])
            else:
                batch = errors.batch().of(np.zeros(count, np.int64))
                begin = time.perf_counter()
                for _ in range(REPEATS):
                    shield.decide_columns(estimates, batch, proposals)
            least[k] = min(least[k], time.perf_counter() - begin)
    return least


def behind(name: str, certificate: Certificate, steps: int, **settings: Any) -> tuple[float, float]:
    """Returns the share of overridden steps and the reward per step of an LQR behind a shield in mode "project"."""
    envs = VectorSafetyShield(gym.make_vec(f"ncs_gym/{name}-v0", num_envs=20, **settings), certificate)
    policy = controller("lqr", gym.make(f"ncs_gym/{name}-v0").unwrapped, certificate.K, 0)
    observations, info = envs.reset(seed=0)
    overridden = total = 0.0
    for _ in range(steps // 20):
        observations, reward, *_, info = envs.step(policy(observations, info).astype(np.float32))
        overridden += float(info["shield_intervened"].sum())
        total += float(reward.sum())
    return overridden / (steps // 20 * 20), total / (steps // 20 * 20)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ids", nargs="*", default=IDS)
    parser.add_argument("--steps", type=int, default=8000)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    print(
        "id                   rows  share of the box    s  flint   x 1  x 64  x 1024    overridden     reward per step"
    )
    for name in options.ids:
        env = gym.make(f"ncs_gym/{name}-v0").unwrapped
        plain = synthesize(env.plant, contract=env.certificate_contract, safe_set="ellipsoid")
        begin = time.perf_counter()
        wide = with_polytope(plain, env.plant)
        found = time.perf_counter() - begin
        if wide.polytope is None:
            print(f"{name:20} none: {wide.provenance['no_polytope']}")
            continue
        begin = time.perf_counter()
        assert verify(wide, env.plant, engine="flint").valid
        flint = time.perf_counter() - begin
        shields = [SafetyFilter(certificate, env.plant) for certificate in (plain, wide)]
        ratios = []
        for count in (1, 64, 1024):
            ellipsoid, polytope = per_decision(shields, count)
            ratios.append(polytope / ellipsoid)
        shares = [wide.provenance[each] for each in ("share_of_box", "polytope_share_of_box")]
        (first, before), (second, after) = behind(name, plain, options.steps), behind(name, wide, options.steps)
        print(
            f"{name:20} {len(wide.polytope.rows):4}   {shares[0]:5.1%} -> {shares[1]:5.1%} {found:4.1f}  {flint:5.2f}"
            f" {ratios[0]:5.2f} {ratios[1]:5.2f}   {ratios[2]:5.2f}   {first:5.1%} -> {second:5.1%}"
            f" {before:7.3f} -> {after:7.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
