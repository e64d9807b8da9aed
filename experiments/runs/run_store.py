"""Results of finished training runs in a folder, so that an interrupted experiment continues where it stopped.

Checksums find damage, not forgery: of what is read, only what can be a result of its run comes back.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from agents.results import Episode, TrainingPoint, Trajectory
from agents.sharing.agent_file import AGENT_FILES, require_names, write_files
from experiments.errors import ResultsError
from experiments.runs.training_run import RunResult, TrainingRun
from ncs_gym.validation import LARGEST_NUMBER, MAX_QUOTED_LENGTH, as_numbers, shown
from shields.atomic_write import write_atomically
from shields.json_documents import digest

_FORMAT = "ncs-gym unit 2"
# Counts are numbers that floats and tables hold exactly.
LARGEST_COUNT = 2**53
_FLAGS = ("intervened", "arrivals")
_Entry = TypeVar("_Entry", TrainingPoint, Episode)


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
        content = _content_of(result)
        document = {"format": _FORMAT, "key": run.key, "sha256": digest(content), "result": content}
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
            if document["sha256"] != digest(content):
                raise ResultsError(f"{path} was altered: its checksum does not match; delete it to repeat the run")
            if document["key"] != run.key:
                return None
            result, digests = _result_of(content, run)
            return replace(result, files=self._files(run, digests))
        except FileNotFoundError:
            return None
        except ResultsError:
            raise
        except (KeyError, TypeError, RecursionError, json.JSONDecodeError, UnicodeDecodeError) as error:
            raise ResultsError(f"{path} is damaged; delete it to repeat the run") from error
        except ValueError as error:
            reason = " ".join(str(error).split())[:MAX_QUOTED_LENGTH]
            raise ResultsError(f"{path} is no result of its run ({reason}); delete it to repeat the run") from error

    def _files(self, run: TrainingRun, digests: dict[str, str]) -> dict[str, bytes]:
        """Returns the contents of the agent's files; ResultsError if one is missing or is not the one stored."""
        files = {}
        for name, checksum in digests.items():
            path = self._folder / "models" / run.name / name
            content = path.read_bytes() if path.is_file() else b""
            if hashlib.sha256(content).hexdigest() != checksum:
                raise ResultsError(f"{path} is missing or was altered; delete {self._path(run)} to repeat the run")
            files[name] = content
        return files

    def _path(self, run: TrainingRun) -> Path:
        return self._folder / "units" / f"{run.name}.json"


def _content_of(result: RunResult) -> dict[str, Any]:
    """Returns a result as JSON values: NaN is null, and files are represented by their checksums."""
    content = asdict(result)
    content["history"], content["episodes"] = _without_nan(content["history"]), _without_nan(content["episodes"])
    content["conditions"] = {name: _without_nan(episodes) for name, episodes in content["conditions"].items()}
    content["trajectory"] = {name: array.tolist() for name, array in content["trajectory"].items()}
    content["files"] = {name: hashlib.sha256(file).hexdigest() for name, file in result.files.items()}
    return content


def _result_of(content: Any, run: TrainingRun) -> tuple[RunResult, dict[str, str]]:
    """Returns the result that `_content_of` was given, without its files, and their checksums by name.

    Args:
        content: JSON values.
        run: The run whose result it has to be.

    Raises:
        ValueError: If a result of the run cannot have such a value; the message names the first.
    """
    _require_entries(content, {each.name for each in fields(RunResult)}, "entries of the result")
    for name, own in (("arm", run.arm), ("index", run.index)):
        _require(type(content[name]) is type(own) and content[name] == own, name, content[name])
    train_steps = count_of(content["train_steps"], "train_steps")
    _require(train_steps >= run.steps if run.trains else train_steps == 0, "train_steps", train_steps)
    violations, interventions = (
        count_of(content[name], name, high=train_steps) for name in ("train_violation_steps", "train_interventions")
    )
    episodes = _episodes(content["episodes"], run, "episodes")
    _require_entries(content["conditions"], set(run.conditions), "conditions")
    conditions = {name: _episodes(content["conditions"][name], run, f"conditions, {name}") for name in run.conditions}
    result = RunResult(
        arm=run.arm,
        index=run.index,
        train_steps=train_steps,
        train_violation_steps=violations,
        train_interventions=interventions,
        history=_history(content["history"], train_steps),
        episodes=episodes,
        trajectory=_trajectory(content["trajectory"], episodes[0].steps, run),
        files={},
        conditions=conditions,
    )
    digests = content["files"]
    _require_entries(digests, set(AGENT_FILES) if run.trains else set(), "files")
    for checksum in digests.values():
        _require(isinstance(checksum, str), "files", checksum)
    return result, digests


