"""Summaries of the training runs of an arm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.analysis.statistics import bootstrap_interval, clopper_pearson, interquartile_mean, mean_interval
from experiments.analysis.text_table import text_table
from experiments.runs.training_run import RunResult


def arm_summary(results: Sequence[RunResult], mode: str | None, *, fixed_policy: bool) -> dict[str, Any]:
    """Returns the summary of one arm's runs with the mode of its shield; see `summarize_arm`."""
    shielded = mode not in (None, "monitor")
    return {"mode": mode, "shielded": shielded} | summarize_arm(results, fixed_policy=fixed_policy)


def summarize_arm(results: Sequence[RunResult], *, fixed_policy: bool) -> dict[str, Any]:
    """Returns the summary of one arm's runs, JSON values only.

    `eval_violation_rate_ci95` is the Clopper-Pearson interval of the probability that an episode violates, given the
    trained policies. `eval_violation_steps` counts violating steps of the true state and
    `eval_estimate_violation_steps` those of the estimate; they are plain counts, because the steps of one episode are
    dependent. `eval_return_ci95` is Student's interval over the mean returns of the runs (null for a single run),
    because training differs from run to run; for a policy that is the same in all runs (`fixed_policy`) it is over the
    episodes. The bootstrap intervals are over the same values.
    """
    episodes = [episode for result in results for episode in result.episodes]
    violating = sum(episode.violation_steps > 0 for episode in episodes)
    eval_steps = sum(episode.steps for episode in episodes)
    means = [_mean_return(result) for result in results]
    values = [episode.episode_return for episode in episodes] if fixed_policy else means
    train_steps = sum(result.train_steps for result in results)
    return {
        "runs": len(results),
        "train_steps": train_steps,
        "train_violation_steps": sum(result.train_violation_steps for result in results),
        "train_intervention_rate": _rate(sum(result.train_interventions for result in results), train_steps),
        "eval_episodes": len(episodes),
        "eval_steps": eval_steps,
        "eval_violation_steps": sum(episode.violation_steps for episode in episodes),
        "eval_estimate_violation_steps": sum(episode.estimate_violation_steps for episode in episodes),
        "eval_violating_episodes": violating,
        "eval_violation_rate": violating / len(episodes),
        "eval_violation_rate_ci95": list(clopper_pearson(violating, len(episodes))),
        "eval_return_mean": float(np.mean(means)),
        "eval_return_ci95": _listed(mean_interval(values)),
        "eval_return_bootstrap_ci95": _listed(bootstrap_interval(values)),
        "eval_return_iqm": float(interquartile_mean(values)),
        "eval_return_iqm_bootstrap_ci95": _listed(bootstrap_interval(values, interquartile_mean)),
        "eval_return_ci95_over": "episodes" if fixed_policy else "runs",
        "eval_return_by_run": means,
        "intervention_rate": sum(episode.interventions for episode in episodes) / eval_steps,
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
        returns = [_mean_return(one) - _mean_return(other) for one, other in pairs]
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

    It is None without these arms, and where episodes end early: then returns are sums over different numbers of steps.
    """
    named = summary["references"] | summary["arms"]
    if not {"shielded", "unshielded"} <= named.keys():
        return None
    start, goal, here = (named[name] for name in ("zero input", "unshielded", "shielded"))
    if len({arm["eval_steps"] for arm in (start, goal, here)}) > 1:
        return None
    start, goal, here = (arm["eval_return_mean"] for arm in (start, goal, here))
    return (here - start) / (goal - start) if goal != start else None


def _rows(arms: dict[str, dict[str, Any]]) -> list[list[str]]:
    """Returns two header rows, then one row of text per summary of an arm."""
    rows = [
        ["", "training:", "", "evaluation, exact 95 % CI:", "violating steps", "", ""],
        [
            "",
            "violating steps",
            "overridden",
            "violating episodes",
            "true / estimate",
            "overridden",
            "return [95 % CI]",
        ],
    ]
    for name, arm in arms.items():
        low, high = arm["eval_violation_rate_ci95"]
        steps = f"{arm['train_violation_steps']:,} of {arm['train_steps']:,}"
        rows.append(
            [
                name,
                steps if arm["train_steps"] else "-",
                _overridden(arm, "train_intervention_rate") if arm["train_steps"] else "-",
                f"{arm['eval_violating_episodes']:,} of {arm['eval_episodes']:,} [{100 * low:.1f}, {100 * high:.1f} %]",
                f"{arm['eval_violation_steps']:,} / {arm['eval_estimate_violation_steps']:,}",
                _overridden(arm, "intervention_rate"),
                _return_text(arm),
            ]
        )
    return rows


def summary_text(arms: dict[str, dict[str, Any]], references: dict[str, dict[str, Any]]) -> str:
    """Returns the table for a terminal; references stand below a rule."""
    return text_table(_rows(arms | references), rules=(2, 2 + len(arms)))


def _overridden(arm: dict[str, Any], key: str) -> str:
    """Returns a rate of interventions; in brackets what a monitor would have done."""
    text = f"{100 * arm[key]:.1f} %"
    return {"monitor": f"({text})", None: "-"}.get(arm["mode"], text)


def _return_text(arm: dict[str, Any]) -> str:
    interval = arm["eval_return_ci95"]
    if interval is None:
        return f"{arm['eval_return_mean']:.1f} [n/a]"
    return f"{arm['eval_return_mean']:.1f} [{interval[0]:.1f}, {interval[1]:.1f}]"


def _mean_return(result: RunResult) -> float:
    return float(np.mean([episode.episode_return for episode in result.episodes]))


def _violating(result: RunResult) -> int:
    return sum(episode.violation_steps > 0 for episode in result.episodes)


def _listed(interval: tuple[float, float] | None) -> list[float] | None:
    return None if interval is None else list(interval)


def _rate(events: int, trials: int) -> float:
    return events / trials if trials else 0.0
