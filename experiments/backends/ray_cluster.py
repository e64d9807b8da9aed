"""What the Ray backend does without Ray: it looks for an answer, orders the work, and executes a job on a node."""

from __future__ import annotations

import pickle
import platform
import socket
import subprocess
import sys
from collections.abc import Callable, Iterable
from itertools import islice
from typing import Any

from experiments.backends.job import Job, OnResult
from experiments.errors import ClusterError, RunError
from experiments.runs import versions

# Time that a machine has to accept a connection, and a cluster to be joined; Ray itself tries for minutes [s].
CONNECT_TIMEOUT, JOIN_TIMEOUT = 10.0, 30.0
# Largest number of jobs that are submitted and not finished: more than a cluster executes at once, so that no core
# waits for the driver and a cluster that grows on demand sees that there is more to do.
MAX_SUBMITTED = 10_000
# Joins a cluster and leaves it again; prints why it cannot.
_JOIN = """
import ray, sys
try:
    ray.init(sys.argv[1], log_to_driver=False, logging_level="ERROR")
except Exception as error:
    print(" ".join(str(error).split()))
    sys.exit(1)
"""


def require_answer(address: str) -> None:
    """Returns if a cluster can be joined; tried in a process of its own, because Ray's attempts have no time limit.

    Raises:
        ClusterError: If it cannot be joined within `CONNECT_TIMEOUT` and `JOIN_TIMEOUT`.
    """
    if address != "auto":
        host, _, port = address.rpartition(":")
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_TIMEOUT).close()
        except (OSError, OverflowError, UnicodeError) as error:
            raise ClusterError(f"nobody answers at --ray-address {address}: {error}") from error
    command = [sys.executable, "-c", _JOIN, address]
    try:
        tried = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=JOIN_TIMEOUT)
    except subprocess.TimeoutExpired as error:
        raise ClusterError(f"no Ray answers at --ray-address {address} within {JOIN_TIMEOUT:g} s") from error
    if tried.returncode:
        reason = tried.stdout.strip() or "Ray gives no reason"
        if "AuthToken" in tried.stderr:
            reason += "; it asks for a token (RAY_AUTH_MODE=token, see docs/scaling.md)"
        raise ClusterError(f"the cluster at --ray-address {address} cannot be joined: {reason}")


def execute_submitted(
    jobs: Iterable[Job],
    submit: Callable[[Job], Any],
    wait: Callable[[list[Any]], Iterable[Any]],
    result_of: Callable[[Job, Any], Any],
    cancel: Callable[[list[Any]], None],
    on_result: OnResult,
) -> None:
    """Executes all jobs; the first failure is raised after what finished beside it, and cancels the others.

    Args:
        jobs: The jobs; at most `MAX_SUBMITTED` are submitted and not finished.
        submit: Starts a job on the cluster and returns a reference to its result.
        wait: Returns the references that are finished; after a while it also returns none.
        result_of: Returns the result of a finished job, or raises its failure.
        cancel: Stops the jobs of references that are not finished.
        on_result: Called with every job and its result when it is finished.

    Raises:
        RunError: If a job failed.
        ClusterError: If a node has other versions.
    """
    rest, submitted = iter(jobs), {}
    try:
        while True:
            for job in islice(rest, MAX_SUBMITTED - len(submitted)):
                submitted[submit(job)] = job
            if not submitted:
                return
            finished = [(submitted.pop(reference), reference) for reference in wait(list(submitted))]
            failure = None
            for job, reference in finished:
                try:
                    result = result_of(job, reference)
                except (RunError, ClusterError) as error:
                    failure = failure or error
                else:
                    on_result(job, result)
            if failure is not None:
                raise failure
    finally:
        cancel(list(submitted))


def portable_task() -> Callable[[dict[str, str], bytes], Any]:
    """Returns `_execute_on_node` in a function that Ray sends as code: it can say that a node lacks this package."""

    def work(expected: dict[str, str], content: bytes) -> Any:
        import platform

        try:
            from experiments.backends import ray_cluster
        except ImportError as error:
            node = f"node {platform.node()} cannot import ncs-gym with the extra [train] ({error})"
            raise ImportError(f"{node}: install the same on every node") from None
        return ray_cluster._execute_on_node(expected, content)

    return work


def _execute_on_node(expected: dict[str, str], content: bytes) -> Any:
    """Returns the result of a pickled job, which is unpickled only if this node has the driver's classes.

    Args:
        expected: The driver's `versions()`; results are stored under its key.
        content: Pickled `Job.work`.

    Raises:
        ClusterError: If this node has other versions.
    """
    own = versions()
    # Another version of a package says more than another source.
    for name in sorted(expected.keys() | own.keys(), key=lambda name: name == "source"):
        if own.get(name) != expected.get(name):
            has = f"{name} {own[name]}" if name in own else f"no {name}"
            difference = f"{has} where the driver has {expected.get(name, 'none')}"
            if name == "source":
                difference = "another source of ncs-gym than the driver"
            raise ClusterError(f"node {platform.node()} has {difference}: install the same on every node")
    return pickle.loads(content)(lambda steps: None)