def count_of(value: Any, name: str, *, low: int = 0, high: int = LARGEST_COUNT) -> int:
    """Returns a JSON value that counts something.

    Args:
        value: The value.
        name: What a message calls it.
        low: Smallest possible count.
        high: Largest possible count.

    Raises:
        ValueError: If it is no whole number, or out of range.
    """
    _require(type(value) is int and low <= value <= high, name, value)
    return value


def _history(content: Any, train_steps: int) -> list[TrainingPoint]:
    """Returns the points of a history, whose totals do not fall; there are some if anything was trained."""
    name = "history"

    def point(values: dict[str, Any]) -> TrainingPoint:
        steps = count_of(values["steps"], f"{name}, steps", low=1, high=train_steps)
        return TrainingPoint(
            steps=steps,
            episode_return=_number(values["episode_return"], f"{name}, episode_return", or_nan=True),
            violation_steps=count_of(values["violation_steps"], f"{name}, violation_steps", high=steps),
            interventions=count_of(values["interventions"], f"{name}, interventions", high=steps),
        )

    points = _listed(content, TrainingPoint, point, name)
    _require(bool(points) == bool(train_steps), name, points)
    for before, after in pairwise(points):
        grows = before.steps < after.steps
        falls = after.violation_steps < before.violation_steps or after.interventions < before.interventions
        _require(grows and not falls, name, after)
    return points


def _episodes(content: Any, run: TrainingRun, name: str) -> list[Episode]:
    """Returns as many episodes as the run has, in their order."""
    counts = ("violation_steps", "estimate_violation_steps", "interventions", "planned")

    def episode(values: dict[str, Any]) -> Episode:
        steps = count_of(values["steps"], f"{name}, steps", low=1)
        _require(isinstance(values["guaranteed"], bool), f"{name}, guaranteed", values["guaranteed"])
        level = _number(values["largest_level"], f"{name}, largest_level")
        _require(level >= 0.0, f"{name}, largest_level", level)
        return Episode(
            index=count_of(values["index"], f"{name}, index"),
            steps=steps,
            episode_return=_number(values["episode_return"], f"{name}, episode_return"),
            guaranteed=values["guaranteed"],
            largest_level=level,
            **{each: count_of(values[each], f"{name}, {each}", high=steps) for each in counts},
        )

    episodes = _listed(content, Episode, episode, name)
    indices = [each.index for each in episodes]
    _require(indices == list(range(run.episodes)), name, indices)
    return episodes


def _trajectory(content: Any, steps: int, run: TrainingRun) -> Trajectory:
    """Returns the trajectory of an episode of a plant with m inputs and n states."""
    m, n = run.certificate.K.shape
    states, inputs = (steps + 1, n), (steps, m)
    shapes = {"states": states, "estimates": states, "inputs": inputs, "proposed": inputs}
    shapes |= dict.fromkeys(_FLAGS, (steps,))
    _require_entries(content, set(shapes), "trajectory")
    arrays = {}
    for name, shape in shapes.items():
        numbers = as_numbers(content[name])
        fits = numbers is not None and numbers.shape == shape and bool(np.isfinite(numbers).all())
        is_of_kind = fits and (np.asarray(content[name]).dtype == np.bool_) == (name in _FLAGS)
        _require(is_of_kind, f"trajectory, {name}", content[name])
        arrays[name] = np.array(content[name], np.bool_ if name in _FLAGS else np.float64)
    return Trajectory(**arrays)


def _listed(content: Any, kind: type[_Entry], read: Callable[[dict[str, Any]], _Entry], name: str) -> list[_Entry]:
    """Returns the entries of a list, each read from an object that has the fields of its kind."""
    _require(isinstance(content, list), name, content)
    for each in content:
        _require_entries(each, {entry.name for entry in fields(kind)}, name)
    return [read(each) for each in content]


def _number(value: Any, name: str, *, or_nan: bool = False) -> float:
    """Returns a finite number; null stands for NaN, if that may be."""
    if or_nan and value is None:
        return float("nan")
    _require(type(value) in (int, float) and abs(value) < LARGEST_NUMBER, name, value)  # nor NaN
    return float(value)


def _require_entries(content: Any, names: set[str], name: str) -> None:
    """Raises ValueError unless a value is an object with exactly these entries."""
    _require(isinstance(content, Mapping) and content.keys() == names, name, content)


def _require(holds: bool, name: str, value: Any) -> None:
    if not holds:
        raise ValueError(f"{name} of this run cannot be {shown(value)}")


def _without_nan(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns entries with null in the place of NaN."""
    return [{key: None if x != x else x for key, x in entry.items()} for entry in entries]
