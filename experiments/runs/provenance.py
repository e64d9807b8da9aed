"""What results depend on: settings, versions of packages, the source of this project, and what a summary says of it."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents.loop import LoopConfig
from experiments.settings import LearningSettings, lasting_settings
from ncs_gym.envs.env import ncs_env
from shields import Certificate

if TYPE_CHECKING:
    from experiments.runs.training_run import TrainingRun

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


def experiment_provenance(
    settings: LearningSettings, loop: LoopConfig, certificate: Certificate, runs: Sequence[TrainingRun]
) -> dict[str, Any]:
    """Returns what a reader needs to know where the results of a command come from, JSON values."""
    env = ncs_env(loop.single())
    channel = env.channel.description
    if env.downlink is not None:
        channel += f" Commands: {env.downlink.description}"
    return {
        "runs": {run.name: run.key for run in runs},
        "seeds": {run.index: {"training": run.training_seed, "evaluation": run.evaluation_seed} for run in runs},
        "settings": lasting_settings(settings),
        "plant": {"fingerprint": env.plant.fingerprint, "spectral_radius": env.plant.spectral_radius},
        "described": {"plant": str(env.plant), "channel": channel},
        "certificate": certificate.checksum,
        "certificate_file": certificate.document,
        "versions": versions(),
    }
