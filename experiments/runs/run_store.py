"""Results of finished training runs in a folder, so that an interrupted experiment continues where it stopped."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

from agents.sharing.agent_file import require_names, write_files
from experiments.errors import ResultsError
from experiments.runs.provenance import json_digest
from experiments.runs.stored_result import content_of, result_of
from experiments.runs.training_run import RunResult, TrainingRun
from ncs_gym.validation import MAX_QUOTED_LENGTH
from shields.atomic_write import write_atomically

_FORMAT = "ncs-gym unit 2"
# What stands for a finished experiment, and what is drawn and listed of it: patterns where names depend on settings.
_TABLES = ("episodes.parquet", "training.parquet", "sweep.parquet", "study.parquet")
_FIGURES = ("scatter", "training", "episode", "phase", "violations", "return", "interventions", "states", "inputs")
_MADE_OF_RESULTS = (
    "summary.json",
    "report.html",
    *_TABLES,
    *(f"figures/{name}.png" for name in (*_FIGURES, "trusting-*")),
)


def prepare_output(folder: Path) -> None:
    """Creates an output folder and removes an earlier summary, tables, figures and report, which belong together.

    Files of other names are left where they are.

    Raises:
        OSError: If the folder cannot be written.
    """
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    write_atomically(folder / ".writable", "")
    (folder / ".writable").unlink()
    for file in [file for pattern in _MADE_OF_RESULTS for file in folder.glob(pattern)]:
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
            AgentError: If a file has none of the names of an agent's.
            OSError: If a file cannot be written.
        """
        require_names(result.files)
        self._path(run).unlink(missing_ok=True)  # an older result must not point to the newer agent
        models = self._folder / "models" / run.name
        if result.files:
            models.mkdir(exist_ok=True)
        write_files(models, result.files)
        content = content_of(result)
        document = {"format": _FORMAT, "key": run.key, "sha256": json_digest(content), "result": content}
        write_atomically(self._path(run), json.dumps(document) + "\n")

    def load(self, run: TrainingRun) -> RunResult | None:
        """Returns the stored result of a run; None if there is none or if it belongs to other settings.

        Raises:
            ResultsError: If a file is damaged, or holds what no result of the run can be.
        """
        path = self._path(run)
        try:
            document = json.loads(path.read_bytes())
            if document["format"] != _FORMAT:
                return None
            content = document["result"]
            if document["sha256"] != json_digest(content):
                raise ResultsError(f"{path} was altered: its checksum does not match; delete it to repeat the run")
            if document["key"] != run.key:
                return None
            result, digests = result_of(content, run)
            return replace(result, files=self._files(run, digests))
        except FileNotFoundError:
            return None
        except ResultsError:
            raise
        except ValueError as error:
            reason = " ".join(str(error).split())[:MAX_QUOTED_LENGTH]
            raise ResultsError(f"{path} is damaged ({reason}); delete it to repeat the run") from error
        except (KeyError, TypeError, RecursionError) as error:
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
