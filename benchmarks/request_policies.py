"""Compares policies that ask for samples: return, overridden share and violations against packets per step.

    python benchmarks/request_policies.py [--env ncs_gym/LaneKeepingOnRequest-v0] [--steps 100000] [--seeds 2]

A linear-quadratic regulator behind the shield proposes the inputs, and a policy asks: in every step, every few steps,
at random, when the newest sample is old and the last request could have arrived, when the proposed input has little
slack, or as PPO has learned. One more PPO learns inputs and requests. Where nobody asks, the contract forces a request
when it has to. Prints the table and the winner at the price of a packet, and draws returns against packets.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from agents import SB3VecEnv
from agents.evaluation import Policy
from experiments.baselines import tuned_weights
from experiments.baselines.controllers import controller
from experiments.baselines.requests import (
    Asking,
    RequestsOnly,
    acknowledged,
    at_random,
    best_period,
    every,
    played,
    slack,
    with_rule,
)
from experiments.terminal import text_table
from ncs_gym import NCSEnv, VectorRequestActions
from shields import Certificate, SafetyShield, VectorSafetyShield

# Settings of both PPO agents.
PPO_ENVS = 32
PPO_SETTINGS: dict[str, Any] = {
    "n_steps": 128,
    "batch_size": 512,
    "n_epochs": 5,
    "learning_rate": 1e-3,
    "gamma": 0.98,
    "policy_kwargs": {"net_arch": [64, 64]},
}
STYLES = {
    "period": ("#777777", "s"),
    "forced alone": ("#222222", "x"),
    "random": ("#bb8844", "v"),
    "acknowledged": ("#2266aa", "^"),
    "slack": ("#22884d", "D"),
    "PPO requests": ("#dd6677", "o"),
    "PPO both": ("#882255", "*"),
}


def environments(env_id: str, count: int, certificate: Certificate, cost: float) -> VectorRequestActions:
    return VectorRequestActions(VectorSafetyShield(gym.make_vec(env_id, num_envs=count), certificate), cost)


def trained(env: Any, steps: int, seed: int) -> Callable[[np.ndarray], np.ndarray]:
    """Returns what PPO has learned in so many steps, a function of observations."""
    normalized = VecNormalize(SB3VecEnv(env), gamma=PPO_SETTINGS["gamma"])
    model = PPO("MlpPolicy", normalized, seed=seed, device="cpu", **PPO_SETTINGS).learn(steps)
    return lambda observations: model.predict(normalized.normalize_obs(observations), deterministic=True)[0]


def learned_requests(env_id: str, certificate: Certificate, control: Policy, arguments: Any, seed: int) -> Any:
    """Returns a function that makes the policy for environments: requests by PPO, inputs by the controller."""
    env = environments(env_id, PPO_ENVS, certificate, arguments.cost)
    act = trained(RequestsOnly(Asking(env, control), env), arguments.steps, seed)

    def policy_for(env: VectorRequestActions) -> Policy:
        only = RequestsOnly(Asking(env, control), env)
        return lambda observations, info: only.complete(act(only.seen(observations, info)))

    return policy_for


def learned_both(env_id: str, certificate: Certificate, arguments: Any, seed: int) -> Any:
    """Returns a function that makes the policy for environments: requests and inputs by PPO."""
    act = trained(environments(env_id, PPO_ENVS, certificate, arguments.cost), arguments.steps, seed)
    return lambda env: lambda observations, info: act(observations)


def half_width(returns: np.ndarray) -> float:
    return float(1.96 * returns.std(ddof=1) / np.sqrt(len(returns)))


def draw(results: dict[str, tuple[float, float, float]], env_id: str, out: str) -> None:
    """Draws packets per step, mean return and its half-width of each policy, a line through those of one kind."""
    fig, axis = plt.subplots(figsize=(7.0, 4.2), layout="constrained")
    for kind, (color, marker) in STYLES.items():
        mine = {name.removeprefix(kind).strip(" ,"): point for name, point in results.items() if name.startswith(kind)}
        if mine:
            x, y, width = np.array(sorted(mine.values())).T
            line = "none" if kind.startswith("PPO") else "-"
            axis.errorbar(x, y, width, color=color, marker=marker, ls=line, lw=0.8, capsize=2, label=kind)
        for value, (packets, mean, _) in mine.items():
            text = value.partition(",")[0]
            if not text.startswith("seed"):
                place = (4, 5) if kind == "period" else (4, -11)
                axis.annotate(text, (packets, mean), place, textcoords="offset points", fontsize=7, color=color)
    axis.set(xlabel="packets per step", ylabel="return of an episode", title=env_id.removeprefix("ncs_gym/"))
    axis.grid(alpha=0.3)
    axis.legend(loc="lower right", fontsize=8)
    fig.savefig(out, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="ncs_gym/LaneKeepingOnRequest-v0")
    parser.add_argument("--episodes", type=int, default=400, help="of each policy")
    parser.add_argument("--cost", type=float, default=0.1, help="of a packet, in units of the reward")
    parser.add_argument("--steps", type=int, default=100_000, help="of each training; 0 leaves out PPO")
    parser.add_argument("--seeds", type=int, default=2, help="of each training")
    parser.add_argument("--out", default="requests.png", help="the figure")
    arguments = parser.parse_args()
    env_id, begun = arguments.env, time.perf_counter()
    shield = SafetyShield(gym.make(env_id))
    single, certificate = shield.unwrapped, shield.certificate
    assert isinstance(single, NCSEnv)
    assert single.contract is not None
    weights = tuned_weights(env_id.replace("OnRequest", ""), "lqr+shielded")
    control = controller("lqr", single, certificate.K, 0, weights)
    best = best_period(single.channel, single.contract)
    rules = {"period 1": every(1), f"period {best}, the best": every(best), "forced alone": at_random(0.0)}
    rules |= {f"random {share:g}": at_random(share) for share in (0.1, 0.2, 0.4)}
    rules |= {f"acknowledged {age}": acknowledged(age) for age in (1, 2, 3, 4)}
    rules |= {f"slack {threshold:g}": slack(threshold) for threshold in (0.0, 0.1, 0.3, 0.5)}
    policies: dict[str, Callable[[VectorRequestActions], Policy]] = {
        name: lambda env, rule=rule: with_rule(Asking(env, control), rule) for name, rule in rules.items()
    }
    trainings = 0.0
    for seed in range(arguments.seeds if arguments.steps else 0):
        start = time.perf_counter()
        policies[f"PPO requests, seed {seed}"] = learned_requests(env_id, certificate, control, arguments, seed)
        policies[f"PPO both, seed {seed}"] = learned_both(env_id, certificate, arguments, seed)
        trainings += time.perf_counter() - start
    points, worth = {}, {}
    rows = [
        ["policy", "packets", "forced", "return", "", "less price", "overridden", "violations", "unproved", "oldest"]
    ]
    for name, policy_for in policies.items():
        env = environments(env_id, arguments.episodes, certificate, arguments.cost)
        result = played(env, policy_for(env), seed=1)
        mean, steps = float(result.returns.mean()), env.unwrapped.max_episode_steps
        points[name] = result.packets, mean, half_width(result.returns)
        worth[name] = mean - arguments.cost * result.packets * steps
        row = [
            name,
            f"{result.packets:.3f}",
            f"{result.forced:.1%}",
            f"{mean:.1f}",
            f"+- {points[name][2]:.1f}",
        ]
        row += [f"{worth[name]:.1f}", f"{result.overridden:.1%}", str(result.violations), str(result.unproved)]
        rows.append([*row, str(result.oldest)])
    print(f"{env_id}: {arguments.episodes} episodes of each policy, max_age = {single.contract.max_age}.")
    print(single.channel.description)
    print(f"packets per step; a packet costs {arguments.cost:g} in the column less price\n")
    print(text_table(rows, rules=(1,)))
    winner = max(worth, key=lambda name: worth[name])
    print(f"\nAt this price the winner is {winner}: {worth[winner]:.1f}.")
    if arguments.steps:
        print(f"PPO: {arguments.steps:,} steps for each seed and kind, {trainings:.0f} s in all.")
    print(f"{time.perf_counter() - begun:.0f} s in all.")
    draw(points, env_id, arguments.out)


if __name__ == "__main__":
    main()
