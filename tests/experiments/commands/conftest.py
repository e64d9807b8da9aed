"""Commands whose files many tests look at, each run once for all workers."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest

from tests.command import SMOKE, Run, ncs
from tests.product import linear_plant
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


@pytest.fixture
def plant_file(tmp_path: Path) -> Path:
    """An unstable plant of one state, of which searches take no time."""
    bounds = {"disturbance_bound": 0.02, "sensor_bound": 0.01, "initial_bound": 0.01}
    linear_plant(A=[[1.2]], B=[[1.0]], box=[1.0], u_max=1.0, dt=0.1, **bounds).save(tmp_path / "plant.json")
    return tmp_path / "plant.json"


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., Path]:
    """Writes when packets were sent and came, so much later [s]; a share of them, drawn by a seed, was lost."""

    def write(sent: Iterable[float], delay: float = 0.0, loss: float = 0.0, seed: int = 0) -> Path:
        rng = np.random.default_rng(seed)
        lines = [f"{each:.3f},{'' if rng.random() < loss else f'{each + delay:.3f}'}" for each in sent]
        (tmp_path / "packets.csv").write_text("sent,received\n" + "\n".join(lines))
        return tmp_path / "packets.csv"

    return write


@pytest.fixture(scope="session")
def smoke(made_once: Callable) -> tuple[Path, Run]:
    """The folder of a short comparison, and what it printed; tests that change the folder copy it."""
    return _made("smoke", SMOKE, made_once)
