"""Tunes the linear-quadratic regulator of every arm of `ncs study`, each behind its own filter, with the same budget.

    python benchmarks/tune_baselines.py [--env ncs_gym/CSTR-v0 ...] [--arms mpc ...] [--episodes 24] [--write]

A grid of weights is tried for each arm and each environment, on the environment's own channel and the same episodes for
all; the highest mean return is chosen (a violation ends an episode, and with it what it would still have earned). The
seed is that of no study. Every result is a line of OUT: started again, the search continues where it stopped. `--write`
writes what was chosen to experiments/baselines/tuned.json.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path

import numpy as np

from agents import evaluate
from agents.loop import LoopConfig, ShieldSettings
from experiments.baselines import FILTERS, EstimateFilterSettings, RegulatorWeights, controller
from experiments.settings.learning import NETWORK_ENVS, REGULATED_ARMS
from ncs_gym.envs.env import ncs_env
from shields import Certificate
from shields.runtime.wrapper import certificate_for

TUNED = Path(__file__).resolve().parent.parent / "experiments" / "baselines" / "tuned.json"
SEARCH_SEED = 1_000_000
GRID = [RegulatorWeights(effort, state) for effort, state in product((0.003, 0.03, 0.3, 3.0), (0.003, 0.03, 0.3))]


def loop_of(arm: str, env_id: str, certificate: Certificate) -> LoopConfig:
    """Returns the control loop of an arm."""
    loop, name = LoopConfig(env=env_id), arm.partition("+")[2]
    if name in FILTERS:
        return replace(loop, filter=EstimateFilterSettings(name, certificate))
    mode = {"shielded": "project"}.get(name, name)
    return replace(loop, shield=ShieldSettings(certificate, mode)) if name else loop


def main() -> None:
    """Searches, and prints or writes what was chosen."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", nargs="*", default=NETWORK_ENVS)
    parser.add_argument("--arms", nargs="*", default=REGULATED_ARMS, choices=REGULATED_ARMS)
    parser.add_argument("--episodes", type=int, default=24)
    parser.add_argument("--out", type=Path, default=Path("runs/tuned_baselines.jsonl"))
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    lines = options.out.read_text("utf-8").splitlines() if options.out.exists() else []
    found = {tuple(line["key"]): line["return"] for line in map(json.loads, lines)}
    chosen: dict[str, dict[str, dict[str, float]]] = json.loads(TUNED.read_text("utf-8"))
    for env_id in options.env:
        env = ncs_env(LoopConfig(env=env_id).single())
        certificate = certificate_for(env.plant, env.certificate_contract, safe_set="ellipsoid")
        for arm in options.arms:
            returns = []
            for weights in GRID:
                key = (env_id, arm, options.episodes, weights.effort, weights.state)
                if key not in found:
                    policy = controller(arm.partition("+")[0], env, certificate.K, 0, weights)
                    loop = loop_of(arm, env_id, certificate)
                    played = evaluate(loop, policy, options.episodes, SEARCH_SEED).episodes
                    found[key] = float(np.mean([episode.episode_return for episode in played]))
                    with options.out.open("a", encoding="utf-8") as file:
                        file.write(json.dumps({"key": key, "return": found[key]}) + "\n")
                returns.append(found[key])
            best = GRID[int(np.argmax(returns))]
            chosen.setdefault(env_id, {})[arm] = asdict(best)
            print(f"{env_id} {arm}: {max(returns):.1f} with {best}, others {min(returns):.1f} and more", flush=True)
    if options.write:
        TUNED.write_text(json.dumps(chosen, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
