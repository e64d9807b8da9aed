"""Runs of no work, and a command that executes two of them in the folder given."""

from __future__ import annotations

import os
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.backends.execution import RunError
from experiments.runs.training_run import RunResult
from tests.experiments.results import run


@dataclass(frozen=True)
class Small:
    """A run that works, fails, dies, or waits until it is told to stop, once a file is there."""

    name: str
    does: str
    folder: Path
    awaits: str = ""

    total_steps = 5
    trains = False

    @property
    def key(self) -> str:
        return f"{self.name} {self.does}"

    def execute(self, on_progress: Callable[[int], None], log_folder: Path | None = None) -> RunResult:
        while self.awaits and not (self.folder / self.awaits).exists():
            time.sleep(0.01)
        with (self.folder / f"{self.name} began").open("a") as file:
            file.write("began\n")
        if self.does == "die":
            os._exit(1)
        if self.does == "fail":
            raise KeyError("mine")
        try:
            while self.does == "wait":
                time.sleep(0.01)
                on_progress(0)
        except RunError:
            (self.folder / f"{self.name} gave up").touch()
            raise
        warnings.warn(f"{self.name} warns", stacklevel=1)
        on_progress(5)
        return run(f"{self.name} said so")


def waiting(settings: Any) -> None:
    """Stands for `ncs compare`: one run works, another waits."""
    from experiments.backends.execution import results_of

    out = settings.out
    results_of([Small("a", "work", out), Small("b", "wait", out, awaits="runs/a.json")], out, settings)


if __name__ == "__main__":
    from experiments.__main__ import main
    from experiments.commands import compare
    from tests.experiments.backends import small_runs  # not this one: workers import what they are handed

    compare.compare = small_runs.waiting
    sys.argv[:] = ["ncs", "compare", "--jobs", "2", "--out", sys.argv[1]]
    main()
