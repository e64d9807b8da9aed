"""Trains the small agents that come with the package, one per registered id, behind the shield (mode project).

    python benchmarks/pretrained_agents.py [--env ncs_gym/CartPole-v0 ...] [--out agents/trained]

PPO with the hyperparameters and steps of agents/tuned, or the defaults and 150,000 steps, and networks of two layers of
32. Each agent is evaluated on 200 episodes and saved with its card and its certificate; a line says how long that took.
The seeds are those of `ncs compare --seed 3000000`, which no search and no table has.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from tune_agents import EPISODES, seeds_of, shielded_loop

from agents import evaluate, train, tuned_hyperparams, tuned_steps
from agents.hyperparams import DEFAULTS, with_changes
from ncs_gym.registration import registered_ids

SEED, STEPS = 3_000_000, 150_000
NETWORKS = {"policy_kwargs": {"net_arch": [32, 32]}}


def train_and_save(env_id: str, out: Path) -> None:
    """Trains, evaluates and saves the agent of an environment, and prints a line about it."""
    started = time.process_time()
    loop, (training_seed, evaluation_seed) = shielded_loop(env_id), seeds_of(SEED, 0)
    hyperparams = with_changes(tuned_hyperparams(env_id) or DEFAULTS["PPO"], NETWORKS)
    trained = train(loop, tuned_steps(env_id) or STEPS, training_seed, hyperparams=hyperparams)
    agent = trained.agent
    evaluation = evaluate(loop, lambda observations, infos: agent.act(observations), EPISODES, evaluation_seed)
    folder = out / env_id.rpartition("/")[2]
    agent.save(folder, loop.shield, evaluation)
    size = sum(file.stat().st_size for file in folder.iterdir())
    mean = np.mean([each.episode_return for each in evaluation.episodes])
    violations = trained.violation_steps + sum(each.violation_steps for each in evaluation.episodes)
    print(
        f"{env_id}: return {mean:.2f}, {violations} violating steps, {size / 1e3:.0f} kB, "
        f"{time.process_time() - started:.0f} s of CPU",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", nargs="+", default=[each for each in registered_ids() if each.startswith("ncs_gym/")])
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parent.parent / "agents" / "trained")
    options = parser.parse_args()
    for env_id in options.env:
        train_and_save(env_id, options.out)


if __name__ == "__main__":
    main()
