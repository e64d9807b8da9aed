"""How a linear controller behind a filter leaves set and box, with and without the error set, on other channels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from experiments.analysis.statistics import clopper_pearson
from experiments.backends.execution import results_of
from experiments.runs import ExperimentSetup, RunResult, TrainingRun
from experiments.runs.environments import registered_env
from experiments.runs.evaluation_conditions import AS_TRAINED
from experiments.settings import ChannelSettings, CompareSettings

# The filters, in pairs without and with the error set: those that keep S, then those that may leave it.
SWEPT_ARMS = ("lqr+trusting", "lqr+shielded", "lqr+trusting:lookahead", "lqr+lookahead")
SWEPT_CONDITIONS = (AS_TRAINED, "worst-case disturbance")
_LOSSES, _DELAYS, _QUANTIZATION = (0.0, 0.15, 0.3, 0.5, 0.7, 0.9), (0, 1, 2, 3, 4), (0.0, 0.5, 1.0, 2.0, 4.0)


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


def channel_sweep(settings: CompareSettings) -> list[dict[str, Any]]:
    """Returns, for each channel, arm and disturbance, how many episodes left the safe set and the box, JSON values.

    Channels that break the environment's contract are left out: the certificate says nothing of them.

    Args:
        settings: Environment, seed, episodes of the sweep, output folder and backend.

    Raises:
        ValueError: If the environment is unknown or a stored result is damaged.
        Infeasible: If no certificate is found for a channel.
        RunError: If a run fails.
        ClusterError: If a cluster cannot execute the runs.
        OSError: If the folder cannot be written.
    """
    settings = replace(settings, arms=SWEPT_ARMS, references=(), conditions=SWEPT_CONDITIONS[1:])
    points = _points(settings.env)
    runs = [run for point in points for run in _runs(point, settings)]
    results = results_of(runs, settings.out, settings)
    count = len(SWEPT_ARMS)
    parts = [results[i * count : (i + 1) * count] for i in range(len(points))]
    return [row for point, part in zip(points, parts, strict=True) for row in _rows(point, part)]


def _points(env_id: str) -> list[_Point]:
    """Returns the channels that keep the contract, one side of the grid after the other."""
    env = registered_env(env_id)
    own = env.channel
    steps = [round(factor * own.quantization_step, 12) for factor in _QUANTIZATION]
    sides = {"loss": _LOSSES, "delay": _DELAYS, "quantization_step": tuple(dict.fromkeys(steps))}
    points = [_Point(side, value) for side, values in sides.items() for value in values]
    if env.contract is None:
        return points
    return [point for point in points if env.contract.is_kept_by(_changed(point).applied_to(own) or own)]


def _changed(point: _Point) -> ChannelSettings:
    """Returns the change of the environment's channel at a point."""
    if point.side == "delay":
        return ChannelSettings(delay=int(point.value))
    return ChannelSettings(loss=point.value) if point.side == "loss" else ChannelSettings(quantization_step=point.value)


def _runs(point: _Point, settings: CompareSettings) -> list[TrainingRun]:
    """Returns the runs at a point; nothing is trained in them."""
    setup = ExperimentSetup.of(settings.env, _changed(point), settings.certificate)
    return [setup.training_run(settings, name, 0, grid_point=point.name) for name in SWEPT_ARMS]


def _rows(point: _Point, results: Sequence[RunResult]) -> list[dict[str, Any]]:
    """Returns what happened at a point, a row per arm and disturbance."""
    rows = []
    for result in results:
        for condition, episodes in ({AS_TRAINED: result.episodes} | result.conditions).items():
            outside = sum(episode.largest_level > 1.0 for episode in episodes)
            violating = sum(episode.violation_steps > 0 for episode in episodes)
            rows.append(
                {
                    "side": point.side,
                    "value": point.value,
                    "arm": result.arm,
                    "condition": condition,
                    "episodes": len(episodes),
                    "outside_set": outside,
                    "outside_set_ci95": list(clopper_pearson(outside, len(episodes))),
                    "violating": violating,
                    "violating_ci95": list(clopper_pearson(violating, len(episodes))),
                    "intervention_rate": sum(e.interventions for e in episodes) / sum(e.steps for e in episodes),
                }
            )
    return rows
