"""Summaries of the training runs of an arm."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from agents.results import Episode
from experiments.analysis.statistics import bootstrap_interval, clopper_pearson, interquartile_mean, mean_interval
from experiments.runs.arms import is_shield
from experiments.runs.training_run import RunResult


def arm_summary(results: Sequence[RunResult], mode: str | None, *, fixed_policy: bool) -> dict[str, Any]:
    """Returns the summary of one arm's runs with the mode of its shield; see `summarize_arm`."""
    return {"mode": mode, "shielded": is_shield(mode)} | summarize_arm(results, fixed_policy=fixed_policy)


def summarize_arm(results: Sequence[RunResult], *, fixed_policy: bool) -> dict[str, Any]:
    """Returns the summary of one arm's runs, JSON values only.

    `eval_violation_rate_ci95` is the Clopper-Pearson interval of the probability that an episode violates, given the
    trained policies. `eval_violation_steps` counts violating steps of the true state and
    `eval_estimate_violation_steps` those of the estimate; they are plain counts, because the steps of one episode are
    dependent. `eval_return_ci95` is Student's interval over the mean returns of the runs (null for a single run),
    because training differs from run to run; for a policy that is the same in all runs (`fixed_policy`) it is over the
    episodes. The bootstrap intervals are over the same values. `eval_episodes_outside_set` counts episodes in which the
    true state left the safe set. `plan_rate` is the share of steps that live from a plan: after whose decision inputs
    of a certified plan are in store (mode "lookahead", 0 in others). `conditions` holds the same numbers of the
    evaluation under each other condition.
    """
    train_steps = sum(result.train_steps for result in results)
    conditions = {
        name: _evaluated([result.conditions[name] for result in results], fixed_policy=fixed_policy)
        for name in results[0].conditions
    }
    return {
        "runs": len(results),
        "train_steps": train_steps,
        "train_violation_steps": sum(result.train_violation_steps for result in results),
        "train_violation_steps_by_run": [result.train_violation_steps for result in results],
        "train_intervention_rate": _rate(sum(result.train_interventions for result in results), train_steps),
        **_evaluated([result.episodes for result in results], fixed_policy=fixed_policy),
        "conditions": conditions,
    }


def _evaluated(runs: Sequence[Sequence[Episode]], *, fixed_policy: bool) -> dict[str, Any]:
    """Returns what the summary says of the evaluation episodes of each run under one condition."""
    episodes = [episode for run in runs for episode in run]
    violating = sum(episode.violation_steps > 0 for episode in episodes)
    eval_steps = sum(episode.steps for episode in episodes)
    means = [_mean_return(run) for run in runs]
    values = [episode.episode_return for episode in episodes] if fixed_policy else means
    return {
        "eval_episodes": len(episodes),
        "eval_steps": eval_steps,
        "eval_violation_steps": sum(episode.violation_steps for episode in episodes),
        "eval_estimate_violation_steps": sum(episode.estimate_violation_steps for episode in episodes),
        "eval_violating_episodes": violating,
        "eval_violation_rate": violating / len(episodes),
        "eval_violation_rate_ci95": list(clopper_pearson(violating, len(episodes))),
        "eval_episodes_outside_set": sum(episode.largest_level > 1.0 for episode in episodes),
        "eval_return_mean": float(np.mean(means)),
        "eval_return_ci95": _listed(mean_interval(values)),
        "eval_return_bootstrap_ci95": _listed(bootstrap_interval(values)),
        "eval_return_iqm": float(interquartile_mean(values)),
        "eval_return_iqm_bootstrap_ci95": _listed(bootstrap_interval(values, interquartile_mean)),
        "eval_return_ci95_over": "episodes" if fixed_policy else "runs",
        "eval_return_by_run": means,
        "eval_violation_rate_by_run": [_share(run, lambda episode: episode.violation_steps > 0) for run in runs],
        "eval_outside_set_rate_by_run": [_share(run, lambda episode: episode.largest_level > 1.0) for run in runs],
        "intervention_rate_by_run": [_intervention_rate(run) for run in runs],
        "intervention_rate": _intervention_rate(episodes),
        "plan_rate": sum(episode.planned for episode in episodes) / eval_steps,
        "guaranteed_episodes": sum(episode.guaranteed for episode in episodes),
        "largest_level": max(episode.largest_level for episode in episodes),
    }


def paired_differences(arms: dict[str, Sequence[RunResult]], baseline: str) -> dict[str, Any]:
    """Returns the differences between each other arm and the baseline in the runs with equal index, JSON values.

    They are the differences of the mean returns, with Student's and the bootstrap's interval over the runs, and of the
    numbers of violating episodes.
    """
    differences = {}
    for name in arms.keys() - {baseline}:
        pairs = list(zip(arms[name], arms[baseline], strict=True))
        returns = [_mean_return(one.episodes) - _mean_return(other.episodes) for one, other in pairs]
        violating = [_violating(one) - _violating(other) for one, other in pairs]
        differences[name] = {
            "return_mean": float(np.mean(returns)),
            "return_ci95": _listed(mean_interval(returns)),
            "return_bootstrap_ci95": _listed(bootstrap_interval(returns)),
            "violating_episodes": sum(violating),
            "violating_episodes_by_run": violating,
        }
    return {name: differences[name] for name in arms if name in differences}


def covered_fraction(summary: dict[str, Any]) -> float | None:
    """Returns the fraction of the return from the zero input (0) to the unshielded agent (1) that the shielded one has.

    It is None without these arms, where the zero input earns as much as the unshielded agent, which learned nothing
    then, and where episodes end early: then returns are sums over different numbers of steps.
    """
    named = summary["references"] | summary["arms"]
    if not {"shielded", "unshielded", "zero input"} <= named.keys():
        return None
    start, goal, here = (named[name] for name in ("zero input", "unshielded", "shielded"))
    if len({arm["eval_steps"] for arm in (start, goal, here)}) > 1:
        return None
    start, goal, here = (arm["eval_return_mean"] for arm in (start, goal, here))
    return (here - start) / (goal - start) if goal > start else None


def _mean_return(episodes: Sequence[Episode]) -> float:
    return float(np.mean([episode.episode_return for episode in episodes]))


def _intervention_rate(episodes: Sequence[Episode]) -> float:
    return sum(episode.interventions for episode in episodes) / sum(episode.steps for episode in episodes)


def _share(episodes: Sequence[Episode], holds: Callable[[Episode], bool]) -> float:
    return sum(map(holds, episodes)) / len(episodes)


def _violating(result: RunResult) -> int:
    return sum(episode.violation_steps > 0 for episode in result.episodes)


def _listed(interval: tuple[float, float] | None) -> list[float] | None:
    return None if interval is None else list(interval)


def _rate(events: int, trials: int) -> float:
    return events / trials if trials else 0.0
