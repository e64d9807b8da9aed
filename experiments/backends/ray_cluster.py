"""What runs on a cluster need: one that answers, large enough nodes, equal versions, a bound on those under way.

Nothing here imports Ray; `ray_engine` does.
"""

from __future__ import annotations

import pickle
import platform
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

from experiments.errors import ClusterError, RunError
from experiments.runs.provenance import versions
from experiments.runs.training_run import Unit, UnitResult, run_unit

# A machine that has not answered by then will not [s], ...
KNOCK = 10.0
# ... and so with its Ray; Ray itself would try for minutes.
PATIENCE = 30.0
# Joins a cluster and leaves it again; prints why not.
JOIN = """
import ray, sys
try:
    ray.init(sys.argv[1], log_to_driver=False, logging_level="ERROR")
except Exception as error:
    print(" ".join(str(error).split()))
    sys.exit(1)
"""
# The finest share of a resource that Ray tells apart.
GRAIN = 0.0001
# Runs handed to the cluster and not yet collected: this many for each that it can work on, so that none of its cores
# waits for the driver, ...
AHEAD = 2
# ... at least so many while the cluster is small or grows, ...
FEWEST = 16
# ... looked up this often [s].
LOOK_UP = 10.0


@dataclass(frozen=True)
class Need:
    """What a run reserves.

    Attributes:
        cpus: Processor cores, > 0.
        gpus: Graphics cards, >= 0.
    """

    cpus: float
    gpus: float

    def places(self, node: Mapping[str, float]) -> int:
        """Returns how many runs a node with these resources (CPU, GPU) works on at once."""
        wanted = {"CPU": self.cpus, "GPU": self.gpus}
        counts = [_grains(node.get(name, 0.0)) // _grains(amount) for name, amount in wanted.items() if amount]
        return min(counts)

    def too_small(self, nodes: Sequence[Mapping[str, float]]) -> ClusterError:
        """Returns the error that no node has room for a run."""
        largest = ", ".join(f"{_most(nodes, name):g} {word}" for name, word in (("CPU", "cores"), ("GPU", "gpus")))
        return ClusterError(
            f"no node of the cluster has the {self.cpus:g} cores and {self.gpus:g} gpus of a run (--cpus-per-run, "
            f"--gpus-per-run): the most that one has is {largest}; --ray-wait SECONDS waits for a cluster that grows"
        )


def require_answer(address: str) -> None:
    """Returns if a cluster can be joined; tried in a process of its own, because Ray's attempts have no time limit.

    Raises:
        ClusterError: If it cannot, within `KNOCK` and `PATIENCE`.
    """
    if address != "auto":
        host, _, port = address.rpartition(":")
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=KNOCK).close()
        except (OSError, OverflowError, UnicodeError) as error:
            raise ClusterError(f"nobody answers at --ray-address {address}: {error}") from error
    command = [sys.executable, "-c", JOIN, address]
    try:
        tried = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=PATIENCE)
    except subprocess.TimeoutExpired as error:
        raise ClusterError(f"no Ray answers at --ray-address {address} within {PATIENCE:g} s") from error
    if tried.returncode:
        reason = tried.stdout.strip() or "Ray gives no reason"
        if "AuthToken" in tried.stderr:
            reason += "; it asks for a token (RAY_AUTH_MODE=token, see docs/scaling.md)"
        raise ClusterError(f"the cluster at --ray-address {address} cannot be joined: {reason}")


class Room:
    """How many runs may be under way; follows a cluster that grows or shrinks.

    Args:
        places: Returns how many runs the cluster works on at once.
        clock: Seconds.
    """

    def __init__(self, places: Callable[[], int], clock: Callable[[], float] = time.monotonic) -> None:
        self._places, self._clock = places, clock
        self._due, self._room = float("-inf"), 0

    def __call__(self) -> int:
        """Returns the number."""
        if self._clock() >= self._due:
            self._room = max(FEWEST, AHEAD * self._places())
            self._due = self._clock() + LOOK_UP
        return self._room


def stream(
    units: Iterable[Unit],
    submit: Callable[[Unit], Any],
    wait: Callable[[list[Any]], Iterable[Any]],
    cancel: Callable[[list[Any]], None],
    room: Callable[[], int],
) -> Generator[list[tuple[Unit, Any]]]:
    """Yields batches of finished units with their references; takes a unit only when there is room for it.

    Args:
        units: What to run; read as far as there is room.
        submit: Hands a unit to the cluster and returns a reference.
        wait: Returns those of the references that are finished, after a while also none.
        cancel: Gets the references that are not finished when the stream is closed early.
        room: Returns how many units may be submitted and not yet yielded.
    """
    rest, pending = iter(units), {}
    try:
        while True:
            for unit in islice(rest, max(0, room() - len(pending))):
                pending[submit(unit)] = unit
            if not pending:
                return
            yield [(pending.pop(reference), reference) for reference in wait(list(pending))]
    finally:
        if pending:
            cancel(list(pending))


def collect(
    batches: Iterable[list[tuple[Unit, Any]]],
    result_of: Callable[[Unit, Any], UnitResult],
    on_result: Callable[[Unit, UnitResult], None],
) -> None:
    """Hands on every result; the first failure is raised after what else was finished has been handed on.

    Raises:
        RunError: If a unit failed.
        ClusterError: If a node has other versions.
    """
    for batch in batches:
        failure = None
        for unit, reference in batch:
            try:
                result = result_of(unit, reference)
            except (RunError, ClusterError) as error:
                failure = failure or error
            else:
                on_result(unit, result)
        if failure is not None:
            raise failure


def carried_work() -> Callable[[dict[str, str], bytes], UnitResult]:
    """Returns `work` in a function that travels as code: it can say that a node lacks this package."""

    def work(expected: dict[str, str], content: bytes) -> UnitResult:
        import platform

        try:
            from experiments.backends import ray_cluster as cluster
        except ImportError as error:
            node = f"node {platform.node()} cannot import ncs-gym with the extra [train] ({error})"
            raise ImportError(f"{node}: install the same on every node") from None
        return cluster.work(expected, content)

    return work


def work(expected: dict[str, str], content: bytes) -> UnitResult:
    """Returns the result of a pickled unit; runs on a worker.

    Nothing of the unit is unpickled before it is sure that both sides have the same classes.

    Args:
        expected: The driver's `versions()`: results count under its key.
        content: The unit.

    Raises:
        ClusterError: If this node has other versions.
    """
    own = versions()
    for name in sorted(expected.keys() | own.keys(), key=lambda name: name == "source"):
        if own.get(name) != expected.get(name):
            raise ClusterError(_other_version(name, own.get(name), expected.get(name)))
    return run_unit(pickle.loads(content), lambda steps: None)


def _other_version(name: str, own: str | None, expected: str | None) -> str:
    node = platform.node()
    if name == "source":
        return f"node {node} has another source of ncs-gym than the driver: install the same on every node"
    has = f"{name} {own}" if own else f"no {name}"
    return f"node {node} has {has} where the driver has {expected or 'none'}: install the same on every node"


def _grains(amount: float) -> int:
    return round(amount / GRAIN)


def _most(nodes: Sequence[Mapping[str, float]], name: str) -> float:
    return max((node.get(name, 0.0) for node in nodes), default=0.0)
