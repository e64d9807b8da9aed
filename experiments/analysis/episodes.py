"""The long table of results: one row per evaluation episode, which summaries, pages and Parquet files are made of."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Mapping
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from experiments.runs.scenarios import AS_TRAINED
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
    """Returns a table as the content of a Parquet file, whose metadata say where it comes from.

    Args:
        table: The table.
        summary: Content of summary.json, with settings and versions, and where there is one plant, that and its
            certificate.
    """
    origin = {name: summary[name] for name in _ORIGIN if name in summary}
    content = pa.Table.from_pandas(table, preserve_index=False)
    buffer = io.BytesIO()
    pq.write_table(content.replace_schema_metadata({_METADATA: json.dumps(origin).encode()}), buffer)
    return buffer.getvalue()
