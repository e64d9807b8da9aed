"""What the Ray backend does without Ray: it looks for an answer, and executes a run on a node."""

from __future__ import annotations

import pickle
import platform
import socket
import subprocess
import sys
from collections.abc import Callable
from typing import Any

from experiments.errors import ClusterError
from experiments.runs.provenance import versions

# Time that a machine has to accept a connection, and a cluster to be joined; Ray itself tries for minutes [s].
CONNECT_TIMEOUT, JOIN_TIMEOUT = 10.0, 30.0
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
    """Raises unless a cluster can be joined; tried in a process of its own, because Ray's attempts have no time limit.

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
    """Returns the result of a pickled run, which is unpickled only if this node has the driver's versions."""
    own = versions()
    # Another version of a package says more than another source.
    for name in sorted(expected.keys() | own.keys(), key=lambda name: name == "source"):
        if own.get(name) != expected.get(name):
            has = f"{name} {own[name]}" if name in own else f"no {name}"
            difference = f"{has} where the driver has {expected.get(name, 'none')}"
            if name == "source":
                difference = "another source of ncs-gym than the driver"
            raise ClusterError(f"node {platform.node()} has {difference}: install the same on every node")
    return pickle.loads(content).execute(lambda steps: None)
