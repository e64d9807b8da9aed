"""Searches PPO's settings for each registered environment, behind its shield (mode project).

    python benchmarks/tune_agents.py [--env ncs_gym/CartPole-v0 ...] [--candidates 6] [--finalists 2] [--seeds 1]
    python benchmarks/tune_agents.py --write

A random search in two rounds: every candidate is trained once with 150,000 steps, the best ones `--seeds` times more,
on other seeds, with the steps that belong to the environment; the settings with the highest mean return of these last
trainings are chosen. The first candidate is the default settings, the second a guess by hand, the others are drawn
from `SPACE`. Seeds are those of `ncs compare --seed 1000000`, so that neither the seeds of a study (`--seed 0`) nor
those of the table (benchmarks/tuned_agents.py) were searched on. Every result is a line of OUT/results.jsonl: started
again, the search continues where it stopped. `--write` also writes the chosen settings to agents/tuned/ppo.json.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from agents import LoopConfig, PPOSettings, ShieldSettings, evaluate, train
from ncs_gym.envs.env import ncs_env
from ncs_gym.registration import registered_ids
from shields.runtime.wrapper import certificate_for

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
SPACE: dict[str, tuple[Any, ...]] = {
    "envs": (128,),
    "rollout": (16, 32),
    "batch_size": (512, 1024, 2048),
    "epochs": (5, 10, 20),
    "learning_rate": (1e-3, 2e-3, 3e-3, 5e-3),
    "discount": (0.9, 0.95, 0.98, 0.99),
    "gae_lambda": (0.9, 0.95, 0.98),
    "log_std": (-1.5, -0.7, -0.3),
    "width": (64, 128),
    "entropy": (0.0, 1e-3),
    "normalize_rewards": (True, True, False),
}


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


def trained_return(loop: LoopConfig, settings: PPOSettings, steps: int, experiment_seed: int, index: int) -> float:
    """Mean return of an agent after its training."""
    training_seed, evaluation_seed = seeds_of(experiment_seed, index)
    agent = train(loop, steps, training_seed, settings=settings).agent
    return mean_return(loop, lambda observations, infos: agent.act(observations), evaluation_seed)


def candidate(env_id: str, number: int) -> PPOSettings:
    """The settings of a number: the defaults, the guess, then random ones."""
    if number < 2:
        return ({}, GUESS)[number]
    rng = np.random.default_rng([SEARCH_SEED, STREAMS[env_id], number])
    return PPOSettings(**{name: values[rng.integers(len(values))] for name, values in SPACE.items()})


class Results:
    """Returns by environment, settings, steps and run, kept in a file as they come."""

    def __init__(self, file: Path) -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        self._file = file
        lines = file.read_text().splitlines() if file.exists() else []
        self._known = {self._key(entry): entry["return"] for entry in map(json.loads, lines)}

    @staticmethod
    def _key(entry: dict[str, Any]) -> str:
        return json.dumps({name: entry[name] for name in ("env", "settings", "steps", "run")}, sort_keys=True)

    def of(self, loop: LoopConfig, settings: PPOSettings, steps: int, run: int) -> float:
        """The return of a training, which is run unless it was before."""
        entry = {"env": loop.env, "settings": asdict(settings), "steps": steps, "run": run}
        if (key := self._key(entry)) not in self._known:
            self._known[key] = trained_return(loop, settings, steps, SEARCH_SEED, run)
            with self._file.open("a") as file:
                file.write(json.dumps(entry | {"return": self._known[key]}) + "\n")
        return self._known[key]


def search(env_id: str, results: Results, candidates: int, finalists: int, seeds: int) -> PPOSettings:
    """Prints both rounds and returns the chosen settings."""
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


def changes(settings: PPOSettings) -> dict[str, Any]:
    """The settings that differ from the defaults."""
    return {name: value for name, value in asdict(settings).items() if value != getattr({}, name)}


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
        known |= {env_id: {"steps": steps_of(env_id)} | asdict(settings) for env_id, settings in found.items()}
        TUNED.write_text(json.dumps(known, indent=1) + "\n")


if __name__ == "__main__":
    main()
