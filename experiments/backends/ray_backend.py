"""Runs units on a Ray cluster. Scheduling and retries are Ray's; the driver alone writes."""

from __future__ import annotations

import logging
import os
import pickle
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import chdir, closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import ray  # pyright: ignore[reportMissingImports]
from ray.exceptions import LocalRayletDiedError, RayError, RayTaskError  # pyright: ignore[reportMissingImports]

from experiments.backends.progress import REFRESH, progress_bar, show_result
from experiments.backends.ray_cluster import Need, Room, carried_work, collect, require_answer, stream
from experiments.errors import ClusterError, RunError
from experiments.runs.provenance import versions
from experiments.runs.training_run import Unit, UnitResult
from experiments.settings.backend import OWN_RAY, EngineSettings

# How often Ray starts a unit again whose worker died.
RETRIES = 3
# Where the four packages are.
ROOT = Path(__file__).resolve().parents[2]


def run_all(
    units: Sequence[Unit],
    steps: Callable[[Unit], int],
    settings: EngineSettings,
    on_result: Callable[[Unit, UnitResult], None],
) -> None:
    """Runs all units; the first failure stops the rest and is raised.

    Args:
        units: What to run.
        steps: Returns how many steps a unit takes, for the progress bar.
        settings: Which cluster, and what a run reserves.
        on_result: Called with every unit and its result as soon as it is there.

    Raises:
        ClusterError: If the cluster cannot be reached, is too small, or has other versions.
        RunError: If a unit fails, or its workers die more often than Ray retries.
    """
    need, expected = Need(settings.cpus_per_run, settings.gpus_per_run), versions()
    with _connected(settings.ray_address):
        _require_place(need, settings.ray_wait)
        task = _task(carried_work(), need)

        def submit(unit: Unit) -> Any:
            return task.remote(expected, pickle.dumps(unit))

        with progress_bar(sum(map(steps, units))) as bar:

            def keep(unit: Unit, result: UnitResult) -> None:
                on_result(unit, result)
                bar.update(steps(unit))
                show_result(bar, unit, result)

            def wait(references: list[Any]) -> list[Any]:
                bar.update(0)
                return finished(references)

            room = Room(lambda: sum(map(need.places, _nodes())))
            with closing(stream(units, submit, wait, _cancel, room)) as batches:
                collect(batches, _result, keep)


def finished(references: list[Any]) -> list[Any]:
    """Returns all references that are finished, after a while also none."""
    some, _ = ray.wait(references, timeout=REFRESH, fetch_local=False)
    return ray.wait(references, num_returns=len(references), timeout=0, fetch_local=False)[0] if some else []


@contextmanager
def _connected(address: str) -> Iterator[None]:
    """Joins a cluster, or starts one that ends with this process, and leaves it as it was."""
    own = address == OWN_RAY
    if not own:
        require_answer(address)
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    # As many threads of linear algebra as in a local worker: Ray would set their number by the reserved cores.
    threads = os.environ.get("OMP_NUM_THREADS", str(os.cpu_count()))
    environment = {"env_vars": {"OMP_NUM_THREADS": threads}}
    options: dict[str, Any] = {"include_dashboard": False} if own else {}
    try:
        with chdir(ROOT):  # Ray puts the working folder first on the path of its workers: another one may hide ours
            ray.init(address, runtime_env=environment, logging_level=logging.ERROR, log_to_driver=False, **options)
        for number, handler in handlers.items():
            with suppress(ValueError):  # only the main thread has handlers
                signal.signal(number, handler)
        yield
    finally:
        ray.shutdown()


def _task(function: Callable[..., Any], need: Need) -> Any:
    """Returns a function that Ray calls on a node with room, again if the worker dies, not if it raises."""
    return ray.remote(function).options(
        num_cpus=need.cpus, num_gpus=need.gpus, max_retries=RETRIES, retry_exceptions=False
    )


def _require_place(need: Need, patience: float) -> None:
    """Returns if a node is large enough for a run, or becomes so.

    Raises:
        ClusterError: If none is: Ray would wait for one forever.
    """
    if any(map(need.places, _nodes())):
        return
    if patience:
        print(f"no node is large enough yet; waiting up to {patience:g} s for one", file=sys.stderr)
        asked = _task(_nothing, need).remote()  # what a cluster grows by is unmet demand
        if ray.wait([asked], timeout=patience)[0]:
            return
        _cancel([asked])
    raise need.too_small(_nodes())


def _nothing() -> None:
    """Does nothing."""


def _nodes() -> list[dict[str, float]]:
    """Returns the resources of every living node."""
    return [node["Resources"] for node in ray.nodes() if node["Alive"]]


def _result(unit: Unit, reference: Any) -> UnitResult:
    """Returns the result of a finished unit.

    Raises:
        ClusterError: If the node that ran it has other versions, or Ray has ended here.
        RunError: If it failed.
    """
    try:
        return ray.get(reference)
    except RayTaskError as error:
        if isinstance(error.cause, ClusterError):
            raise error.cause from error
        raise RunError.of(unit.name, error.cause) from error
    except LocalRayletDiedError as error:
        raise ClusterError("Ray has ended on this machine: the same command goes on from what is stored") from error
    except RayError as error:
        lost = f"its worker died, {RETRIES} retries included ({type(error).__name__})"
        raise RunError(f"run {unit.name}: {lost}") from error


def _cancel(references: list[Any]) -> None:
    """Stops units at once, also those that are being worked on."""
    for reference in references:
        ray.cancel(reference, force=True)
