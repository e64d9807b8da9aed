"""Trains the small agents that come with the package, one per registered id, behind the shield (mode project).

    python benchmarks/pretrained_agents.py [--env ncs_gym/CartPole-v0 ...] [--out agents/trained]
        [--evaluate-only | --table]

PPO with the hyperparameters and steps of agents/tuned, or the defaults and 150,000 steps, and networks of two layers of
32. Each agent is evaluated on 200 episodes and saved with its card; a line says how long that took. Its certificate is
the one in shields/certificates. --evaluate-only evaluates the agents that are there and writes their cards again.
--table prints them beside the best linear controller (benchmarks/linear_controllers.py) behind the same shield, on the
same episodes, without those whose packages are missing.
The seeds are those of `ncs compare --seed 3000000`, which no search and no table has.
"""

from __future__ import annotations

import argparse
import time
from contextlib import suppress
from pathlib import Path

import gymnasium as gym
import numpy as np
from tune_agents import EPISODES, seeds_of, shielded_loop
from tuned_agents import best_linear, with_interval

from agents import Agent, evaluate, train, tuned_hyperparams, tuned_steps
from agents.hyperparams import DEFAULTS, with_changes
from ncs_gym.envs.env import ncs_env
from ncs_gym.registration import registered_ids

SEED, STEPS = 3_000_000, 150_000
NETWORKS = {"policy_kwargs": {"net_arch": [32, 32]}}


def train_and_save(env_id: str, folder: Path, evaluate_only: bool) -> None:
    """Trains (unless it is there), evaluates and saves the agent of an environment, and prints a line about it."""
    started, violations = time.process_time(), 0
    loop, (training_seed, evaluation_seed) = shielded_loop(env_id), seeds_of(SEED, 0)
    if evaluate_only:
        agent = Agent.load(folder)
    else:
        hyperparams = with_changes(tuned_hyperparams(env_id) or DEFAULTS["PPO"], NETWORKS)
        trained = train(loop, tuned_steps(env_id) or STEPS, training_seed, hyperparams=hyperparams)
        agent, violations = trained.agent, trained.violation_steps
    evaluation = evaluate(loop, lambda observations, infos: agent.act(observations), EPISODES, evaluation_seed)
    agent.save(folder, loop.shield, evaluation)
    refer_to_package(folder)
    size = sum(file.stat().st_size for file in folder.iterdir())
    mean = np.mean([each.episode_return for each in evaluation.episodes])
    violations += sum(each.violation_steps for each in evaluation.episodes)
    print(
        f"{env_id}: return {mean:.2f}, {violations} violating steps, {size / 1e3:.0f} kB, "
        f"{time.process_time() - started:.0f} s of CPU",
        flush=True,
    )


def row(env_id: str, folder: Path) -> str:
    """The line of a Markdown table about an agent and the best linear controller."""
    loop, (_, seed) = shielded_loop(env_id), seeds_of(SEED, 0)
    agent, plant = Agent.load(folder), ncs_env(gym.make(env_id)).plant
    both = [
        evaluate(loop, policy, EPISODES, seed).episodes
        for policy in (lambda observations, infos: agent.act(observations), best_linear(loop).policy(plant))
    ]
    returns = np.array([[each.episode_return for each in episodes] for episodes in both])
    overridden = [sum(e.interventions for e in episodes) / sum(e.steps for e in episodes) for episodes in both]
    cells = [
        f"{mean:.2f} ({100.0 * share:.1f} %)" for mean, share in zip(returns.mean(axis=1), overridden, strict=True)
    ]
    return f"| `{env_id}` | {' | '.join(cells)} | {with_interval((returns[0] - returns[1]).tolist(), '+')} |"


def refer_to_package(folder: Path) -> None:
    """Leaves out the copy of the certificate, and has the card say where the package has it."""
    (folder / "certificate.json").unlink()
    card = folder / "README.md"
    text = card.read_text()
    changes = {
        "`certificate.json`, SHA-256": "The certificate that `shields.certificate_for` returns, SHA-256",
        "; `ncs verify certificate.json`": "",
        "import Certificate\n\nagent = ": 'import certificate_for\n\nenv = gym.make("{env}").unwrapped\nagent = ',
        'Certificate.load("certificate.json")': "certificate_for(env.plant, env.certificate_contract)",
        "```python\nfrom agents": "```python\nimport gymnasium as gym\n\nfrom agents",
    }
    for old, new in changes.items():
        if old not in text:
            raise ValueError(f"the card of {folder} has no {old!r}")
        text = text.replace(old, new.format(env=f"ncs_gym:ncs_gym/{folder.name}") if "{env}" in new else new)
    card.write_text(text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", nargs="+", default=[each for each in registered_ids() if each.startswith("ncs_gym/")])
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parent.parent / "agents" / "trained")
    parser.add_argument("--evaluate-only", action="store_true")
    parser.add_argument("--table", action="store_true")
    options = parser.parse_args()
    if options.table:
        print("| environment | agent (overridden) | best linear controller | difference, paired |\n|---|---|---|---|")
    for env_id in options.env:
        folder = options.out / env_id.rpartition("/")[2]
        if not options.table:
            train_and_save(env_id, folder, options.evaluate_only)
            continue
        with suppress(ModuleNotFoundError):
            print(row(env_id, folder), flush=True)


if __name__ == "__main__":
    main()
