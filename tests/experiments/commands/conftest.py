"""Commands whose files many tests look at, each run once for all workers."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.command import ATTACK, SMOKE, Run, ncs
from tests.workers import no_worker_processes


def _made(name: str, command: tuple, made_once: Callable) -> tuple[Path, Run]:
    def make(folder: Path) -> None:
        with no_worker_processes():
            run = ncs(*command, "--out", folder / "out")
        (folder / "run.json").write_text(json.dumps(run))

    folder = made_once(name, make)
    run = Run(*json.loads((folder / "run.json").read_text()))
    assert run.returncode == 0, run.stderr
    return folder / "out", run


@pytest.fixture(scope="session")
def smoke(made_once: Callable) -> tuple[Path, Run]:
    """The folder of a short comparison, and what it printed; tests that change the folder copy it."""
    return _made("smoke", SMOKE, made_once)


@pytest.fixture(scope="session")
def attacked(made_once: Callable) -> tuple[Path, Run]:
    """The folder of a short campaign, and what it printed; tests that change the folder copy it."""
    return _made("attacked", ATTACK, made_once)
