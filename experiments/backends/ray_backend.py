"""Executes runs on a Ray cluster. Scheduling and retries are Ray's; the driver alone writes results."""

from __future__ import annotations

import logging
import os
import pickle
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import chdir, contextmanager, suppress
from pathlib import Path
from queue import Empty, Queue
from typing import Any

import ray  # pyright: ignore[reportMissingImports]
from ray.exceptions import LocalRayletDiedError, RayTaskError  # pyright: ignore[reportMissingImports]

from experiments.backends.ray_cluster import portable_task, require_answer
from experiments.errors import ClusterError, RunError
from experiments.runs.provenance import versions
from experiments.runs.run_store import Run
from experiments.settings import BackendSettings
from experiments.settings.learning import OWN_CLUSTER
from experiments.terminal import say

# How often Ray repeats a run whose worker died.
RETRIES = 3
_SOURCE_FOLDER = Path(__file__).resolve().parents[2]


@contextmanager
def joined_cluster(settings: BackendSettings) -> Iterator[RayCluster]:
    """Yields a cluster, an `execution.Executor`.

    Raises:
        ClusterError: If the cluster cannot be reached, is too small, or has other versions.
    """
    with connected(settings.ray_address):
        _require_large_node(settings)
        cluster = RayCluster(as_remote(portable_task(), settings))
        try:
            yield cluster
        finally:
            cluster.cancel()


class RayCluster:
    """Executes runs as tasks of a cluster.

    Args:
        task: Remote function of the expected versions and a pickled run.
    """

    def __init__(self, task: Any) -> None:
        self._task, self._versions = task, versions()
        self._references: dict[Future[Any], Any] = {}
        self._steps: Queue[int] = Queue()

    def submit(self, run: Run) -> Future[Any]:
        """Returns the future result of a run."""
        reference = self._task.remote(self._versions, pickle.dumps(run))
        future = reference.future()
        self._references[future] = reference

        def finish(future: Future[Any]) -> None:
            self._references.pop(future, None)
            self._steps.put(run.total_steps)

        future.add_done_callback(finish)
        return future

    def reports(self) -> Iterator[int]:
        """Yields the steps of runs that are finished, at least one number, so that the bar shows the time."""
        yield 0
        with suppress(Empty):
            while True:
                yield self._steps.get_nowait()

    def failure(self, run: Run, error: BaseException) -> BaseException:
        """Returns the error of a run: that of the cluster if the node has other versions or Ray has ended here."""
        if isinstance(error, RayTaskError):
            cause: Any = error.cause  # pyright: ignore[reportAttributeAccessIssue]
            return cause if isinstance(cause, ClusterError) else RunError.of(run.name, cause)
        if isinstance(error, LocalRayletDiedError):
            return ClusterError("Ray has ended on this machine: the same command goes on from what is stored")
        lost = f"its worker died, {RETRIES} retries included ({type(error).__name__})"
        return RunError(f"run {run.name}: {lost}")

    def cancel(self) -> None:
        """Stops what is not finished at once, also what is being executed."""
        for reference in list(self._references.values()):
            ray.cancel(reference, force=True)


@contextmanager
def connected(address: str) -> Iterator[None]:
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


def as_remote(function: Callable[..., Any], settings: BackendSettings) -> Any:
    """Returns a function that Ray calls on a node with free resources; again if its worker dies, not if it raises."""
    return ray.remote(function).options(
        num_cpus=settings.cpus_per_run, num_gpus=settings.gpus_per_run, max_retries=RETRIES, retry_exceptions=False
    )


def _require_large_node(settings: BackendSettings) -> None:
    """Raises ClusterError if no node is large enough for a run or becomes so in time: Ray would wait forever."""
    wanted = {"CPU": settings.cpus_per_run, "GPU": settings.gpus_per_run}
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if any(all(node.get(name, 0.0) >= amount for name, amount in wanted.items()) for node in nodes):
        return
    if settings.ray_wait:
        say(f"no node is large enough yet; waiting up to {settings.ray_wait:g} s for one")
        request = as_remote(lambda: None, settings).remote()  # a cluster grows by unmet demand
        if ray.wait([request], timeout=settings.ray_wait)[0]:
            return
        ray.cancel(request, force=True)
    cores, gpus = (max((node.get(name, 0.0) for node in nodes), default=0.0) for name in wanted)
    raise ClusterError(
        f"no node of the cluster has the {wanted['CPU']:g} cores and {wanted['GPU']:g} gpus of a run (--cpus-per-run, "
        f"--gpus-per-run): the most that one has is {cores:g} cores, {gpus:g} gpus; --ray-wait SECONDS waits for a "
        "cluster that grows"
    )
