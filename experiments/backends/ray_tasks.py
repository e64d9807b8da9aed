"""Executes runs as tasks of a Ray cluster. Scheduling and retries are Ray's; the driver alone writes results."""

from __future__ import annotations

import logging
import os
import platform
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import chdir, contextmanager
from pathlib import Path
from typing import Any

import ray  # pyright: ignore[reportMissingImports]
from ray.exceptions import RayError  # pyright: ignore[reportMissingImports]

from experiments.backends.execution import Engine, RunError, executed
from experiments.runs.provenance import versions
from experiments.runs.training_run import RunResult, TrainingRun

# How often Ray repeats a run whose worker died.
RETRIES = 3
_SOURCE_FOLDER = Path(__file__).resolve().parents[2]


@contextmanager
def ray_tasks(address: str) -> Iterator[Engine]:
    """Yields a cluster, with a core for each run; raises RunError if it cannot be joined.

    The address "local" starts a Ray that ends with this process, "auto" and HOST:PORT join one.
    """
    options: dict[str, Any] = {"logging_level": logging.ERROR, "log_to_driver": False}
    if address == "local":
        options["include_dashboard"] = False
    # As many threads of linear algebra as in a local worker: Ray would set their number by the reserved cores.
    options["runtime_env"] = {"env_vars": {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", str(os.cpu_count()))}}
    references: dict[Future[Any], Any] = {}
    try:
        try:
            # Ray puts the working folder first on the path of its workers: another one may hide our packages.
            with chdir(_SOURCE_FOLDER):
                ray.init(address, **options)
        except (OSError, RuntimeError, ValueError, RayError) as error:
            raise RunError(f"the cluster at --ray-address {address} cannot be joined: {error}") from error
        task = ray.remote(_on_node).options(num_cpus=1, max_retries=RETRIES, retry_exceptions=False)

        def submit(number: int, run: TrainingRun) -> Future[tuple[RunResult, list[str]]]:
            reference = task.remote(versions(), run)
            references[future := reference.future()] = reference
            future.add_done_callback(references.pop)  # a reference that is kept keeps its result in memory
            return future

        yield submit, RayError
    except BaseException:
        for reference in list(references.values()):
            ray.cancel(reference, force=True)
        raise
    finally:
        ray.shutdown()


def _on_node(expected: dict[str, str], run: TrainingRun) -> tuple[RunResult, list[str]]:
    """Returns what `executed` does on a node that has the driver's versions."""
    own = versions()
    if different := sorted(name for name in expected.keys() | own.keys() if expected.get(name) != own.get(name)):
        other = f"node {platform.node()} has another {', '.join(different)} than the driver"
        raise RunError(f"{other}: install the same on every node")
    return executed(run, lambda steps: None)
