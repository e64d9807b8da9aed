"""Mean return per episode behind the same shield (mode project): tuned agents against what needs no training.

    python benchmarks/tuned_agents.py [--env ncs_gym/CartPole-v0 ...] [--seeds 5] [--out runs/tuned_agents]

The tuned agent has the hyperparameters and steps of agents/tuned; with `--defaults` there is one with the defaults and
150,000 steps, too. The best linear controller is the one of benchmarks/linear_controllers.py with the highest return on
a seed of the search (benchmarks/tune_agents.py). Every policy plays 200 episodes per seed, the same for all policies,
of the seeds of `ncs compare --seed 2000000`; intervals are Student's over seeds. The last line of an environment pairs
the tuned agent with the best of those that need no training, seed by seed. What was measured is kept in OUT.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from linear_controllers import LinearController, linear_controllers
from tune_agents import EPISODES, SEARCH_SEED, mean_return, seeds_of, shielded_loop

from agents import LoopConfig, train, tuned_hyperparams, tuned_steps
from experiments.analysis.statistics import mean_interval
from ncs_gym.envs.env import ncs_env
from ncs_gym.registration import registered_ids

TABLE_SEED = 2_000_000
Policy = Callable[..., np.ndarray]
TUNED, DEFAULTS = "tuned agent", "agent, default settings"
DEFAULT_STEPS = 150_000


def random_actions(inputs: int, seed: int) -> Policy:
    rng = np.random.default_rng(seed)
    return lambda observations, infos: rng.uniform(-1.0, 1.0, (len(observations), inputs))


def best_linear(loop: LoopConfig) -> LinearController:
    """The best linear controller on the first evaluation seed of the search."""
    env, seed = ncs_env(gym.make(loop.env)), seeds_of(SEARCH_SEED, 0)[1]
    candidates = linear_controllers(env.plant, env.task)
    return max(candidates, key=lambda each: mean_return(loop, each.policy(env.plant), seed))


def policies(loop: LoopConfig, with_defaults: bool) -> dict[str, Callable[[int], Policy]]:
    """What makes the policy of a seed, by name."""
    env, linear = ncs_env(gym.make(loop.env)), best_linear(loop)
    plant, entries = env.plant, env.observation_space.shape[0] - env.plant.n
    certified = LinearController("K x_hat", loop.shield.certificate.K, np.zeros((plant.m, entries)))
    tuned, steps = tuned_hyperparams(loop.env), tuned_steps(loop.env)
    found: dict[str, Callable[[int], Policy]] = {TUNED: lambda seed: trained(loop, tuned, steps, seed)}
    if with_defaults:
        found[DEFAULTS] = lambda seed: trained(loop, {}, DEFAULT_STEPS, seed)
    found["random"] = lambda seed: random_actions(plant.m, seed)
    return found | {each.name: lambda seed, each=each: each.policy(plant) for each in (certified, linear)}


def trained(loop: LoopConfig, hyperparams: dict[str, Any], steps: int, seed: int) -> Policy:
    """An agent after its training."""
    agent = train(loop, steps, seed, hyperparams=hyperparams).agent
    return lambda observations, infos: agent.act(observations)


class Measurements:
    """Mean returns by policy and seed of an environment, kept in a file so that what was measured is not again."""

    def __init__(self, folder: Path, env_id: str) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._file, self._loop = folder / f"{env_id.rpartition('/')[2]}.json", shielded_loop(env_id)
        self.returns: dict[str, list[float]] = json.loads(self._file.read_text()) if self._file.exists() else {}

    def extend(self, seeds: int, with_defaults: bool) -> None:
        """Measures what is missing."""
        for name, make in policies(self._loop, with_defaults).items():
            returns = self.returns.setdefault(name, [])
            for index in range(len(returns), seeds):
                training_seed, evaluation_seed = seeds_of(TABLE_SEED, index)
                returns.append(mean_return(self._loop, make(training_seed), evaluation_seed))
                self._file.write_text(json.dumps(self.returns, indent=1) + "\n")


def with_interval(values: list[float], sign: str = "") -> str:
    low, high = mean_interval(values) or (float("nan"),) * 2
    return f"{np.mean(values):{sign}.2f} [{low:{sign}.2f}, {high:{sign}.2f}]"


def rows(env_id: str, returns: dict[str, list[float]]) -> list[str]:
    """The lines of a Markdown table of an environment."""
    others = [name for name in returns if name not in (TUNED, DEFAULTS)]
    best = max(others, key=lambda name: float(np.mean(returns[name])))
    gain = [one - other for one, other in zip(returns[TUNED], returns[best], strict=True)]
    lines = [f"| `{env_id}` | {name} | {with_interval(values)} |" for name, values in returns.items()]
    return [*lines, f"| `{env_id}` | {TUNED} - {best} | {with_interval(gain, '+')} |"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", nargs="+", default=registered_ids())
    parser.add_argument("--defaults", action="store_true")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("runs/tuned_agents"))
    options = parser.parse_args()
    print(f"{options.seeds} seeds, {EPISODES} episodes each\n\n| environment | policy | mean return |\n|---|---|---|")
    for env_id in options.env:
        measurements = Measurements(options.out, env_id)
        measurements.extend(options.seeds, options.defaults)
        print("\n".join(rows(env_id, measurements.returns)), flush=True)


if __name__ == "__main__":
    main()
