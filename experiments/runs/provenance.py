"""What results depend on: settings, versions of packages, the source of this project, and what a summary says of it."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from cloudpickle import dumps

from agents.agent import installed_versions
from agents.loop import LoopConfig
from experiments.settings import LearningSettings, id_alone, lasting_settings
from ncs_gym.envs.env import ncs_env
from ncs_gym.reading import read_file
from shields import Certificate

if TYPE_CHECKING:
    from experiments.runs.training_run import TrainingRun

_DEPENDENCIES = ("ncs-gym", "gymnasium", "stable-baselines3", "sb3-contrib", "torch", "cvxpy", "clarabel")
_DEPENDENCIES += ("numpy", "scipy", "filterpy")
_SOURCE_PACKAGES = ("ncs_gym", "shields", "agents", "experiments")


@cache
def versions() -> dict[str, str]:
    """Returns the versions of the installed packages that results depend on, and a digest of this project's source.

    The registered environments are source, too.
    """
    root = Path(__file__).resolve().parents[2]
    files = sorted(path for package in _SOURCE_PACKAGES for path in (root / package).rglob("*.py"))
    digest = hashlib.sha256()
    for path in files:
        digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return installed_versions(_DEPENDENCIES) | {"source": digest.hexdigest()}


def module_digest(module: str) -> str:
    """Returns the SHA-256 of an imported module's source, empty for no module."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return hashlib.sha256(Path(file).read_bytes()).hexdigest() if file else ""


def registration_of(env_id: str) -> str:
    """Returns the SHA-256 of what an id is registered with, empty for none.

    Functions and classes of a module count by their names (`module_digest` knows its source).
    """
    spec = gym.registry.get(id_alone(env_id))
    if spec is None:
        return ""
    kwargs = dict(spec.kwargs)
    if isinstance(plant := kwargs.get("plant"), str):  # a file, which may be another one later
        kwargs["plant"] = read_file(Path(plant))
    return hashlib.sha256(dumps([sorted(kwargs.items()), spec.max_episode_steps])).hexdigest()


def experiment_provenance(
    settings: LearningSettings, loop: LoopConfig, certificate: Certificate, runs: Sequence[TrainingRun]
) -> dict[str, Any]:
    """Returns where the results of a command come from, JSON values."""
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
