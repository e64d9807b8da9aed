"""The environments that experiments take place in: registered ids, with the module that registers them."""

from __future__ import annotations

import hashlib
import importlib
import os
import sys
from pathlib import Path

import gymnasium as gym

from ncs_gym import NCSEnv
from ncs_gym.envs.env import ncs_env
from ncs_gym.registration import needing_extras, registered_ids


def registered_env(env_id: str) -> NCSEnv:
    """Returns a registered environment that has a plant of its own.

    Args:
        env_id: Id, or "module:id" as Gymnasium takes it, which imports the module: only for ids that the user gave.

    Raises:
        ValueError: If the id is not registered or has no plant of its own, or there is no such module.
    """
    module, name = module_and_id(env_id)
    if module:
        import_module(module)
        if name not in gym.registry:
            raise ValueError(f"module {module!r} registers no environment {name!r}")
    elif name not in registered_ids() and name not in needing_extras():
        raise ValueError(
            f"unknown environment {env_id!r}; known are {', '.join(registered_ids())}, and --env module:id imports the "
            "module that registers one of your own"
        )
    return ncs_env(gym.make(name))


def module_and_id(env_id: str) -> tuple[str, str]:
    """Returns the module of "module:id", empty for an id alone, and the id by which the environment is registered."""
    module, _, name = env_id.rpartition(":")
    return module, name


def import_module(module: str) -> None:
    """Imports a module of the user's, which registers environments; it may lie in the working directory.

    Raises:
        ValueError: If there is no such module.
    """
    if not all(part.isidentifier() for part in module.split(".")):
        raise ValueError(f"--env module:id needs the name of a module, got {module!r}")
    folder = os.getcwd()
    if folder not in sys.path:
        sys.path.append(folder)  # last, so that no file there stands in for an installed module
    try:
        importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # something that the module itself imports is missing
        raise ValueError(f"there is no module {module!r}, neither installed nor in {folder}") from error


def module_digest(module: str) -> str:
    """Returns the SHA-256 of an imported module's source, empty for no module: what it registers may change."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return hashlib.sha256(Path(file).read_bytes()).hexdigest() if file else ""
