"""Results as Parquet files."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from experiments.runs.evaluation_conditions import AS_TRAINED
from experiments.runs.training_run import RunResult
from shields.atomic_write import write_atomically

# Key of the provenance in a file's metadata.
_METADATA = b"ncs-gym"


def write_tables(out: Path, results: Sequence[RunResult], provenance: dict[str, Any]) -> None:
    """Writes `episodes.parquet`, a row per evaluation episode, and `training.parquet`, a row per point of a history.

    Args:
        out: Output folder.
        results: Results of all training runs.
        provenance: Settings, plant, certificate and versions; written into the files' metadata.

    Raises:
        OSError: If a file cannot be written.
    """
    episodes, points = [], []
    for result in results:
        own = {"arm": result.arm, "run": result.index}
        for condition, played in ({AS_TRAINED: result.episodes} | result.conditions).items():
            episodes += [own | asdict(episode) | {"condition": condition} for episode in played]
        points += [own | asdict(point) for point in result.history]
    write_atomically(out / "episodes.parquet", parquet(episodes, provenance))
    write_atomically(out / "training.parquet", parquet(points, provenance))


def parquet(rows: list[dict[str, Any]], provenance: dict[str, Any]) -> bytes:
    """Returns rows as the content of a Parquet file."""
    table = pa.Table.from_pylist(rows)
    table = table.replace_schema_metadata({_METADATA: json.dumps(provenance).encode()})
    buffer = io.BytesIO()
    pq.write_table(table, buffer)
    return buffer.getvalue()
