"""Results of finished training runs in a folder, so that an interrupted experiment continues where it stopped."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from agents.results import Episode, TrainingPoint, Trajectory
from experiments.errors import ResultsError
from experiments.runs.provenance import json_digest
from experiments.runs.training_run import RunResult, TrainingRun
from shields.atomic_write import write_atomically

_FORMAT = "ncs-gym unit 2"


def prepare_output(folder: Path) -> None:
    """Creates an output folder and removes an earlier summary, tables, figures and report, which belong together.

    Raises:
        OSError: If the folder cannot be written.
    """
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    write_atomically(folder / ".writable", "")
    (folder / ".writable").unlink()
    stale = (folder / "summary.json", folder / "report.html", *folder.glob("*.parquet"), *folder.glob("figures/*.png"))
    for file in stale:
        file.unlink(missing_ok=True)


class RunStore:
    """Results of training runs in `units/NAME.json`, and the trained agents beside them in `models/NAME/`.

    Args:
        folder: Folder of the experiment; created if it is missing.

    Raises:
        OSError: If the folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        for name in ("units", "models"):
            (folder / name).mkdir(parents=True, exist_ok=True)

    def save(self, run: TrainingRun, result: RunResult) -> None:
        """Writes the result of a run, its agent first, so that a stored result is complete.

        Raises:
            OSError: If a file cannot be written.
        """
        self._path(run).unlink(missing_ok=True)  # an older result must not point to the newer agent
        models = self._folder / "models" / run.name
        if result.files:
            models.mkdir(exist_ok=True)
        for name, content in result.files.items():
            write_atomically(models / name, content)
        content = _to_json(result)
        document = {"format": _FORMAT, "key": run.key, "sha256": json_digest(content), "result": content}
        write_atomically(self._path(run), json.dumps(document) + "\n")

    def load(self, run: TrainingRun) -> RunResult | None:
        """Returns the stored result of a run; None if there is none or if it belongs to other settings.

        Raises:
            ResultsError: If a file is damaged.
        """
        path = self._path(run)
        try:
            document = json.loads(path.read_bytes())
            if document["format"] != _FORMAT:
                return None
            content = document["result"]
            if document["sha256"] != json_digest(content):
                raise ResultsError(f"{path} was altered: its checksum does not match; delete it to repeat the run")
            return _from_json(content, self._files(run, content["files"])) if document["key"] == run.key else None
        except FileNotFoundError:
            return None
        except ResultsError:
            raise
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            raise ResultsError(f"{path} is damaged; delete it to repeat the run") from error

    def _files(self, run: TrainingRun, digests: dict[str, str]) -> dict[str, bytes]:
        """Returns the contents of the agent's files; ResultsError if one is missing or is not the one stored."""
        files = {}
        for name, digest in digests.items():
            path = self._folder / "models" / run.name / name
            content = path.read_bytes() if path.is_file() else b""
            if hashlib.sha256(content).hexdigest() != digest:
                raise ResultsError(f"{path} is missing or was altered; delete {self._path(run)} to repeat the run")
            files[name] = content
        return files

    def _path(self, run: TrainingRun) -> Path:
        return self._folder / "units" / f"{run.name}.json"


def _to_json(result: RunResult) -> dict[str, Any]:
    """Returns a result as JSON values: NaN is null, and files are represented by their checksums."""
    content = asdict(result)
    content["history"], content["episodes"] = _without_nan(content["history"]), _without_nan(content["episodes"])
    content["conditions"] = {name: _without_nan(episodes) for name, episodes in content["conditions"].items()}
    content["trajectory"] = {name: array.tolist() for name, array in content["trajectory"].items()}
    content["files"] = {name: hashlib.sha256(file).hexdigest() for name, file in result.files.items()}
    return content


def _without_nan(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns entries with null in the place of NaN."""
    return [{key: None if x != x else x for key, x in entry.items()} for entry in entries]


def _from_json(content: dict[str, Any], files: dict[str, bytes]) -> RunResult:
    """Returns the result that `_to_json` was given."""

    def restored(entry: dict[str, Any]) -> dict[str, Any]:
        return {key: float("nan") if x is None else x for key, x in entry.items()}

    flags = ("intervened", "arrivals")
    arrays = {name: np.array(x, np.bool_ if name in flags else float) for name, x in content["trajectory"].items()}
    values = content | {
        "history": [TrainingPoint(**restored(point)) for point in content["history"]],
        "episodes": [Episode(**restored(episode)) for episode in content["episodes"]],
        "conditions": {
            name: [Episode(**restored(episode)) for episode in episodes]
            for name, episodes in content["conditions"].items()
        },
        "trajectory": Trajectory(**arrays),
        "files": files,
    }
    return RunResult(**values)
