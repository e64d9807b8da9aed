"""Optional dependencies of commands."""

from __future__ import annotations

import importlib.util


def require_extra(extra: str, *packages: str) -> None:
    """Returns if all packages of an extra are installed.

    Raises:
        ModuleNotFoundError: If one is missing; the message says what to install.
    """
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise ModuleNotFoundError(
            f"this command needs {', '.join(missing)}: install the extra, pip install 'ncs-gym[{extra}]'"
        )
