"""Tunes every arm of `ncs study` by itself, each behind its own filter, with the same budget.

    python benchmarks/tune_arms.py [--env ncs_gym/CSTR-v0 ...] [--arms mpc lookahead ...] [--write]

Of a regulator a grid of weights is tried, of an agent `CANDIDATES` of PPO's hyperparameters and then, with the best of
the first three, two more: prices of a violation, settings of PPO-Lagrangian, or hyperparameters where an arm has
neither. Everything happens on the environment's own channel, on the same seeds and episodes for all; the highest mean
return is chosen (a violation ends an episode, and with it what it would still have earned). The seed is that of no
study. Every result is a line of OUT: started again, the search continues where it stopped. `--write` writes what was
chosen to experiments/baselines/tuned.json.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from agents import evaluate, train
from agents.hyperparams import DEFAULTS, with_changes
from agents.loop import LagrangianSettings, LoopConfig
from experiments.baselines import RegulatorWeights, controller
from experiments.runs.arms import Arm
from experiments.settings import CompareSettings
from experiments.settings.learning import NETWORK_ENVS, REGULATED_ARMS, TRAINED_ARMS
from ncs_gym.envs.env import ncs_env
from shields import Certificate, certificate_for

TUNED = Path(__file__).resolve().parent.parent / "experiments" / "baselines" / "tuned.json"
SEARCH_SEED = 1_000_000
GRID = [RegulatorWeights(effort, state) for effort, state in product((0.003, 0.03, 0.3, 3.0), (0.003, 0.03, 0.3))]
CANDIDATES: tuple[dict[str, Any], ...] = (
    {},
    {"gamma": 0.98, "gae_lambda": 0.95},
    {"n_envs": 16, "n_steps": 128, "batch_size": 512},
)
# Two more for each arm; the price of the first three is 10, and PPO-Lagrangian has its defaults there.
PRICES = {"violation_penalty": 10.0}
MORE: dict[str, tuple[dict[str, Any], ...]] = {
    "penalized": ({"violation_penalty": 3.0}, {"violation_penalty": 30.0}),
    "lagrangian": ({"lagrangian": {"learning_rate": 0.5}}, {"lagrangian": {"multiplier": 10.0}}),
}
OTHERS = ({"hyperparams": {"learning_rate": "lin_0.001"}}, {"hyperparams": {"policy_kwargs": {"log_std_init": -1.5}}})
# Share of a training's default steps, that of the published study.
TRAINING_STEPS = 60_000


def mean_return(loop: LoopConfig, policy: Any, episodes: int) -> float:
    """Returns the mean return over the episodes of the search."""
    return float(np.mean([each.episode_return for each in evaluate(loop, policy, episodes, SEARCH_SEED).episodes]))


def regulated(loop: LoopConfig, arm: str, certificate: Certificate, weights: dict[str, float], episodes: int) -> float:
    """Returns the mean return of a regulator with the given weights."""
    env = ncs_env(loop.single())
    policy = controller(arm.partition("+")[0], env, certificate.K, 0, RegulatorWeights(**weights))
    return mean_return(Arm.of(arm).loops(loop, certificate, CompareSettings())[1], policy, episodes)


def trained(loop: LoopConfig, arm: str, certificate: Certificate, tried: dict[str, Any], episodes: int) -> float:
    """Returns the mean return of an agent that was trained with the given settings."""
    own = {name: value for name, value in tried.items() if name != "hyperparams"}
    if "lagrangian" in own:
        own["lagrangian"] = LagrangianSettings(**own["lagrangian"])
    training, evaluated = Arm.of(arm).loops(loop, certificate, replace(CompareSettings(), **own))
    hyperparams = with_changes(DEFAULTS["PPO"], tried.get("hyperparams", {}))
    agent = train(training, TRAINING_STEPS, SEARCH_SEED, hyperparams=hyperparams).agent
    return mean_return(evaluated, lambda observations, infos: agent.act(observations), episodes)


class Results:
    """Mean returns by environment, arm and what was tried, kept in a file as they come."""

    def __init__(self, file: Path) -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        lines = file.read_text("utf-8").splitlines() if file.exists() else []
        self._file, self._known = file, {json.dumps(each["key"]): each["return"] for each in map(json.loads, lines)}

    def best(
        self, loop: LoopConfig, arm: str, certificate: Certificate, tries: list[dict[str, Any]], episodes: int
    ) -> dict[str, Any]:
        """Returns what gave the highest mean return, and prints it."""
        returns = []
        for tried in tries:
            key = [loop.env, arm, episodes, tried]
            if (text := json.dumps(key)) not in self._known:
                evaluated = trained if arm in TRAINED_ARMS else regulated
                self._known[text] = evaluated(loop, arm, certificate, tried, episodes)
                with self._file.open("a", encoding="utf-8") as file:
                    file.write(json.dumps({"key": key, "return": self._known[text]}) + "\n")
            returns.append(self._known[text])
        best = tries[int(np.argmax(returns))]
        shown = ", ".join(f"{each:.1f}" for each in returns)
        print(f"{loop.env} {arm}: {max(returns):.1f} with {best}, of {shown}", flush=True)
        return best


def main() -> None:
    """Searches, and prints or writes what was chosen."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", nargs="*", default=NETWORK_ENVS)
    arms = (*TRAINED_ARMS, *REGULATED_ARMS)
    parser.add_argument("--arms", nargs="*", default=arms, choices=arms)
    parser.add_argument(
        "--episodes", type=int, default=24, help="of a regulator; agents are evaluated on four times as many"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/tuned_arms.jsonl"))
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    results = Results(options.out)
    chosen: dict[str, dict[str, dict[str, Any]]] = json.loads(TUNED.read_text("utf-8"))
    for env_id in options.env:
        loop = LoopConfig(env=env_id)
        env = ncs_env(loop.single())
        certificate = certificate_for(env.plant, env.certificate_contract)
        for arm in options.arms:
            if arm in REGULATED_ARMS:
                best = results.best(loop, arm, certificate, [asdict(each) for each in GRID], options.episodes)
            else:
                price = PRICES if arm == "penalized" else {}
                tries = [{"hyperparams": each, **price} for each in CANDIDATES]
                best = results.best(loop, arm, certificate, tries, 4 * options.episodes)
                more = [
                    {**best, **each, "hyperparams": with_changes(best["hyperparams"], each.get("hyperparams", {}))}
                    for each in MORE.get(arm, OTHERS)
                ]
                best = results.best(loop, arm, certificate, [best, *more], 4 * options.episodes)
            chosen.setdefault(env_id, {})[arm] = best
    if options.write:
        TUNED.write_text(json.dumps(chosen, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
