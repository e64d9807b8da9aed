"""What a polytope in place of the ellipsoid gives, and what it costs, for registered environments.

    python benchmarks/polytope.py [--ids CartPole BatchReactor] [--steps 2000]

Three safe sets: the ellipsoid, the polytope that its gain keeps in the box, and that of a gain that was sought for it.
"share" is the part of the safe box's volume that the set fills, "s" the processor's time for finding and proving it, on
top of the set above for a polytope. "x 1", "x 64" and "x 1024" compare a
decision to one with the ellipsoid, for one loop and for batches. "overridden" and "reward per step" are those of an LQR
behind the shield, in the same episodes.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np

from experiments.baselines import controller
from shields import Certificate, SafetyFilter, VectorSafetyShield, synthesize
from shields.synthesis.polytope_certificates import with_largest_polytope, with_polytope

T = TypeVar("T")
IDS = ("TruckTrailerCruise", "CartPole", "BatchReactor", "Pendulum")
BLOCKS, REPEATS = 160, 5  # short blocks: the least of many is what nothing else disturbed


def per_decision(shields: list[SafetyFilter], count: int) -> list[float]:
    """Returns the least time of a block of decisions, in turns; estimates lie in the first polytope."""
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
                    shield.decide(estimates[:, 0], errors, proposals[:, 0])
            else:
                batch = errors.batch().of(np.zeros(count, np.int64))
                begin = time.perf_counter()
                for _ in range(REPEATS):
                    shield.decide_columns(estimates, batch, proposals)
            least[k] = min(least[k], time.perf_counter() - begin)
    return least


def behind(name: str, certificate: Certificate, K: np.ndarray, steps: int, **settings: Any) -> tuple[float, float]:
    """Returns the share of overridden steps and the reward per step of an LQR behind a shield in mode "project"."""
    envs = VectorSafetyShield(gym.make_vec(f"ncs_gym/{name}-v0", num_envs=20, **settings), certificate)
    policy = controller("lqr", gym.make(f"ncs_gym/{name}-v0").unwrapped, K, 0)
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
    print(f"{'id':<20}{'safe set':<18}rows  share     s   x 1  x 64  x 1024  overridden  reward per step")
    for name in options.ids:
        env = gym.make(f"ncs_gym/{name}-v0").unwrapped
        settings = {"contract": env.certificate_contract, "safe_set": "ellipsoid"}
        made = {"ellipsoid": timed(lambda env=env, settings=settings: synthesize(env.plant, **settings))}
        plain = made["ellipsoid"][0]
        for label, make in (("polytope", with_polytope), ("of a sought gain", with_largest_polytope)):
            made[label] = timed(lambda env=env, plain=plain, make=make: make(plain, env.plant))
        shields = [SafetyFilter(certificate, env.plant) for certificate, _ in made.values()]
        least = np.array([per_decision(shields, count) for count in (1, 64, 1024)])
        for k, (label, (certificate, seconds)) in enumerate(made.items()):
            polytope = certificate.polytope
            share = certificate.provenance["share_of_box" if polytope is None else "polytope_share_of_box"]
            rows = "" if polytope is None else len(polytope.rows)
            ratios = "".join(
                f"{ratio:{width}.2f}" for ratio, width in zip(least[:, k] / least[:, 0], (6, 6, 8), strict=True)
            )
            overridden, reward = behind(name, certificate, plain.K, options.steps)
            print(
                f"{name if k == 0 else '':<20}{label:<18}{rows:>4}{share:>7.1%}{seconds:6.1f}{ratios}"
                f"{overridden:>12.1%}{reward:17.3f}",
                flush=True,
            )


def timed(make: Callable[[], T]) -> tuple[T, float]:
    """Returns what a function returns, and the processor's time that it took [s]."""
    begin = time.thread_time()
    return make(), time.thread_time() - begin


if __name__ == "__main__":
    main()
