"""What a training goes on from in the folder of `ncs train`: its finished agent, or the one of an interruption."""

from __future__ import annotations

import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

from agents.agent_file import AGENT_FILES, write_files
from agents.results import HISTORY_FILE, TrainingPoint, history_document
from experiments.errors import ResultsError
from experiments.json_values import from_json
from experiments.runs.run_store import RunStore
from experiments.runs.training_run import CHECKPOINT, Start, TrainingRun
from ncs_gym.reading import LARGEST_MODEL, json_values, read_file
from ncs_gym.validation import reason_of
from shields.atomic_write import write_atomically

# Folder of the agent that the training in an output folder went on from.
_START = "start"


def resumed(folder: Path, run: TrainingRun, *, anew: bool) -> TrainingRun:
    """Returns a run that goes on from the longest training in a folder, which is kept in `start` there.

    Args:
        folder: Output folder.
        run: The run from its beginning, of the settings of the folder but for a larger number of steps.
        anew: Whether to begin anew, whatever there is.

    Raises:
        ResultsError: If a file is missing or damaged.
        OSError: If a file cannot be read or written.
    """
    if not run.trains:
        return run
    checkpoint = folder / "tensorboard" / run.name / CHECKPOINT
    if anew:
        for each in (folder / _START, checkpoint):
            shutil.rmtree(each, ignore_errors=True)
        return run
    known = _read(folder / _START)
    run, store = replace(run, start=known), RunStore(folder)
    if store.load(run) is not None:
        return run
    finished = store.load(replace(run, steps=1), of_other_settings=True)  # of any number of steps
    found = [finished and Start(finished.files, finished.history), _read(checkpoint)]
    longer = [each for each in found if each and (known.steps if known else 0) < each.steps < run.steps]
    if not longer:
        return run
    start = max(longer, key=lambda each: each.steps)
    shutil.rmtree(folder / _START, ignore_errors=True)
    (folder / _START).mkdir()
    write_files(folder / _START, start.files)
    write_atomically(folder / _START / HISTORY_FILE, history_document(start.history))
    return replace(run, start=start)


def forget_checkpoint(folder: Path, run: TrainingRun) -> None:
    """Removes the checkpoint of a training that is finished."""
    shutil.rmtree(folder / "tensorboard" / run.name / CHECKPOINT, ignore_errors=True)


def _read(folder: Path) -> Start | None:
    """Returns the agent and the history in a folder; None if the folder has none."""
    path = folder / HISTORY_FILE
    if not path.exists():
        return None
    try:
        history = from_json(json_values(read_file(path)), list[TrainingPoint], null=float("nan"))
        if not history or not all(a.steps < b.steps for a, b in pairwise([TrainingPoint(0, 0.0, 0, 0), *history])):
            raise ValueError("its steps do not grow")
        return Start({name: read_file(folder / name, LARGEST_MODEL) for name in AGENT_FILES}, history)
    except (OSError, TypeError, ValueError, RecursionError) as error:
        raise ResultsError(
            f"no training can go on from {folder} ({reason_of(error)}): remove it, or give --force"
        ) from error
