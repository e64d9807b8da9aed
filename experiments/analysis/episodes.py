"""The long table of results, a row per evaluation episode, and what is computed from it."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from agents.hyperparams import ALGORITHMS
from agents.results import Episode, TrainingPoint
from experiments.analysis.statistics import bootstrap_interval, clopper_pearson, interquartile_mean, mean_interval
from experiments.runs.arms import Arm, by_arm, is_shield
from experiments.runs.loops import AS_TRAINED
from experiments.runs.training_run import RunResult

# Key of the metadata in a file, and entries of summary.json that it holds.
_METADATA = b"ncs-gym"
_ORIGIN = ("settings", "seeds", "plant", "certificate", "certificate_file", "versions")
# Fields of episodes and of points of a training whose columns have other names.
_COLUMNS = {
    "index": "episode",
    "episode_return": "return",
    "violation_steps": "violating_steps",
    "estimate_violation_steps": "estimate_violating_steps",
    "interventions": "overridden",
    "planned": "from_plan",
    "guaranteed": "proof_held",
    "proved": "proved_steps",
    "multiplier": "price",
}


def episodes_table(results: Iterable[RunResult], **common: Any) -> pd.DataFrame:
    """Returns a row per evaluation episode, with `common` values in all; docs/experiments.md has the columns."""
    rows = [
        common | _of_arm(result.arm) | {"run": result.index, "scenario": scenario} | _columns(episode)
        for result in results
        for scenario, played in ({AS_TRAINED: result.episodes} | result.scenarios).items()
        for episode in played
    ]
    table = pd.DataFrame(rows)
    return table.assign(violating=table["violating_steps"] > 0, outside_S=~(table["times_safe_set"] <= 1.0))


def _columns(row: Episode | TrainingPoint) -> dict[str, Any]:
    return {_COLUMNS.get(name, name): value for name, value in vars(row).items()}


def _of_arm(name: str) -> dict[str, str]:
    """Returns the columns of an arm: its name, and its algorithm if it has one of its own."""
    algorithm = name.partition(" ")[0]
    return {"arm": name} | ({"algorithm": algorithm} if algorithm in ALGORITHMS else {})


def training_table(results: Iterable[RunResult], **common: Any) -> pd.DataFrame:
    """Returns a row per point of a training's history, with totals so far; docs/experiments.md explains the columns."""
    rows = [
        common | _of_arm(result.arm) | {"run": result.index} | _columns(point)
        for result in results
        for point in result.history
    ]
    columns = [_COLUMNS.get(each.name, each.name) for each in fields(TrainingPoint)]  # of no rows, too
    return pd.DataFrame(rows, columns=[*common, "arm", "run", *columns])


def parquet(table: pd.DataFrame, summary: Mapping[str, Any]) -> bytes:
    """Returns a table as a Parquet file, whose metadata say where it comes from."""
    origin = {name: summary[name] for name in _ORIGIN if name in summary}
    content = pa.Table.from_pandas(table, preserve_index=False)
    buffer = io.BytesIO()
    pq.write_table(content.replace_schema_metadata({_METADATA: json.dumps(origin).encode()}), buffer)
    return buffer.getvalue()


# Columns of which a run has a sum, and a mean over its episodes.
_COUNTED = ["steps", "violating_steps", "estimate_violating_steps", "overridden", "from_plan"]
_COUNTED += ["proved_steps", "proof_held", "violating", "outside_S"]
_AVERAGED = ["return", "violating", "outside_S"]


def arm_summaries(results: Sequence[RunResult], mode: str) -> dict[str, dict[str, Any]]:
    """Returns the summary of every arm by its name, in the order of the results."""
    summaries = {}
    for name, runs in by_arm(results).items():
        arm = Arm.of(name, mode)
        fixed = not arm.differs_from_run_to_run
        summaries[name] = arm_summary(runs, arm.mode, fixed_policy=fixed, filters_training=arm.filters_training)
    return summaries


