"""What the shield costs: one decision against the same filter in cvxpy, and a step against other environments' steps.

    python benchmarks/shield_decision.py [--steps 400]

"ratio" is cvxpy's time over ours; "too far" is how much farther our input lies from the proposed one than the solver's,
at most, relative to that distance.

Estimates, error ellipsoids and proposals come from episodes of the registered environment (one input) and of random
plants under a random policy, so that the mix of passed, projected and fallback decisions is the one met in use.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections import defaultdict

import cvxpy as cp
import gymnasium as gym
import numpy as np

from ncs_gym import Channel, LinearPlant, NCSEnv
from ncs_gym.uncertainty.shape_matrices import outer_sum
from shields import SafetyFilter, SafetyShield, VectorSafetyShield, synthesize
from shields.runtime.safety_filter import MARGIN

CHANNEL = Channel(loss=0.3, quantization_step=0.01, send_period=2, delay=2)
REPEATS = 20
# Steps are timed in many short blocks: the fastest is one that nothing else interrupted.
BLOCKS = 60
REASONS = ("safe", "projected", "fallback")


class ConicFilter:
    """The same projection solved per step: minimize |u - proposed|^2 in the test and the limits (DPP, Clarabel)."""

    def __init__(self, shield: SafetyFilter) -> None:
        n, m = shield.plant.n, shield.plant.m
        self.shield, self.u = shield, cp.Variable(m)
        self.proposed, self.offset = cp.Parameter(m), cp.Parameter(n)
        self.effect, self.radius = cp.Parameter((n, m)), cp.Parameter()
        reached = cp.norm(self.offset + self.effect @ self.u)
        constraints = [reached <= self.radius - MARGIN, cp.abs(self.u) <= shield.plant.u_max]
        self.problem = cp.Problem(cp.Minimize(cp.sum_squares(self.u - self.proposed)), constraints)

    def decide(self, estimate: np.ndarray, error_shape: np.ndarray, proposed: np.ndarray) -> np.ndarray:
        test, plant = self.shield.test, self.shield.plant
        predicted = outer_sum(test.state_rows @ error_shape @ test.state_rows.T, test.D, np.eye(plant.n))
        values, axes = np.linalg.eigh(predicted)
        h = np.sqrt(values[-1])
        weighting = np.sqrt(h * (1.0 - h) / (h - values))[:, None] * axes.T
        self.proposed.value, self.radius.value = proposed, 1.0 - h
        self.offset.value, self.effect.value = weighting @ test.state_rows @ estimate, weighting @ test.input_rows
        self.problem.solve(solver=cp.CLARABEL)
        usable = self.problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE)
        return self.u.value if usable else np.clip(self.shield.certificate.K @ estimate, -plant.u_max, plant.u_max)


def random_plant(seed: int, n: int, m: int) -> LinearPlant:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    return LinearPlant(
        A=A * (0.85 / np.abs(np.linalg.eigvals(A)).max()),
        B=0.3 * rng.standard_normal((n, m)),
        box=np.eye(n),
        u_max=1.0,
        dt=0.1,
        gamma=1e-4,
        measurement_noise_cov=1e-4 * np.eye(n),
    )


def recorded(env: NCSEnv, shield: SafetyFilter, steps: int) -> list[tuple[np.ndarray, ...]]:
    """Estimate, error shape and proposal of every step of shielded episodes under a random policy."""
    env = SafetyShield(env, shield.certificate)
    rng, cases = np.random.default_rng(0), []
    while len(cases) < steps:
        _, info = env.reset(seed=len(cases))
        for _ in range(min(200, steps)):
            action = rng.uniform(-1, 1, shield.plant.m).astype(np.float32)
            cases.append((info["estimate"], info["error_shape"], shield.plant.u_max * action.astype(np.float64)))
            *_, info = env.step(action)
    return cases[:steps]


def microseconds(decide, cases: list, repeats: int) -> float:
    start = time.perf_counter()
    for _ in range(repeats):
        for case in cases:
            decide(*case)
    return 1e6 * (time.perf_counter() - start) / (repeats * len(cases))


def compare(name: str, env: NCSEnv, steps: int) -> None:
    """Prints a line for a plant: our time by outcome, the conic filter's, and whether the inputs agree."""
    shield = SafetyFilter(synthesize(env.plant, safe_set="ellipsoid"), env.plant)
    conic = ConicFilter(shield)
    cases = recorded(env, shield, steps)
    by_reason = defaultdict(list)
    for case in cases:
        by_reason[shield.decide(*case).reason].append(case)
    ours = microseconds(shield.decide, cases, REPEATS)
    parts = {reason: microseconds(shield.decide, some, REPEATS) for reason, some in by_reason.items()}
    conic.decide(*cases[0])  # canonicalizes
    theirs = microseconds(conic.decide, cases, 1)
    gaps = [0.0]
    for case in by_reason["projected"]:
        ours_far, theirs_far = (np.linalg.norm(u - case[2]) for u in (shield.decide(*case).input, conic.decide(*case)))
        gaps.append((ours_far - theirs_far) / max(theirs_far, 1e-3 * float(env.plant.u_max.max())))
    print(
        f"{name:24s}{ours:8.1f}"
        + "".join(f"{parts[reason]:10.1f}" if reason in parts else f"{'-':>10s}" for reason in REASONS)
        + f"{theirs:8.0f}{theirs / ours:7.0f}x{1 - len(by_reason['safe']) / len(cases):11.1%}{max(gaps):10.1e}",
        flush=True,
    )


