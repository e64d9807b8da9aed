"""Searches PPO's hyperparameters for each registered environment, behind its shield (mode project).

    python benchmarks/tune_agents.py [--env ncs_gym/CartPole-v0 ...] [--candidates 6] [--finalists 2] [--seeds 1]
    python benchmarks/tune_agents.py --write

A random search in two rounds: every candidate is trained once with 150,000 steps, the best ones `--seeds` times more,
on other seeds, with the steps that belong to the environment; those with the highest mean return of these last
trainings are chosen. The first candidate is the defaults, the second a guess by hand, the others are drawn
from `SPACE`. Seeds are those of `ncs compare --seed 1000000`, so that neither the seeds of a study (`--seed 0`) nor
those of the table (benchmarks/tuned_agents.py) were searched on. Every result is a line of OUT/results.jsonl: started
again, the search continues where it stopped. `--write` also writes what was chosen to agents/tuned/ppo.json.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from agents import LoopConfig, ShieldSettings, evaluate, train
from agents.hyperparams import DEFAULTS, complete_hyperparams
from ncs_gym.envs.env import ncs_env
from ncs_gym.registration import registered_ids
from shields import certificate_for

TUNED = Path(__file__).resolve().parent.parent / "agents" / "tuned" / "ppo.json"
SEARCH_SEED = 1_000_000
EPISODES = 200
# Steps of the first round and of a training; where more steps were seen to help, four times as many.
STEPS, MORE_STEPS = 150_000, 600_000
LONGER = ("ncs_gym/CartPole-v0", "ncs_gym/CartPoleTwoWay-v0", "ncs_gym/CartPoleNonlinear-v0")
# Random stream of each environment's candidates, so that they stay the same when further environments are registered.
STREAMS = {
    "ncs_gym/TruckTrailer-v0": 0,
    "ncs_gym/TruckTrailerCruise-v0": 1,
    "ncs_gym/TruckTrailerCruiseTwoWay-v0": 2,
    "ncs_gym/CartPole-v0": 3,
    "ncs_gym/CartPoleTwoWay-v0": 4,
    "ncs_gym/BatchReactor-v0": 5,
    "ncs_gym/Pendulum-v0": 6,
    "ncs_gym/CartPoleNonlinear-v0": 7,
    "ncs_gym/InvertedPendulum-v0": 7,
}
GUESS = dict(n_envs=128, n_steps=32, gamma=0.98, gae_lambda=0.95)
# In the order in which they are drawn; `_NETWORKS` are in `policy_kwargs`.
SPACE: dict[str, tuple[Any, ...]] = {
    "n_envs": (128,),
    "n_steps": (16, 32),
    "batch_size": (512, 1024, 2048),
    "n_epochs": (5, 10, 20),
    "learning_rate": ("lin_0.001", "lin_0.002", "lin_0.003", "lin_0.005"),
    "gamma": (0.9, 0.95, 0.98, 0.99),
    "gae_lambda": (0.9, 0.95, 0.98),
    "log_std_init": (-1.5, -0.7, -0.3),
    "net_arch": ([64, 64], [128, 128]),
    "ent_coef": (0.0, 1e-3),
    "normalize": (True, True, {"norm_reward": False}),
}
_NETWORKS = ("log_std_init", "net_arch")


def shielded_loop(env_id: str) -> LoopConfig:
    """The environment behind the shield of a synthesized certificate."""
    env = ncs_env(gym.make(env_id))
    return LoopConfig(env=env_id, shield=ShieldSettings(certificate_for(env.plant, env.certificate_contract)))


def steps_of(env_id: str) -> int:
    """Steps of a training in an environment."""
    return MORE_STEPS if env_id in LONGER else STEPS


def seeds_of(experiment_seed: int, index: int) -> tuple[int, int]:
    """Seeds of training and of evaluation of one run, as `ncs compare` derives them."""
    first, second = np.random.SeedSequence([experiment_seed, index]).generate_state(2)
    return int(first >> 1), int(second >> 1)


def mean_return(loop: LoopConfig, policy: Callable[..., np.ndarray], seed: int, episodes: int = EPISODES) -> float:
    """Mean return of a policy over the episodes of a seed."""
    return float(np.mean([each.episode_return for each in evaluate(loop, policy, episodes, seed).episodes]))


def trained_return(
    loop: LoopConfig, hyperparams: dict[str, Any], steps: int, experiment_seed: int, index: int
) -> float:
    """Mean return of an agent after its training."""
    training_seed, evaluation_seed = seeds_of(experiment_seed, index)
    agent = train(loop, steps, training_seed, hyperparams=hyperparams).agent
    return mean_return(loop, lambda observations, infos: agent.act(observations), evaluation_seed)


def candidate(env_id: str, number: int) -> dict[str, Any]:
    """All hyperparameters of a number: the defaults, the guess, then random ones."""
    if number < 2:
        return complete_hyperparams("PPO", ({}, GUESS)[number])
    rng = np.random.default_rng([SEARCH_SEED, STREAMS[env_id], number])
    drawn = {name: values[rng.integers(len(values))] for name, values in SPACE.items()}
    return complete_hyperparams("PPO", drawn | {"policy_kwargs": {name: drawn.pop(name) for name in _NETWORKS}})


class Results:
    """Returns by environment, hyperparameters, steps and run, kept in a file as they come."""

    def __init__(self, file: Path) -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        self._file = file
        lines = file.read_text().splitlines() if file.exists() else []
        self._known = {self._key(entry): entry["return"] for entry in map(json.loads, lines)}

    @staticmethod
    def _key(entry: dict[str, Any]) -> str:
        return json.dumps({name: entry[name] for name in ("env", "hyperparams", "steps", "run")}, sort_keys=True)

    def of(self, loop: LoopConfig, hyperparams: dict[str, Any], steps: int, run: int) -> float:
        """The return of a training, which is run unless it was before."""
        entry = {"env": loop.env, "hyperparams": hyperparams, "steps": steps, "run": run}
        if (key := self._key(entry)) not in self._known:
            self._known[key] = trained_return(loop, hyperparams, steps, SEARCH_SEED, run)
            with self._file.open("a") as file:
                file.write(json.dumps(entry | {"return": self._known[key]}) + "\n")
        return self._known[key]


def search(env_id: str, results: Results, candidates: int, finalists: int, seeds: int) -> dict[str, Any]:
    """Prints both rounds and returns the chosen hyperparameters."""
    loop, steps = shielded_loop(env_id), steps_of(env_id)
    chosen = [candidate(env_id, number) for number in range(candidates)]
    first = [results.of(loop, each, STEPS, 0) for each in chosen]
    order = sorted(range(candidates), key=lambda number: -first[number])
    shown = ", ".join(f"#{number} {first[number]:.2f}" for number in order)
    print(f"{env_id}, {STEPS} steps: {shown}", flush=True)
    last = {
        number: [results.of(loop, chosen[number], steps, run) for run in range(1, 1 + seeds)]
        for number in order[:finalists]
    }
    shown = ", ".join(f"#{number} {np.mean(each):.2f} {np.round(each, 2)}" for number, each in last.items())
    print(f"  {steps} steps: {shown}", flush=True)
    best = max(last, key=lambda number: np.mean(last[number]))
    print(f"  chosen: #{best}, {changes(chosen[best])}", flush=True)
    return chosen[best]


def changes(hyperparams: dict[str, Any]) -> dict[str, Any]:
    """The hyperparameters that differ from the defaults."""
    return {name: value for name, value in hyperparams.items() if value != DEFAULTS["PPO"][name]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", nargs="+", default=registered_ids())
    parser.add_argument("--candidates", type=int, default=6)
    parser.add_argument("--finalists", type=int, default=2)
    parser.add_argument("--seeds", type=int, default=1, help="trainings of each finalist in the last round")
    parser.add_argument("--out", type=Path, default=Path("runs/tune"))
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    results = Results(options.out / "results.jsonl")
    size = (options.candidates, options.finalists, options.seeds)
    found = {each: search(each, results, *size) for each in options.env}
    if options.write:
        known = json.loads(TUNED.read_text()) if TUNED.exists() else {}
        known |= {env_id: {"n_timesteps": steps_of(env_id)} | chosen for env_id, chosen in found.items()}
        TUNED.write_text(json.dumps(known, indent=1) + "\n")


if __name__ == "__main__":
    main()