def arm_summary(
    results: Sequence[RunResult], mode: str | None, *, fixed_policy: bool, filters_training: bool = True
) -> dict[str, Any]:
    """Returns the summary of an arm by the results of its runs and parts of its `Arm`, JSON values only.

    `eval_violation_rate_ci95` is the Clopper-Pearson interval of the probability that an episode violates, given the
    trained policies. `eval_violation_steps` and `eval_estimate_violation_steps` are plain counts, because the steps of
    one episode are dependent. `eval_return_ci95` is Student's interval over the mean returns of the runs (null for a
    single run), because training differs from run to run; for a policy that is the same in all runs (`fixed_policy`) it
    is over the episodes. The bootstrap intervals are over the same values. `plan_rate` is the share of steps that are
    executed from a stored plan (mode "lookahead"). `conditions` holds the same numbers for each other scenario.
    """
    steps = sum(result.train_steps for result in results)
    violations = [result.train_violation_steps for result in results]
    conditions = {
        name: _evaluated(played, fixed_policy=fixed_policy)
        for name, played in episodes_table(results).groupby("scenario", sort=False)
    }
    return {
        "mode": mode,
        "train_mode": mode if filters_training else None,
        "shielded": is_shield(mode),
        "runs": len(results),
        "train_steps": steps,
        "train_violation_steps": sum(violations),
        "train_violation_steps_by_run": violations,
        "train_intervention_rate": sum(result.train_interventions for result in results) / steps if steps else 0.0,
        **conditions.pop(AS_TRAINED),
        "conditions": conditions,
    }


def _evaluated(episodes: pd.DataFrame, *, fixed_policy: bool) -> dict[str, Any]:
    """Returns what a summary says of the evaluation episodes of an arm in one scenario."""
    runs, count = episodes.groupby("run"), len(episodes)
    means, sums = runs[_AVERAGED].mean(), runs[_COUNTED].sum()
    total = {name: int(number) for name, number in sums.sum().items()}
    values = (episodes if fixed_policy else means)["return"].to_numpy()
    return {
        "eval_episodes": count,
        "eval_steps": total["steps"],
        "eval_violation_steps": total["violating_steps"],
        "eval_estimate_violation_steps": total["estimate_violating_steps"],
        "eval_proved_steps": total["proved_steps"],
        "eval_violating_episodes": total["violating"],
        "eval_violation_rate": total["violating"] / count,
        "eval_violation_rate_ci95": clopper_pearson(total["violating"], count),
        "eval_episodes_outside_set": total["outside_S"],
        "eval_return_mean": float(means["return"].mean()),
        "eval_return_ci95": mean_interval(values),
        "eval_return_bootstrap_ci95": bootstrap_interval(values),
        "eval_return_iqm": float(interquartile_mean(values)),
        "eval_return_iqm_bootstrap_ci95": bootstrap_interval(values, statistic=interquartile_mean),
        "eval_return_ci95_over": "episodes" if fixed_policy else "runs",
        "eval_return_by_run": means["return"].tolist(),
        "eval_violation_rate_by_run": means["violating"].tolist(),
        "eval_outside_set_rate_by_run": means["outside_S"].tolist(),
        "intervention_rate_by_run": (sums["overridden"] / sums["steps"]).tolist(),
        "intervention_rate": total["overridden"] / total["steps"],
        "plan_rate": total["from_plan"] / total["steps"],
        "guaranteed_episodes": total["proof_held"],
        "times_safe_set": float(episodes["times_safe_set"].max()),
    }


def paired_differences(episodes: pd.DataFrame, baseline: str) -> dict[str, Any]:
    """Returns the differences between each other arm and the baseline, JSON values.

    Returns differ in the mean over episodes with the same numbers; intervals are over the runs, or over the episodes
    where both policies are the same in all runs (`return_ci95_over`).
    """
    as_trained = episodes[episodes["scenario"] == AS_TRAINED]
    differences = {}
    for name in episodes["arm"].unique():
        if name == baseline:
            continue
        both = as_trained[as_trained["arm"].isin([baseline, name])]
        over_runs = any(Arm.of(each).differs_from_run_to_run for each in (baseline, name))
        pairs = both.groupby([*(["run"] if over_runs else ["run", "episode"]), "arm"])["return"].mean().unstack()
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
