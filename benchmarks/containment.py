"""How much intervention a sharper one-step test saves: fraction of actions overridden by each of three tests.

    python benchmarks/containment.py [--episodes 15]

In coordinates where M = I, with p the eigenvalues of the predicted ellipsoid, c its center and h = sqrt(max p): all of
it lies in S if some s in (max p, 1) has sum_i c_i^2 s/(s - p_i) + s <= 1. "norm" is |c| <= 1 - h, "shield" takes s = h
(what the shield does), "exact" the best s. Each judges the same proposals, made in shielded episodes.
"""

from __future__ import annotations

import argparse
import time

import gymnasium as gym
import numpy as np
from scipy.optimize import minimize_scalar

from ncs_gym.uncertainty.shape_matrices import outer_sum
from shields import SafetyFilter, SafetyShield, synthesize
from shields.runtime.safety_filter import MARGIN

STEPS = 200


def exact(shield: SafetyFilter, estimate: np.ndarray, error_shape: np.ndarray, u: np.ndarray) -> bool:
    """Whether everything one step can reach lies in S, with the best s."""
    test = shield.test
    predicted = outer_sum(test.state_rows @ error_shape @ test.state_rows.T, test.D, np.eye(shield.plant.n))
    p, axes = np.linalg.eigh(predicted)
    c = axes.T @ (test.state_rows @ estimate + test.input_rows @ u)
    if p[-1] >= 1.0:
        return False
    bounds = (p[-1] * (1.0 + 1e-9), 1.0)
    best = minimize_scalar(lambda s: (c**2 * s / (s - p)).sum() + s, bounds=bounds, method="bounded")
    return best.fun <= 1.0


def policies(rng: np.random.Generator):
    """Actions by step and episode."""
    return {
        "uniformly random": lambda step, episode: rng.uniform(-1, 1, 1),
        "slow sine with noise": lambda step, episode: np.clip(
            0.5 * np.sin(step / 15 + episode) + 0.3 * rng.standard_normal(1), -1, 1
        ),
        "full throttle, random sign": lambda step, episode: np.sign(rng.standard_normal(1)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=15)
    options = parser.parse_args()
    print("fraction of actions overridden by each test")
    print(f"{'environment':26s}{'policy':30s}{'norm':>8s}{'shield':>8s}{'exact':>8s}{'exact [us]':>12s}", flush=True)
    for env_id in ("ncs_gym/TruckTrailer-v0", "ncs_gym/TruckTrailerCruise-v0"):
        plant = gym.make(env_id).unwrapped.plant
        env = SafetyShield(gym.make(env_id), synthesize(plant, safe_set="ellipsoid"))
        for name, act in policies(np.random.default_rng(0)).items():
            turned_down, seconds = np.zeros(3), 0.0
            for episode in range(options.episodes):
                _, info = env.reset(seed=episode)
                for step in range(STEPS):
                    action = act(step, episode).astype(np.float32)
                    case = info["estimate"], info["error_shape"], plant.u_max * action.astype(np.float64)
                    sets = env.filter.test.reachable(case[0][:, None], env.filter.errors_of(case[1]).batch())
                    test_margin, margin = (each.item() for each in sets.margins(case[2][:, None]))
                    start = time.perf_counter()
                    contained = exact(env.filter, *case)
                    seconds += time.perf_counter() - start
                    turned_down += margin < MARGIN, test_margin < MARGIN, not contained
                    *_, info = env.step(action)
            count = options.episodes * STEPS
            fractions = "".join(f"{fraction:8.1%}" for fraction in turned_down / count)
            print(
                f"{env_id.removeprefix('ncs_gym/'):26s}{name:30s}{fractions}{1e6 * seconds / count:12.0f}", flush=True
            )


if __name__ == "__main__":
    main()
