"""What results depend on next to their settings: versions of packages and the source of this project."""

from __future__ import annotations

import hashlib
import platform
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_DEPENDENCIES = ("ncs-gym", "gymnasium", "stable-baselines3", "sb3-contrib", "torch", "cvxpy", "clarabel")
_DEPENDENCIES += ("numpy", "scipy", "filterpy")
_SOURCE_PACKAGES = ("ncs_gym", "shields", "agents", "experiments")


def versions() -> dict[str, str]:
    """Returns the versions of the installed packages that results depend on, and a digest of this project's source."""
    return {"python": platform.python_version()} | _installed() | {"source": _source_digest()}


@cache
def _installed() -> dict[str, str]:
    """Returns the versions of packages; looked up once, because the key of every training run needs them."""
    found = {}
    for name in _DEPENDENCIES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


@cache
def _source_digest() -> str:
    """Returns a SHA-256 over the source of the four packages; the registered environments are code, too."""
    root = Path(__file__).resolve().parents[2]
    files = sorted(path for package in _SOURCE_PACKAGES for path in (root / package).rglob("*.py"))
    digest = hashlib.sha256()
    for path in files:
        digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()