def seconds_per_call(call, repeats: int) -> float:
    """Of the fastest block of calls."""
    blocks = []
    for _ in range(BLOCKS):
        start = time.perf_counter()
        for _ in range(repeats):
            call()
        blocks.append((time.perf_counter() - start) / repeats)
    return min(blocks)


class Stopwatch:
    """What is inside the shield, with the time that its steps take."""

    def __init__(self, env) -> None:
        self.step_inside, self.seconds = env.step, 0.0
        env.step = self.step

    def step(self, actions):
        start = time.perf_counter()
        result = self.step_inside(actions)
        self.seconds += time.perf_counter() - start
        return result


def added_by(shield, shape: tuple[int, ...], repeats: int) -> float:
    """Seconds that a shield adds to a step, in the fastest block of steps."""
    rng, watch, blocks = np.random.default_rng(0), Stopwatch(shield.env), []
    actions = rng.uniform(-1, 1, (100, *shape)).astype(np.float32)
    shield.reset(seed=0)
    for _ in range(BLOCKS):
        watch.seconds = spent = 0.0
        for step in range(repeats):
            start = time.perf_counter()
            truncated = shield.step(actions[step % 100])[3]
            spent += time.perf_counter() - start
            if truncated is True:
                shield.reset()
        blocks.append((spent - watch.seconds) / repeats)
    return min(blocks)


def compare_steps() -> None:
    """Prints what the scalar and the vector shield add to a step."""
    pendulum = gym.make("Pendulum-v1", max_episode_steps=10**9)
    pendulum.reset(seed=0)
    single = seconds_per_call(lambda: pendulum.step(np.zeros(1, np.float32)), 200)
    added = added_by(SafetyShield(gym.make("ncs_gym/TruckTrailerCruise-v0")), (1,), 200)
    print(f"one environment:  {1e6 * added:6.0f} us, {added / single:.2f} steps of Pendulum-v1")
    for count in (64, 1024):
        poles = gym.make_vec("CartPole-v1", num_envs=count, vectorization_mode="vector_entry_point")
        poles.reset(seed=0)
        actions = poles.action_space.sample()
        many = seconds_per_call(lambda poles=poles, actions=actions: poles.step(actions), 20)
        shield = VectorSafetyShield(gym.make_vec("ncs_gym/TruckTrailerCruise-v0", num_envs=count))
        added = added_by(shield, (count, 1), 20)
        print(f"{count:4d} environments:{1e6 * added:6.0f} us, {added / many:.2f} steps of the vector CartPole-v1")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=400)
    options = parser.parse_args()
    warnings.filterwarnings("ignore", "Solution may be inaccurate")
    print(f"{'':24s}{'our decision [us]':>38s}{'cvxpy':>8s}")
    print(
        f"{'plant':24s}{'mean':>8s}"
        + "".join(f"{reason:>10s}" for reason in REASONS)
        + f"{'[us]':>8s}{'ratio':>8s}{'overridden':>11s}{'too far':>10s}"
    )
    cruise = gym.make("ncs_gym/TruckTrailerCruise-v0").unwrapped
    compare("TruckTrailerCruise-v0", cruise, options.steps)
    for n, m in ((4, 1), (4, 2), (4, 3), (8, 3)):
        compare(f"random, n = {n}, m = {m}", NCSEnv(random_plant(n, n, m), CHANNEL), options.steps)
    print("what the shield adds to a step")
    compare_steps()


if __name__ == "__main__":
    main()
