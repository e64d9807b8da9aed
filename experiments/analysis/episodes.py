"""The long table of results, a row per evaluation episode, and what is computed from it."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Mapping
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from experiments.analysis.statistics import bootstrap_interval, clopper_pearson, interquartile_mean, mean_interval
from experiments.runs.arms import Arm, is_shield
from experiments.runs.loops import AS_TRAINED
from experiments.runs.training_run import RunResult

# Key of the metadata in a file, and entries of summary.json that it holds.
_METADATA = b"ncs-gym"
_ORIGIN = ("settings", "seeds", "plant", "certificate", "certificate_file", "versions")
# Totals of a run's training, in each of its rows.
TRAINING = ["train_steps", "train_violation_steps", "train_interventions"]


def episodes_table(results: Iterable[RunResult], **common: Any) -> pd.DataFrame:
    """Returns a row per evaluation episode.

    Args:
        results: Results of training runs.
        **common: Columns with the same value in all rows, such as the environment or what a sweep varies.

    Returns:
        The common columns; `arm`, `run` and `condition`; the fields of `agents.results.Episode`; `violating` and
        `outside_set`, whether the true state left the safe box or the safe set at some step; and the totals of the
        run's training, `TRAINING`.
    """
    rows = [
        common
        | {"arm": result.arm, "run": result.index, "condition": scenario}
        | vars(episode)
        | {name: getattr(result, name) for name in TRAINING}
        for result in results
        for scenario, played in ({AS_TRAINED: result.episodes} | result.scenarios).items()
        for episode in played
    ]
    table = pd.DataFrame(rows)
    return table.assign(violating=table["violation_steps"] > 0, outside_set=~(table["largest_level"] <= 1.0))


def training_table(results: Iterable[RunResult]) -> pd.DataFrame:
    """Returns a row per point of a training's history: `arm`, `run`, the fields of `agents.results.TrainingPoint`."""
    return pd.DataFrame(
        [{"arm": result.arm, "run": result.index} | vars(point) for result in results for point in result.history]
    )


def parquet(table: pd.DataFrame, summary: Mapping[str, Any]) -> bytes:
    """Returns a table as the content of a Parquet file, whose metadata say where it comes from."""
    origin = {name: summary[name] for name in _ORIGIN if name in summary}
    content = pa.Table.from_pandas(table, preserve_index=False)
    buffer = io.BytesIO()
    pq.write_table(content.replace_schema_metadata({_METADATA: json.dumps(origin).encode()}), buffer)
    return buffer.getvalue()


# Columns of which a run has a sum, and a mean over its episodes.
_COUNTED = ["steps", "violation_steps", "estimate_violation_steps", "interventions", "planned"]
_COUNTED += ["proved", "guaranteed", "violating", "outside_set"]
_AVERAGED = ["episode_return", "violating", "outside_set"]


def arm_summaries(episodes: pd.DataFrame, mode: str) -> dict[str, dict[str, Any]]:
    """Returns what `arm_summary` says of every arm, by its name and in the order of the rows."""
    arms = {str(name): (Arm.of(str(name), mode), rows) for name, rows in episodes.groupby("arm", sort=False)}
    return {
        name: arm_summary(
            rows, arm.mode, fixed_policy=not arm.differs_from_run_to_run, filters_training=arm.filters_training
        )
        for name, (arm, rows) in arms.items()
    }


def arm_summary(
    episodes: pd.DataFrame, mode: str | None, *, fixed_policy: bool, filters_training: bool = True
) -> dict[str, Any]:
    """Returns the summary of an arm, JSON values only.

    `eval_violation_rate_ci95` is the Clopper-Pearson interval of the probability that an episode violates, given the
    trained policies. `eval_violation_steps` counts violating steps of the true state and
    `eval_estimate_violation_steps` those of the estimate; they are plain counts, because the steps of one episode are
    dependent. `eval_return_ci95` is Student's interval over the mean returns of the runs (null for a single run),
    because training differs from run to run; for a policy that is the same in all runs (`fixed_policy`) it is over the
    episodes. The bootstrap intervals are over the same values. `eval_episodes_outside_set` counts episodes in which the
    true state left the safe set. `plan_rate` is the share of steps that live from a plan: after whose decision inputs
    of a certified plan are in store (mode "lookahead", 0 in others). `eval_proved_steps` counts steps after which the
    guarantee held. `conditions` holds the same numbers of the evaluation in each other scenario.

    Args:
        episodes: Rows of the arm in what `episodes_table` returns.
        mode: Mode of its shield, or name of its other filter; None for neither.
        fixed_policy: Whether the policy is the same in all runs.
        filters_training: Whether the shield or filter acts in training, too.
    """
    training = episodes.groupby("run")[TRAINING].first()
    steps, violations, interventions = (int(total) for total in training.sum())
    conditions = {
        name: _evaluated(played, fixed_policy=fixed_policy)
        for name, played in episodes.groupby("condition", sort=False)
    }
    return {
        "mode": mode,
        "train_mode": mode if filters_training else None,
        "shielded": is_shield(mode),
        "runs": len(training),
        "train_steps": steps,
        "train_violation_steps": violations,
        "train_violation_steps_by_run": training["train_violation_steps"].tolist(),
        "train_intervention_rate": interventions / steps if steps else 0.0,
        **conditions.pop(AS_TRAINED),
        "conditions": conditions,
    }


