"""Executes jobs on a Ray cluster. Scheduling and retries are Ray's; the driver alone writes results."""

from __future__ import annotations

import logging
import os
import pickle
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import chdir, contextmanager, suppress
from pathlib import Path
from typing import Any

import ray  # pyright: ignore[reportMissingImports]
from ray.exceptions import LocalRayletDiedError, RayError, RayTaskError  # pyright: ignore[reportMissingImports]

from experiments.backends.job import Job, OnResult
from experiments.backends.ray_cluster import execute_submitted, portable_task, require_answer
from experiments.errors import ClusterError, RunError
from experiments.runs import versions
from experiments.settings import BackendSettings
from experiments.settings.backend import OWN_CLUSTER

# How often Ray repeats a run whose worker died.
RETRIES = 3
# How long the driver waits for a result before it updates the progress bar [s].
_WAITING_PERIOD = 0.5
_SOURCE_FOLDER = Path(__file__).resolve().parents[2]


def execute_all(
    jobs: Sequence[Job], settings: BackendSettings, on_result: OnResult, on_progress: Callable[[int], object]
) -> None:
    """Executes all jobs; the first failure stops the others and is raised.

    Args:
        jobs: The jobs.
        settings: Address of the cluster and resources of a job.
        on_result: Called with every job and its result when it is finished.
        on_progress: Called with the number of steps taken since its last call.

    Raises:
        ClusterError: If the cluster cannot be reached, is too small, or has other versions.
        RunError: If a job fails, or its workers die more often than Ray retries.
    """
    expected = versions()

    def wait(references: list[Any]) -> list[Any]:
        on_progress(0)
        return _finished(references)

    def collect(job: Job, result: Any) -> None:
        on_result(job, result)
        on_progress(job.steps)

    with _connected(settings.ray_address):
        _require_large_node(settings)
        task = _remote(portable_task(), settings)
        execute_submitted(
            jobs, lambda job: task.remote(expected, pickle.dumps(job.work)), wait, _result, _cancel, collect
        )


@contextmanager
def _connected(address: str) -> Iterator[None]:
    """Joins a cluster, or starts one that ends with this process, and leaves it as it was."""
    options: dict[str, Any] = {"logging_level": logging.ERROR, "log_to_driver": False}
    if address == OWN_CLUSTER:
        options["include_dashboard"] = False
    else:
        require_answer(address)
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    # As many threads of linear algebra as in a local worker: Ray would set their number by the reserved cores.
    options["runtime_env"] = {"env_vars": {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", str(os.cpu_count()))}}
    try:
        # Ray puts the working folder first on the path of its workers: another one may hide our packages.
        with chdir(_SOURCE_FOLDER):
            ray.init(address, **options)
        for number, handler in handlers.items():
            with suppress(ValueError):  # only the main thread has handlers
                signal.signal(number, handler)
        yield
    finally:
        ray.shutdown()


def _remote(function: Callable[..., Any], settings: BackendSettings) -> Any:
    """Returns a function that Ray calls on a node with free resources; again if its worker dies, not if it raises."""
    return ray.remote(function).options(
        num_cpus=settings.cpus_per_run, num_gpus=settings.gpus_per_run, max_retries=RETRIES, retry_exceptions=False
    )


def _require_large_node(settings: BackendSettings) -> None:
    """Returns if a node is large enough for a run, or becomes so while the user lets us wait.

    Raises:
        ClusterError: If none is: Ray would wait for one forever.
    """
    wanted = {"CPU": settings.cpus_per_run, "GPU": settings.gpus_per_run}
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if any(all(node.get(name, 0.0) >= amount for name, amount in wanted.items()) for node in nodes):
        return
    if settings.ray_wait:
        print(f"no node is large enough yet; waiting up to {settings.ray_wait:g} s for one", file=sys.stderr)
        request = _remote(lambda: None, settings).remote()  # a cluster grows by unmet demand
        if ray.wait([request], timeout=settings.ray_wait)[0]:
            return
        _cancel([request])
    cores, gpus = (max((node.get(name, 0.0) for node in nodes), default=0.0) for name in wanted)
    raise ClusterError(
        f"no node of the cluster has the {wanted['CPU']:g} cores and {wanted['GPU']:g} gpus of a run (--cpus-per-run, "
        f"--gpus-per-run): the most that one has is {cores:g} cores, {gpus:g} gpus; --ray-wait SECONDS waits for a "
        "cluster that grows"
    )


def _finished(references: list[Any]) -> list[Any]:
    """Returns all references that are finished; after a while it also returns none."""
    finished, _ = ray.wait(references, timeout=_WAITING_PERIOD, fetch_local=False)
    return ray.wait(references, num_returns=len(references), timeout=0, fetch_local=False)[0] if finished else []


def _result(job: Job, reference: Any) -> Any:
    """Returns the result of a finished job.

    Raises:
        ClusterError: If the node that executed it has other versions, or Ray has ended here.
        RunError: If it failed.
    """
    try:
        return ray.get(reference)
    except RayTaskError as error:
        if isinstance(error.cause, ClusterError):
            raise error.cause from error
        raise RunError.of(job.name, error.cause) from error
    except LocalRayletDiedError as error:
        raise ClusterError("Ray has ended on this machine: the same command goes on from what is stored") from error
    except RayError as error:
        lost = f"its worker died, {RETRIES} retries included ({type(error).__name__})"
        raise RunError(f"run {job.name}: {lost}") from error


def _cancel(references: list[Any]) -> None:
    """Stops jobs at once, also those that are being executed."""
    for reference in references:
        ray.cancel(reference, force=True)
