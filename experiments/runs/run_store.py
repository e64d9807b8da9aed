"""Finished units in a folder, so that an interrupted experiment goes on where it was."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from agents.evaluation import Episode
from agents.history import TrainingPoint
from agents.trajectory import Trajectory
from experiments.errors import ResultsError
from experiments.runs.training_run import Unit, UnitResult
from shields.atomic_write import write_atomically

FORMAT = "ncs-gym unit 1"


class UnitStore:
    """Results of units: `units/NAME.json`, and the trained agents beside them in `models/NAME/`.

    Args:
        folder: Of the experiment; made if it is missing.

    Raises:
        OSError: If it cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        for name in ("units", "models"):
            (folder / name).mkdir(parents=True, exist_ok=True)

    def save(self, unit: Unit, result: UnitResult) -> None:
        """Writes a result, its agent first, so that a stored result is complete.

        Raises:
            OSError: If a file cannot be written.
        """
        self._path(unit).unlink(missing_ok=True)  # an older result must not point to the newer agent
        models = self._folder / "models" / unit.name
        if result.files:
            models.mkdir(exist_ok=True)
        for name, content in result.files.items():
            write_atomically(models / name, content)
        content = _content(result)
        document = {"format": FORMAT, "key": unit.key, "sha256": _digest(content), "result": content}
        write_atomically(self._path(unit), json.dumps(document) + "\n")

    def load(self, unit: Unit) -> UnitResult | None:
        """Returns the stored result of a unit; None if there is none or it is that of other settings.

        Raises:
            ResultsError: If a file is damaged.
        """
        path = self._path(unit)
        try:
            text = path.read_bytes()
        except FileNotFoundError:
            return None
        try:
            document = json.loads(text)
            if document["format"] != FORMAT:
                return None
            if document["sha256"] != _digest(document["result"]):
                raise ResultsError(f"{path} was altered: its checksum does not match; delete it to run the unit again")
            return _result(document["result"], self._files(unit, document)) if document["key"] == unit.key else None
        except ResultsError:
            raise
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            raise ResultsError(f"{path} is damaged; delete it to run the unit again") from error

    def _files(self, unit: Unit, document: dict[str, Any]) -> dict[str, bytes]:
        """Returns the agent's files.

        Raises:
            ResultsError: If one is missing or not the one that was stored.
        """
        files = {}
        for name, digest in document["result"]["files"].items():
            path = self._folder / "models" / unit.name / name
            content = path.read_bytes() if path.is_file() else b""
            if hashlib.sha256(content).hexdigest() != digest:
                raise ResultsError(f"{path} is missing or was altered; delete {self._path(unit)} to run the unit again")
            files[name] = content
        return files

    def _path(self, unit: Unit) -> Path:
        return self._folder / "units" / f"{unit.name}.json"


def _content(result: UnitResult) -> dict[str, Any]:
    """Returns a result as JSON values; files by their checksums."""
    trajectory = {entry.name: getattr(result.trajectory, entry.name).tolist() for entry in fields(Trajectory)}
    return {
        "arm": result.arm,
        "index": result.index,
        "train_steps": result.train_steps,
        "train_violation_steps": result.train_violation_steps,
        "train_interventions": result.train_interventions,
        "history": [_without_nan(asdict(point)) for point in result.history],
        "episodes": [_without_nan(asdict(episode)) for episode in result.episodes],
        "trajectory": trajectory,
        "files": {name: hashlib.sha256(content).hexdigest() for name, content in result.files.items()},
    }


def _result(content: dict[str, Any], files: dict[str, bytes]) -> UnitResult:
    """Returns the result that `_content` made."""
    flags = ("intervened", "arrivals")
    arrays = {name: np.array(v, np.bool_ if name in flags else float) for name, v in content["trajectory"].items()}
    values = content | {
        "history": [TrainingPoint(**_with_nan(point)) for point in content["history"]],
        "episodes": [Episode(**_with_nan(episode)) for episode in content["episodes"]],
        "trajectory": Trajectory(**arrays),
        "files": files,
    }
    return UnitResult(**values)


def _without_nan(values: dict[str, Any]) -> dict[str, Any]:
    return {name: None if value != value else value for name, value in values.items()}


def _with_nan(values: dict[str, Any]) -> dict[str, Any]:
    return {name: float("nan") if value is None else value for name, value in values.items()}


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
