"""The commands of `ncs`, one module each: a function of its settings that runs an experiment and writes its files."""

from __future__ import annotations

import importlib.util


def require_extra(extra: str, *packages: str) -> None:
    """Returns if all packages of an optional dependency are installed.

    Raises:
        ModuleNotFoundError: If one is missing; the message says what to install.
    """
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise ModuleNotFoundError(
            f"this command needs {', '.join(missing)}: in a clone of ncs-gym, pip install -e '.[{extra}]'"
        )
