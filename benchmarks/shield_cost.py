"""What the shield costs in time: steps per CPU second without it, behind the one-step test and behind lookahead.

python benchmarks/shield_cost.py [--seconds 1]

The last column is mode lookahead that asks for plans of so many steps if the network goes silent.

Actions are random; each row is measured once for one environment and once for 64 side by side, one after the other on
one core.
"""

import argparse
import time
from typing import Any

import gymnasium as gym
import numpy as np

import ncs_gym
from shields import SafetyShield, VectorSafetyShield

assert ncs_gym  # registers the ids
NAMES = ("TruckTrailerCruise-v0", "CartPole-v0", "BatchReactor-v0", "Convoy-v0")
ASKED = 10
SHIELDS: dict[str, dict[str, Any] | None] = {
    "no shield": None,
    "project": {"mode": "project"},
    "lookahead": {"mode": "lookahead"},
    f"asks for {ASKED}": {"mode": "lookahead", "least_safe_steps": ASKED},
}
COUNT = 64


def steps_per_second(env: gym.Env | gym.vector.VectorEnv, count: int, seconds: float) -> float:
    """Returns how many steps an environment, or `count` together, takes in a CPU second of random actions."""
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(100)]
    env.reset(seed=0)
    steps, start = 0, None
    while start is None or time.process_time() - start < seconds:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if count == 1 and (terminated or truncated):
                env.reset()
        if start is None:  # the first actions are for what is computed once
            start = time.process_time()
        else:
            steps += len(actions) * count
    return steps / (time.process_time() - start)


def column(name: str, shield: dict[str, Any] | None, seconds: float) -> list[float]:
    """Returns the steps per second of one environment and of `COUNT`, behind a shield of these settings, if any."""
    single, many = gym.make(f"ncs_gym/{name}"), gym.make_vec(f"ncs_gym/{name}", num_envs=COUNT)
    if shield is not None:
        single = SafetyShield(single, on_unproved="ignore", **shield)
        many = VectorSafetyShield(many, on_unproved="ignore", **shield)
    return [steps_per_second(single, 1, seconds), steps_per_second(many, COUNT, seconds)]


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=1.0, help="length of a measurement [s]")
    seconds = parser.parse_args().seconds
    print(f"{'steps per second':24}" + "".join(f"{each:>12}" for each in SHIELDS))
    for name in NAMES:
        rates = np.array([column(name, shield, seconds) for shield in SHIELDS.values()])
        for number, label in enumerate((name, f"  {COUNT} side by side")):
            print(f"{label:24}" + "".join(f"{rate:12,.0f}" for rate in rates[:, number]), flush=True)


if __name__ == "__main__":
    main()
