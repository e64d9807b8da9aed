"""What a run is to those who execute it and keep its result, and the store of results, from which experiments go on.

Checksums find damage, not forgery: of what is read, only what can be a result of its run comes back.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from agents.agent_file import require_names, write_files
from experiments.errors import ResultsError
from experiments.json_values import from_json, to_json
from ncs_gym.reading import LARGEST_MODEL, read_file
from ncs_gym.validation import reason_of
from shields.atomic_write import write_atomically
from shields.json_documents import document_of, read_content


class Result(Protocol):
    """What a run leaves: a dataclass of numbers, texts and arrays, and the files of an agent."""

    @property
    def outcome(self) -> str:
        """What came out, in one line; empty for nothing that somebody waits for."""
        ...

    @property
    def files(self) -> Mapping[str, bytes]:
        """Contents of the agent's files by name; no field where a run leaves none."""
        ...


class Run(Protocol):
    """Settings of something that one process executes; its result is a pure function of them. Runs are pickled."""

    @property
    def parts(self) -> tuple[str, ...]:
        """What its steps belong to, for the progress bar."""
        ...

    @property
    def unit(self) -> str:
        """What is counted as its steps, for the progress bar; empty if their number says nothing to people."""
        ...

    @property
    def result_type(self) -> type:
        """Dataclass of its result."""
        ...

    @property
    def name(self) -> str:
        """Name in progress lines and messages, and of its file (`file_name`)."""
        ...

    @property
    def key(self) -> str:
        """SHA-256 of everything that the result depends on."""
        ...

    @property
    def total_steps(self) -> int:
        """Number of simulated steps."""
        ...

    @property
    def leaves(self) -> tuple[str, ...]:
        """Names of the files that it leaves."""
        ...

    def execute(self, on_progress: Callable[[int], None], log_folder: Path | None = None) -> Any:
        """Returns the result; calls `on_progress` with the number of steps taken since its last call."""
        ...

    def require(self, result: Any) -> None:
        """Raises unless a result of the right type, from a file say, can be the run's.

        Raises:
            ValueError: If it has a value that the run cannot have had; the message names it.
        """
        ...


_FORMAT = "ncs-gym run 3"


def file_name(run: Run) -> str:
    """Returns the name of a run's file: its name, with hyphens for what is special in file names."""
    return re.sub(r"[^\w.+-]+", "-", run.name) + ".json"


class RunStore:
    """Results of runs in `runs/NAME.json`, and the trained agents beside them in `models/NAME/`.

    Args:
        folder: Folder of the experiment; created if it is missing.

    Raises:
        OSError: If the folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        (folder / "runs").mkdir(parents=True, exist_ok=True)

    def save(self, run: Run, result: Result) -> None:
        """Writes the result of a run, its agent first, so that a stored result is complete.

        Raises:
            AgentError: If a file has none of the names of an agent's.
            OSError: If a file cannot be written.
        """
        require_names(result.files)
        self._path(run).unlink(missing_ok=True)  # an older result must not point to the newer agent
        if result.files:
            (self._folder / "models" / run.name).mkdir(parents=True, exist_ok=True)
        write_files(self._folder / "models" / run.name, result.files)
        digests = {name: hashlib.sha256(file).hexdigest() for name, file in result.files.items()}
        content = {"key": run.key, "result": to_json(result) | {"files": digests}}
        write_atomically(self._path(run), json.dumps(document_of("run", _FORMAT, content)) + "\n")

    def load(self, run: Run, *, of_other_settings: bool = False) -> Any:
        """Returns the stored result of a run; None if there is none or if it belongs to other settings.

        Args:
            run: The run.
            of_other_settings: Take a result of the run's name whatever the settings, if it can be the run's.

        Raises:
            ResultsError: If a file is damaged, or holds what no result of the run can be.
        """
        path = self._path(run)
        if not path.exists():
            return None
        try:
            content = read_content(path, "run", _FORMAT)
            if content["key"] != run.key and not of_other_settings:
                return None
            values = dict(content["result"])
            digests = values.pop("files")
            if not isinstance(digests, dict) or digests.keys() != set(run.leaves):
                raise ValueError(f"files = {digests}")
            result = from_json(values, run.result_type, null=float("nan"))
            run.require(result)
            return replace(result, files=self._files(run, digests)) if digests else result
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            raise ResultsError(
                f"{path} is no result of its run ({reason_of(error)}): delete it to repeat the run"
            ) from error

    def _files(self, run: Run, digests: dict[str, str]) -> dict[str, bytes]:
        files = {}
        for name, checksum in digests.items():
            path = self._folder / "models" / run.name / name
            files[name] = read_file(path, LARGEST_MODEL) if path.is_file() else b""
            if hashlib.sha256(files[name]).hexdigest() != checksum:
                raise ValueError(f"files: {name} is missing or was altered")
        return files

    def _path(self, run: Run) -> Path:
        return self._folder / "runs" / file_name(run)
