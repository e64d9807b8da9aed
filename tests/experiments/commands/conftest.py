"""Commands whose files many tests look at, each run once for all workers."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.command import SMOKE, Run, succeeded, without_pictures
from tests.product import linear_plant
from tests.workers import no_worker_processes


@pytest.fixture
def plant_file(tmp_path: Path) -> Path:
    """An unstable plant of one state, of which searches take no time."""
    bounds = {"disturbance_bound": 0.02, "sensor_bound": 0.01, "initial_bound": 0.01}
    linear_plant(A=[[1.2]], B=[[1.0]], box=[1.0], u_max=1.0, dt=0.1, **bounds).save(tmp_path / "plant.json")
    return tmp_path / "plant.json"


@pytest.fixture(scope="session")
def smoke(made_once: Callable) -> tuple[Path, Run]:
    """The folder of a short comparison, and what it printed; tests that change the folder copy it."""

    def make(folder: Path) -> None:
        with no_worker_processes(), without_pictures():
            run = succeeded(*SMOKE, "--out", folder / "out")
        (folder / "run.json").write_text(json.dumps(run))

    folder = made_once("smoke", make)
    return folder / "out", Run(*json.loads((folder / "run.json").read_text()))
