"""Runs that never end, and a command that executes them: `python -m tests.experiments.backends.endless_runs`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Endless:
    """A run that hears that it is to stop when it reports, or never does."""

    name: str
    reports: bool

    total_steps = 10**9
    parts = ("waiting",)
    unit = "step"

    def execute(self, on_progress: Callable[[int], None], log_folder: Path | None = None) -> Any:
        """Never returns."""
        while True:
            time.sleep(0.01)
            if self.reports:
                on_progress(0)


def endless(settings: Any) -> None:
    """Stands for `ncs compare`."""
    from experiments.backends.execution import execute, executor_of

    reports = settings.seed == 0
    runs = [Endless(f"{name}-{number}", reports) for name in ("a", "b") for number in range(3)]
    print("begins", flush=True)
    execute(runs, executor_of(settings, len(runs), Path("nowhere")), lambda run, result: None)


if __name__ == "__main__":
    from experiments.__main__ import COMMANDS, main

    COMMANDS["compare"] = ("CompareSettings", "tests.experiments.backends.endless_runs:endless", {})
    sys.argv[:1] = ["ncs", "compare", "--jobs", "2"]
    main()
