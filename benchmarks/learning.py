"""How good agents are, and the searches for their settings: `python -m benchmarks.learning COMMAND`.

Commands: tune, pretrained, tune-arms.

Seeds are those of `ncs compare` with `--seed 1000000` for searches and 3000000 for the agents of the
package, so that the benchmark (`--seed 0`, `--seed 1`) has nothing that was searched on.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any
from zlib import crc32

import gymnasium as gym
import numpy as np

from agents import (
    LoopConfig,
    ShieldSettings,
    evaluate,
    train,
    tuned_hyperparams,
    tuned_steps,
)
from agents.evaluation import Policy
from agents.hyperparams import DEFAULTS, complete_hyperparams, with_changes
from agents.loop import LagrangianSettings
from benchmarks.commands import run, some_of
from benchmarks.suite import ENTRIES, TASKS, observing, rows_of
from benchmarks.timing import timed
from experiments.baselines.controllers import OBSERVER, RegulatorWeights, controller
from experiments.commands.compare import CompareSettings
from experiments.runs.arms import Arm
from ncs_gym.envs.env import ncs_env
from ncs_gym.registration import registered_ids
from shields import Certificate, certificate_for
from shields.certificate import Fallback

ROOT = Path(__file__).resolve().parent.parent
SEARCH_SEED, PACKAGE_SEED = 1_000_000, 3_000_000
EPISODES = 200
# Arms of the benchmark that are tuned, each once; other cost limits go with what was tuned for the first one.
TUNED = tuple(dict.fromkeys(each.tuned_as for each in ENTRIES.values() if not each.arm.startswith("lagrangian:")))
# Steps of a training; where more were seen to help, four times as many.
STEPS, MORE_STEPS = 150_000, 600_000
LONGER = ("ncs_gym/CartPole-v0", "ncs_gym/CartPoleTwoWay-v0", "ncs_gym/CartPoleNonlinear-v0")


def shielded_loop(env_id: str) -> LoopConfig:
    """The environment behind the shield of its certificate."""
    env = ncs_env(gym.make(env_id))
    return LoopConfig(env=env_id, shield=ShieldSettings(certificate_for(env.plant, env.certificate_contract)))


def seeds_of(experiment_seed: int, index: int) -> tuple[int, int]:
    """Seeds of training and of evaluation of one run, as `ncs compare` derives them."""
    first, second = np.random.SeedSequence([experiment_seed, index]).generate_state(2)
    return int(first >> 1), int(second >> 1)


def mean_return(loop: LoopConfig, policy: Policy, seed: int, episodes: int = EPISODES) -> float:
    """Mean return of a policy over the episodes of a seed."""
    return float(np.mean([each.episode_return for each in evaluate(loop, policy, episodes, seed).episodes]))


def trained(loop: LoopConfig, hyperparams: dict[str, Any] | None, steps: int, seed: int) -> Policy:
    """An agent after its training."""
    agent = train(loop, steps, seed, hyperparams=hyperparams).agent
    return lambda observations, infos: agent.act(observations)


class Results:
    """Numbers by what they are of, kept in a file as they come: started again, a search continues where it stopped."""

    def __init__(self, file: Path) -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        lines = file.read_text("utf-8").splitlines() if file.exists() else []
        self._file, self._known = file, {json.dumps(each["key"]): each["return"] for each in map(json.loads, lines)}

    def of(self, key: list[Any], measure: Callable[[], Any]) -> Any:
        """What belongs to a key, a number or another JSON value, measured unless it was before."""
        if (text := json.dumps(key)) not in self._known:
            self._known[text] = measure()
            with self._file.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"key": key, "return": self._known[text]}) + "\n")
        return self._known[text]


# Twelve weights are tried of every regulator.
GRID = [{"effort": effort, "state": state} for effort, state in product((0.003, 0.03, 0.3, 3.0), (0.003, 0.03, 0.3))]
OBSERVED = [
    {"effort": effort, "state": state, "disturbance": alpha}
    for effort, state, alpha in product((0.003, 0.03, 0.3), (0.003, 0.3), (0.2, 0.4))
]


def grid(arm: str) -> list[dict[str, Any]]:
    """The weights that are tried of a regulator, alone or behind a filter."""
    return OBSERVED if OBSERVER in arm else GRID


def regulated(loop: LoopConfig, name: str, weights: dict[str, Any]) -> Policy:
    """A regulator with some weights."""
    env = ncs_env(loop.single())
    return controller(name, env, Fallback.of_gain(np.zeros((env.plant.m, env.plant.n))), 0, RegulatorWeights(**weights))


TUNED_PPO = ROOT / "agents" / "tuned" / "ppo.json"
# Random stream of each environment's candidates, so that they stay the same when further environments are registered;
# those that are not here have a checksum of their id.
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
GUESS = {"n_envs": 128, "n_steps": 32, "gamma": 0.98, "gae_lambda": 0.95}
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


def candidate(env_id: str, number: int) -> dict[str, Any]:
    """All hyperparameters of a number: the defaults, the guess, then random ones."""
    if number < 2:
        return complete_hyperparams("PPO", ({}, GUESS)[number])
    rng = np.random.default_rng([SEARCH_SEED, STREAMS.get(env_id, crc32(env_id.encode())), number])
    drawn = {name: values[rng.integers(len(values))] for name, values in SPACE.items()}
    return complete_hyperparams("PPO", drawn | {"policy_kwargs": {name: drawn.pop(name) for name in _NETWORKS}})


def tune(
    env: Sequence[str] = (),
    candidates: int = 6,
    finalists: int = 2,
    seeds: int = 1,
    out: Path = Path("runs/tune"),
    write: bool = False,
) -> None:
    """Searches PPO's hyperparameters for each registered environment, or for --env, behind its shield (mode project).

    A random search in two rounds: every candidate is trained once with 150,000 steps, the best ones `--seeds` times
    more, on other seeds, with the steps that belong to the environment; those with the highest mean return of these
    last trainings are chosen. The first candidate is the defaults, the second a guess by hand, the others are drawn
    from `SPACE`. Every result is a line of OUT/results.jsonl: started again, the search continues where it stopped.
    `--write` also writes what was chosen to agents/tuned/ppo.json.
    """
    results = Results(out / "results.jsonl")
    known = json.loads(TUNED_PPO.read_text())
    for env_id in env or registered_ids():
        loop, steps = shielded_loop(env_id), MORE_STEPS if env_id in LONGER else STEPS

        def measured(hyperparams: dict[str, Any], steps: int, run: int, loop: LoopConfig = loop) -> float:
            def measure() -> float:
                training_seed, evaluation_seed = seeds_of(SEARCH_SEED, run)
                return mean_return(loop, trained(loop, hyperparams, steps, training_seed), evaluation_seed)

            return results.of([loop.env, hyperparams, steps, run], measure)

        tried = [candidate(env_id, number) for number in range(candidates)]
        first = [measured(each, STEPS, 0) for each in tried]
        order = sorted(range(candidates), key=lambda number, first=first: -first[number])
        shown = ", ".join(f"#{number} {first[number]:.2f}" for number in order)
        print(f"{env_id}, {STEPS} steps: {shown}", flush=True)
        last = {
            number: [measured(tried[number], steps, run) for run in range(1, 1 + seeds)] for number in order[:finalists]
        }
        shown = ", ".join(f"#{number} {np.mean(each):.2f} {np.round(each, 2)}" for number, each in last.items())
        print(f"  {steps} steps: {shown}", flush=True)
        best = max(last, key=lambda number, last=last: float(np.mean(last[number])))
        changed = {name: value for name, value in tried[best].items() if value != DEFAULTS["PPO"][name]}
        print(f"  chosen: #{best}, {changed}", flush=True)
        known[env_id] = {"n_timesteps": steps} | tried[best]
    if write:
        TUNED_PPO.write_text(json.dumps(known, indent=1) + "\n")


def pretrained(env: Sequence[str] = (), out: Path = ROOT / "agents" / "trained") -> None:
    """Trains the small agents that come with the package, one per registered id, behind the shield (mode project).

    PPO with the hyperparameters and steps of agents/tuned, or the defaults and 150,000 steps, and networks of two
    layers of 32. Each agent is saved and evaluated on 200 episodes; a line says how long that took. Its certificate is
    the one in shields/packaged_certificates.
    """
    for env_id in env or [each for each in registered_ids() if each.startswith("ncs_gym/")]:
        line, seconds = timed(_train_and_save, env_id, out / env_id.rpartition("/")[2])
        print(f"{line}, {seconds:.0f} s of CPU", flush=True)


def _train_and_save(env_id: str, folder: Path) -> str:
    """Trains, saves and evaluates the agent of an environment; returns a line about it."""
    loop, (training_seed, evaluation_seed) = shielded_loop(env_id), seeds_of(PACKAGE_SEED, 0)
    small = {"policy_kwargs": {"net_arch": [32, 32]}}
    hyperparams = with_changes(tuned_hyperparams(env_id) or DEFAULTS["PPO"], small)
    training = train(loop, tuned_steps(env_id) or STEPS, training_seed, hyperparams=hyperparams)
    agent = training.agent
    agent.save(folder)
    evaluation = evaluate(loop, lambda observations, infos: agent.act(observations), EPISODES, evaluation_seed)
    size = sum(file.stat().st_size for file in folder.iterdir())
    mean = np.mean([each.episode_return for each in evaluation.episodes])
    violations = training.violation_steps + sum(each.violation_steps for each in evaluation.episodes)
    return f"{env_id}: return {mean:.2f}, {violations} violating steps, {size / 1e3:.0f} kB"


TUNED_ARMS = ROOT / "experiments" / "baselines" / "tuned.json"
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
# Steps of a training in this search.
TRAINING_STEPS = 60_000


def tune_arms(
    tasks: Annotated[Sequence[str], some_of(TASKS)] = TASKS,
    arms: Annotated[Sequence[str], some_of(TUNED)] = TUNED,
    episodes: int = 24,
    out: Path = Path("runs/tuned_arms.jsonl"),
    write: bool = False,
) -> None:
    """Tunes every arm of the benchmark by itself, each behind its own filter, with the same budget.

    Of a regulator a grid of weights is tried, of an agent `CANDIDATES` of PPO's hyperparameters and then, with the best
    of the first three, two more: prices of a violation, settings of PPO-Lagrangian, or hyperparameters where an arm has
    neither. Everything happens on the environment's own channel, on the same seeds and --episodes for all (agents are
    evaluated on four times as many); the highest mean return is chosen (a violation ends an episode, and with it what
    it would still have earned). Every result is a line of OUT: started again, the search continues where it stopped.
    `--write` writes what was chosen to experiments/baselines/tuned.json.
    """
    results = Results(out)
    chosen: dict[str, dict[str, dict[str, Any]]] = json.loads(TUNED_ARMS.read_text("utf-8"))
    for task in tasks:
        loop, needed = LoopConfig(env=f"ncs_gym/{task}"), {ENTRIES[name].tuned_as for name in rows_of(task)}
        single = ncs_env(loop.single())
        certificate = certificate_for(single.plant, single.certificate_contract)

        def best(arm: str, tries: list[dict[str, Any]], loop: LoopConfig = loop, own: Certificate = certificate) -> Any:
            """Returns what gave the highest mean return, and prints it."""
            is_trained = Arm.of(arm.partition(", ")[0]).is_trained
            number, measure = (4 * episodes, _trained_arm) if is_trained else (episodes, _regulated_arm)
            returns = [
                results.of([loop.env, arm, number, each], lambda each=each: measure(loop, arm, own, each, number))
                for each in tries
            ]
            found = tries[int(np.argmax(returns))]
            shown = ", ".join(f"{each:.1f}" for each in returns)
            print(f"{loop.env} {arm}: {max(returns):.1f} with {found}, of {shown}", flush=True)
            return found

        for arm in (each for each in arms if each in needed):
            if not Arm.of(arm.partition(", ")[0]).is_trained:
                found = best(arm, grid(arm))
            else:
                price = PRICES if arm == "penalized" else {}
                found = best(arm, [{"hyperparams": each, **price} for each in CANDIDATES])
                more = [
                    {**found, **each, "hyperparams": with_changes(found["hyperparams"], each.get("hyperparams", {}))}
                    for each in MORE.get(arm, OTHERS)
                ]
                found = best(arm, [found, *more])
            chosen.setdefault(loop.env, {})[arm] = found
    if write:
        TUNED_ARMS.write_text(json.dumps(chosen, indent=1) + "\n", "utf-8")


def _regulated_arm(
    loop: LoopConfig, arm: str, certificate: Certificate, weights: dict[str, Any], episodes: int
) -> float:
    """Returns the mean return of a regulator with the given weights."""
    policy = regulated(loop, arm.partition("+")[0], weights)
    return mean_return(Arm.of(arm).loops(loop, certificate, CompareSettings())[1], policy, SEARCH_SEED, episodes)


def _trained_arm(loop: LoopConfig, arm: str, certificate: Certificate, tried: dict[str, Any], episodes: int) -> float:
    """Returns the mean return of an agent that was trained with the given settings."""
    own = {name: value for name, value in tried.items() if name != "hyperparams"}
    if "lagrangian" in own:
        own["lagrangian"] = LagrangianSettings(**own["lagrangian"])
    arm, _, seen = arm.partition(", ")
    loops = Arm.of(arm).loops(loop, certificate, replace(CompareSettings(), **own))
    training, evaluated = (observing(seen, each) for each in loops)
    hyperparams = with_changes(DEFAULTS["PPO"], tried.get("hyperparams", {}))
    return mean_return(evaluated, trained(training, hyperparams, TRAINING_STEPS, SEARCH_SEED), SEARCH_SEED, episodes)


COMMANDS = (tune, pretrained, tune_arms)

if __name__ == "__main__":
    run(__doc__, COMMANDS)
