"""Results of runs in files: what is there is not run again."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from experiments.terminal import say
from shields.atomic_write import write_atomically


def file_name(run: Any) -> str:
    """Returns the name of a run's file: its name, with hyphens for what is special in file names."""
    return re.sub(r"[^\w.+-]+", "-", run.name) + ".json"


def save(folder: Path, run: Any, result: Any) -> None:
    """Writes the result of a run into `runs/NAME.json`, and before it the agent's files into `models/NAME/`.

    Raises:
        OSError: If a file cannot be written.
    """
    path, models = folder / "runs" / file_name(run), folder / "models" / run.name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)  # an older result must not stand for the newer agent
    for name, content in result.files.items():
        models.mkdir(parents=True, exist_ok=True)
        write_atomically(models / name, content)
    values = {name: value for name, value in asdict(result).items() if name != "files"}
    text = json.dumps({"key": run.key, "result": values}, default=np.ndarray.tolist)
    write_atomically(path, text + "\n")


def load(folder: Path, run: Any) -> Any | None:
    """Returns the result of a run; None if there is none of its settings and versions, or not whole."""
    path = folder / "runs" / file_name(run)
    if not path.exists() or not all((folder / "models" / run.name / name).is_file() for name in run.leaves):
        return None
    try:
        document = json.loads(path.read_bytes())
        return run.result_type.of_json(document["result"]) if document["key"] == run.key else None
    except (OSError, LookupError, TypeError, ValueError, RecursionError):
        say(f"{path} is damaged: its run is done again")
        return None