def _evaluated(episodes: pd.DataFrame, *, fixed_policy: bool) -> dict[str, Any]:
    """Returns what a summary says of the evaluation episodes of an arm in one scenario."""
    runs, count = episodes.groupby("run"), len(episodes)
    means, sums = runs[_AVERAGED].mean(), runs[_COUNTED].sum()
    total = {name: int(number) for name, number in sums.sum().items()}
    values = (episodes if fixed_policy else means)["episode_return"].to_numpy()
    return {
        "eval_episodes": count,
        "eval_steps": total["steps"],
        "eval_violation_steps": total["violation_steps"],
        "eval_estimate_violation_steps": total["estimate_violation_steps"],
        "eval_proved_steps": total["proved"],
        "eval_violating_episodes": total["violating"],
        "eval_violation_rate": total["violating"] / count,
        "eval_violation_rate_ci95": clopper_pearson(total["violating"], count),
        "eval_episodes_outside_set": total["outside_set"],
        "eval_return_mean": float(means["episode_return"].mean()),
        "eval_return_ci95": mean_interval(values),
        "eval_return_bootstrap_ci95": bootstrap_interval(values),
        "eval_return_iqm": float(interquartile_mean(values)),
        "eval_return_iqm_bootstrap_ci95": bootstrap_interval(values, statistic=interquartile_mean),
        "eval_return_ci95_over": "episodes" if fixed_policy else "runs",
        "eval_return_by_run": means["episode_return"].tolist(),
        "eval_violation_rate_by_run": means["violating"].tolist(),
        "eval_outside_set_rate_by_run": means["outside_set"].tolist(),
        "intervention_rate_by_run": (sums["interventions"] / sums["steps"]).tolist(),
        "intervention_rate": total["interventions"] / total["steps"],
        "plan_rate": total["planned"] / total["steps"],
        "guaranteed_episodes": total["guaranteed"],
        "largest_level": float(episodes["largest_level"].max()),
    }


def paired_differences(episodes: pd.DataFrame, baseline: str) -> dict[str, Any]:
    """Returns the differences between each other arm and the baseline, JSON values.

    They are the mean differences of returns in episodes with the same numbers, with Student's and the bootstrap's
    interval over the runs, or over the episodes where both policies are the same in all runs (`return_ci95_over`), and
    the differences of the numbers of violating episodes.
    """
    as_trained = episodes[episodes["condition"] == AS_TRAINED]
    differences = {}
    for name in episodes["arm"].unique():
        if name == baseline:
            continue
        both = as_trained[as_trained["arm"].isin([baseline, name])]
        over_runs = any(Arm.of(each).differs_from_run_to_run for each in (baseline, name))
        pairs = both.groupby([*(["run"] if over_runs else ["run", "index"]), "arm"])["episode_return"].mean().unstack()
        returns = (pairs[name] - pairs[baseline]).to_numpy()
        counts = both.groupby(["run", "arm"])["violating"].sum().unstack()
        violating = (counts[name] - counts[baseline]).astype(int)
        differences[name] = {
            "return_mean": float(returns.mean()),
            "return_ci95": mean_interval(returns),
            "return_bootstrap_ci95": bootstrap_interval(returns),
            "return_ci95_over": "runs" if over_runs else "episodes",
            "violating_episodes": int(violating.sum()),
            "violating_episodes_by_run": violating.tolist(),
        }
    return differences


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
