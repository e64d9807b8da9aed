"""Mean return per episode behind the same shield (mode project): tuned agents against what needs no training.

    python benchmarks/tuned_agents.py [--env ncs_gym/CartPole-v0 ...] [--seeds 5] [--out runs/tuned_agents]

Agents are trained with 150,000 steps and the settings of agents/tuned, or with the defaults. The best linear controller
is the one of benchmarks/linear_controllers.py with the highest return on the seeds of the search
(benchmarks/tune_agents.py). Every policy plays 200 episodes per seed, the same for all policies, of the seeds of `ncs
compare --seed 2000000`; intervals are Student's over seeds. "agent - best other" pairs the tuned agent with the best of
the others, seed by seed.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import numpy as np
from linear_controllers import LinearController, linear_controllers
from tune_agents import EPISODES, SEARCH_SEED, STEPS, mean_return, seeds_of, shielded_loop

from agents import ControlLoop, PPOSettings, train, tuned_settings
from experiments.analysis.statistics import mean_interval
from ncs_gym.envs.env import ncs_env
from ncs_gym.registration import registered_ids

TABLE_SEED = 2_000_000
TRAINED = {"tuned agent": tuned_settings, "agent, default settings": lambda env_id: PPOSettings()}


def random_actions(inputs: int, seed: int) -> Callable[..., np.ndarray]:
    rng = np.random.default_rng(seed)
    return lambda observations, infos: rng.uniform(-1.0, 1.0, (len(observations), inputs))


def best_linear(loop: ControlLoop) -> LinearController:
    """The best linear controller on the first evaluation seed of the search."""
    env, seed = ncs_env(gym.make(loop.env)), seeds_of(SEARCH_SEED, 0)[1]
    candidates = linear_controllers(env.plant, env.task)
    return max(candidates, key=lambda each: mean_return(loop, each.policy(env.plant), seed))


def untrained_returns(loop: ControlLoop, seeds: int) -> dict[str, list[float]]:
    """Mean returns by policy and seed of what needs no training."""
    env, linear = ncs_env(gym.make(loop.env)), best_linear(loop)
    plant, entries = env.plant, env.observation_space.shape[0] - env.plant.n
    certified = LinearController("K x_hat", loop.shield.certificate.K, np.zeros((plant.m, entries)))
    found: dict[str, list[float]] = {"random": [], certified.name: [], linear.name: []}
    for index in range(seeds):
        seed = seeds_of(TABLE_SEED, index)[1]
        found["random"].append(mean_return(loop, random_actions(plant.m, seed), seed))
        for controller in (certified, linear):
            found[controller.name].append(mean_return(loop, controller.policy(plant), seed))
    return found


def agent_returns(loop: ControlLoop, settings: PPOSettings, seeds: int) -> list[float]:
    """Mean returns of agents by seed of their training and evaluation."""
    returns = []
    for index in range(seeds):
        training_seed, evaluation_seed = seeds_of(TABLE_SEED, index)
        agent = train(loop, STEPS, training_seed, settings=settings).agent
        returns.append(mean_return(loop, lambda observations, infos, a=agent: a.act(observations), evaluation_seed))
    return returns


def measured(env_id: str, seeds: int, folder: Path) -> dict[str, list[float]]:
    """Mean returns by policy and seed, from the file of an earlier run if there is one."""
    file = folder / f"{env_id.rpartition('/')[2]}-{seeds}.json"
    known = json.loads(file.read_text()) if file.exists() else {}
    loop = shielded_loop(env_id)
    if not known:
        known = untrained_returns(loop, seeds)
    for name, settings in TRAINED.items():
        if name not in known:
            known[name] = agent_returns(loop, settings(env_id), seeds)
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(json.dumps(known, indent=1) + "\n")
    return known


def with_interval(values: list[float], sign: str = "") -> str:
    low, high = mean_interval(values) or (float("nan"),) * 2
    return f"{np.mean(values):{sign}.2f} [{low:{sign}.2f}, {high:{sign}.2f}]"


def rows(env_id: str, returns: dict[str, list[float]]) -> list[str]:
    """The lines of a Markdown table of an environment."""
    others = [name for name in returns if name not in TRAINED]
    best = max(others, key=lambda name: float(np.mean(returns[name])))
    gain = [one - other for one, other in zip(returns["tuned agent"], returns[best], strict=True)]
    lines = [f"| `{env_id}` | {name} | {with_interval(returns[name])} |" for name in [*TRAINED, *others]]
    return [*lines, f"| `{env_id}` | tuned agent - {best} | {with_interval(gain, '+')} |"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", nargs="+", default=registered_ids())
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("runs/tuned_agents"))
    options = parser.parse_args()
    print(f"{options.seeds} seeds, {EPISODES} episodes each\n\n| environment | policy | mean return |\n|---|---|---|")
    for env_id in options.env:
        print("\n".join(rows(env_id, measured(env_id, options.seeds, options.out))), flush=True)


if __name__ == "__main__":
    main()
