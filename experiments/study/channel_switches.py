"""Which impairment of a channel decides: the same policies under attack with each of them on and off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

from agents.agent_file import AGENT_FILES
from experiments.analysis.episodes import episodes_table
from experiments.analysis.statistics import clopper_pearson
from experiments.backends.execution import results_of
from experiments.runs.arms import Arm, run_of_arm
from experiments.runs.loops import certificate_of, loop_config, registered_env
from experiments.runs.training_run import TrainingRun
from experiments.settings import Assignments, CompareSettings
from experiments.study.summary import ATTACKED
from ncs_gym import Channel, ChannelContract

# The impairments, by the names under which tables list them.
SWITCHES = ("loss", "delay", "rate", "rounding")
# What acts: regulators, and of a comparison's agents those that it trained.
SWITCHED_REGULATORS = ("lqr", "lqr+trusting:20", "lqr+lookahead")
SWITCHED_AGENTS = ("unshielded", "trusting:20", "lookahead")
# A sample every second step, where the rate is an impairment and the environment's own channel has none.
SLOW = 2
# Agents per arm: what their trainings differ by shows, and it takes minutes.
MOST_AGENTS = 5

# Files of the agents of an arm, in the order of their runs.
AgentFiles = Sequence[dict[str, bytes]]


def switched(channel: Channel, contract: ChannelContract | None, on: Sequence[str]) -> Assignments:
    """Returns the changes of a channel by which some of its impairments are on and the others off.

    With fewer samples as many losses in a row are allowed as the contract still has room for.

    Args:
        channel: The environment's own channel.
        contract: What the certificate assumes; None for nothing.
        on: The impairments that are on, of `SWITCHES`.
    """
    period = max(channel.send_period, SLOW) if "rate" in on else 1
    delay = channel.delay if "delay" in on else 0
    changes: Assignments = {"send_period": period, "delay": delay, "jitter": channel.jitter if "delay" in on else 0}
    changes["quantization_step"] = channel.quantization_step if "rounding" in on else 0.0
    if "loss" not in on:
        changes["loss"] = 0.0
    elif contract is not None:
        room = (contract.max_age + 1 - delay - changes["jitter"]) // period - 1
        most = channel.max_consecutive_losses
        changes["max_consecutive_losses"] = room if most is None else min(room, most)
    return changes


def trained_agents(settings: CompareSettings) -> dict[str, AgentFiles]:
    """Returns the agents of `SWITCHED_AGENTS` that a finished comparison trained, by the name of their arm.

    They are those of the first runs, at most `MOST_AGENTS`. Raises OSError if they are missing.
    """
    loop = loop_config(settings.env, settings.channel)
    certificate = certificate_of(loop, settings.certificate, settings.safe_set)
    arms = {Arm.of(name, settings.mode).name for name in settings.arms}
    agents: dict[str, AgentFiles] = {}
    count = min(settings.seeds, MOST_AGENTS)
    for name in (each for each in SWITCHED_AGENTS if each in arms):
        runs = [run_of_arm(settings.completed, loop, certificate, name, index) for index in range(count)]
        agents[name] = [_files(settings.out / "models" / run.name) for run in runs]
    return agents


def channel_switches(settings: CompareSettings, agents: Mapping[str, AgentFiles]) -> list[dict[str, Any]]:
    """Returns, for each combination of impairments and each policy, how many episodes under attack violate.

    The attack is that of the scenario "attacked": the strongest disturbance, noise of full size, and bursts as long as
    the contract allows. The policies are the same at every combination; those of the agents were trained with all of
    the environment's own impairments.

    Returns:
        Rows of JSON values: `on`, the impairments that are on, `arm`, `policies`, `episodes`, `violating` and its exact
        interval.
    """
    settings = replace(settings, scenarios=(ATTACKED,))
    points = [on for count in range(len(SWITCHES) + 1) for on in combinations(SWITCHES, count)]
    runs_at = {on: _runs(on, settings, agents) for on in points}
    results = iter(results_of([run for runs in runs_at.values() for run in runs], settings.out, settings))
    rows = []
    for on, runs in runs_at.items():
        played = episodes_table([next(results) for _ in runs])
        for arm, episodes in played[played["condition"] == ATTACKED].groupby("arm", sort=False):
            count, violating = len(episodes), int(episodes["violating"].sum())
            rows.append(
                {
                    "on": list(on),
                    "arm": arm,
                    "policies": episodes["run"].nunique(),
                    "episodes": count,
                    "violating": violating,
                    "violating_ci95": clopper_pearson(violating, count),
                }
            )
    return rows


def _files(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in AGENT_FILES}


def _runs(on: Sequence[str], settings: CompareSettings, agents: Mapping[str, AgentFiles]) -> list[TrainingRun]:
    env = registered_env(settings.env)
    loop = loop_config(settings.env, switched(env.channel, env.contract, on))
    certificate, point = certificate_of(loop, settings.certificate, settings.safe_set), "-".join(on) or "ideal"

    def run(settings: CompareSettings, name: str, index: int) -> TrainingRun:
        return run_of_arm(settings, loop, certificate, name, index, grid_point=point)

    runs = [run(settings, name, 0) for name in SWITCHED_REGULATORS]
    for name, each in agents.items():
        chosen = each[: settings.episodes]
        part = replace(settings, episodes=-(-settings.episodes // len(chosen)))
        runs += [replace(run(part, name, index), agent_files=files) for index, files in enumerate(chosen)]
    return runs
