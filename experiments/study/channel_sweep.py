"""How policies behind filters leave set and box, with and without the error set, on other channels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from experiments.analysis.episodes import episodes_table
from experiments.analysis.statistics import clopper_pearson
from experiments.backends.execution import results_of
from experiments.errors import ResultsError
from experiments.runs import (
    Arm,
    RunResult,
    RunStore,
    TrainingRun,
    certificate_of,
    loop_config,
    run_of_arm,
)
from experiments.runs.environments import registered_env
from experiments.runs.scenarios import AS_TRAINED
from experiments.settings import Assignments, CompareSettings, changed_channel

# The filters, in pairs without and with the error set, by the count in the rows that tells whether they do what they
# are for: the first keep S, the others may leave it and keep the box.
FILTERS_BY_COUNT = {"outside_set": ("trusting", "shielded"), "violating": ("trusting:lookahead", "lookahead")}
SWEPT_FILTERS = tuple(name for pair in FILTERS_BY_COUNT.values() for name in pair)
SWEPT_SCENARIOS = (AS_TRAINED, "worst-case disturbance")
_LOSSES, _DELAYS, _QUANTIZATION = (0.0, 0.15, 0.3, 0.5, 0.7, 0.9), (0, 1, 2, 3, 4), (0.0, 0.5, 1.0, 2.0, 4.0)
# Agents per filter: what their trainings differ by shows, and the sweep takes minutes.
MOST_AGENTS = 5

# Files of the agents of an arm, in the order of their runs.
AgentFiles = Sequence[dict[str, bytes]]


@dataclass(frozen=True)
class _Point:
    """A channel that differs from the environment's own in one value.

    Attributes:
        side: What differs: "loss", "delay" or "quantization_step".
        value: Its value.
    """

    side: str
    value: float

    @property
    def name(self) -> str:
        """Name of the point in file names."""
        return f"{self.side.replace('_', '-')}{self.value:g}"

    @property
    def change(self) -> Assignments:
        """The change of the environment's channel."""
        return {self.side: int(self.value) if self.side == "delay" else self.value}


def trained_agents(settings: CompareSettings) -> dict[str, AgentFiles]:
    """Returns the agents that a finished comparison trained behind filters of the sweep, by the filter's name.

    They are those of the first runs, at most `MOST_AGENTS`.

    Args:
        settings: Settings of the comparison; filters that are none of its arms are left out.

    Raises:
        ValueError: If the environment is unknown.
        Infeasible: If no certificate is found.
        ResultsError: If the agents are missing or damaged.
    """
    loop, store = loop_config(settings.env, settings.channel), RunStore(settings.out)
    certificate = certificate_of(loop, settings.certificate, settings.safe_set)
    arms = {Arm.of(name, settings.mode).name for name in settings.arms}
    agents: dict[str, AgentFiles] = {}
    count = min(settings.seeds, MOST_AGENTS)
    for name in (each for each in SWEPT_FILTERS if each in arms):
        runs = [run_of_arm(settings.completed, loop, certificate, name, index) for index in range(count)]
        agents[name] = [_files(store, run) for run in runs]
    return agents


def channel_sweep(settings: CompareSettings, agents: Mapping[str, AgentFiles]) -> list[dict[str, Any]]:
    """Returns, for each channel, policy, filter and disturbance, how many episodes left the safe set and the box.

    A linear-quadratic regulator acts behind every filter, and behind each filter the agents that were trained behind
    it on the environment's own channel. They share the episodes; there are no more of them than episodes. Channels
    that break the environment's contract are left out: the certificate says nothing of them.

    Args:
        settings: Environment, seed, episodes of each point, output folder and backend.
        agents: Files of the agents by the name of their filter, an element of `SWEPT_FILTERS`.

    Returns:
        Rows of JSON values; the arm of the regulator is named like "lqr+shielded", that of agents like "shielded".

    Raises:
        ValueError: If the environment is unknown or a stored result is damaged.
        Infeasible: If no certificate is found for a channel.
        RunError: If a run fails.
        ClusterError: If a cluster cannot execute the runs.
        OSError: If the folder cannot be written.
    """
    settings = replace(settings, scenarios=SWEPT_SCENARIOS[1:])
    runs_at = {point: _runs(point, settings, agents) for point in _points(settings.env)}
    results = iter(results_of([run for runs in runs_at.values() for run in runs], settings.out, settings))
    return [row for point, runs in runs_at.items() for row in _rows(point, [next(results) for _ in runs])]


def _files(store: RunStore, run: TrainingRun) -> dict[str, bytes]:
    """Returns the files of the agent that a run left."""
    result = store.load(run)
    if result is None:
        raise ResultsError(f"there is no result of the training {run.name}: run the comparison again")
    return result.files


def _points(env_id: str) -> list[_Point]:
    """Returns the channels that keep the contract, one side of the grid after the other."""
    env = registered_env(env_id)
    own = env.channel
    steps = [round(factor * own.quantization_step, 12) for factor in _QUANTIZATION]
    sides = {"loss": _LOSSES, "delay": _DELAYS, "quantization_step": tuple(dict.fromkeys(steps))}
    points = [_Point(side, value) for side, values in sides.items() for value in values]
    if env.contract is None:
        return points
    return [point for point in points if env.contract.is_kept_by(changed_channel(own, point.change) or own)]


def _runs(point: _Point, settings: CompareSettings, agents: Mapping[str, AgentFiles]) -> list[TrainingRun]:
    """Returns the runs at a point; nothing is trained in them."""
    loop = loop_config(settings.env, point.change)
    certificate = certificate_of(loop, settings.certificate, settings.safe_set)

    def run(settings: CompareSettings, name: str, index: int) -> TrainingRun:
        return run_of_arm(settings, loop, certificate, name, index, grid_point=point.name)

    runs = [run(settings, f"lqr+{name}", 0) for name in SWEPT_FILTERS]
    for name, each in agents.items():
        chosen = each[: settings.episodes]
        part = replace(settings, episodes=-(-settings.episodes // len(chosen)))
        for index, files in enumerate(chosen):
            runs.append(replace(run(part, name, index), agent_files=files))
    return runs


def _rows(point: _Point, results: Sequence[RunResult]) -> list[dict[str, Any]]:
    """Returns what happened at a point, a row per arm and disturbance."""
    rows = []
    for (arm, condition), played in episodes_table(results).groupby(["arm", "condition"], sort=False):
        count, outside, violating = len(played), int(played["outside_set"].sum()), int(played["violating"].sum())
        rows.append(
            {
                "side": point.side,
                "value": point.value,
                "arm": arm,
                "condition": condition,
                "policies": played["run"].nunique(),
                "episodes": count,
                "outside_set": outside,
                "outside_set_ci95": clopper_pearson(outside, count),
                "violating": violating,
                "violating_ci95": clopper_pearson(violating, count),
                "intervention_rate": float(played["interventions"].sum() / played["steps"].sum()),
            }
        )
    return rows
