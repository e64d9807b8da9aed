"""The commands of `ncs`, one module each: a function of its settings that runs an experiment and writes its files.

What they raise is a sentence for the user: ValueError for settings that cannot be, the errors of `experiments.errors`,
`shields.Infeasible` and `CertificateError`, `agents.AgentError`, and OSError.
"""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from typing import Any

from ncs_gym.installation import install_command


def require_extra(extra: str, *packages: str) -> None:
    """Raises unless all packages of an optional dependency are installed.

    Raises:
        ModuleNotFoundError: If one is missing; the message says what to install.
    """
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise ModuleNotFoundError(f"this command needs {', '.join(missing)}: {install_command(extra)}")


def short_version(settings: Any, **budget: Any) -> Any:
    """Returns the settings of a command's short version if `--smoke` is given, otherwise the same settings."""
    if not settings.smoke:
        return settings
    default = type(settings).out
    if settings.out is not None and settings.out == default:  # what the whole version leaves there stays
        budget["out"] = default.with_stem(f"{default.stem}-smoke")
    return replace(settings, **budget)
