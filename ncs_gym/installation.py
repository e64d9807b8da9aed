"""How this was installed: what to type for an extra, and whether packages of generic names are this project's.

`shields`, `agents` and `experiments` are names that others give to folders and distributions, too.
"""

from __future__ import annotations

import warnings
from importlib.util import find_spec
from pathlib import Path

# The folder that holds the four packages: a clone, or site-packages.
_FOLDER = Path(__file__).resolve().parent.parent
GENERIC_NAMES = ("shields", "agents", "experiments")
# A line of their `__init__.py`, which other packages of these names do not have.
_MARK = '__distribution__ = "ncs-gym"'
_OWN_ENVIRONMENT = "or install ncs-gym in a virtual environment of its own"


def install_command(extra: str) -> str:
    """Returns what to type in order to install an extra, in a clone or beside an installed wheel."""
    if (_FOLDER / "pyproject.toml").is_file():
        return f"in {_FOLDER}, pip install -e '.[{extra}]'"
    return f"pip install 'ncs-gym[{extra}]'"


def require_own_packages(*names: str) -> None:
    """Raises ImportError unless the packages that Python finds by these of `GENERIC_NAMES` are this project's."""
    for name in names:
        spec = find_spec(name)
        place = "nowhere" if spec is None else spec.origin or ", ".join(spec.submodule_search_locations or ())
        if spec is None or spec.origin is None or Path(spec.origin).resolve() != _init_file(name):
            raise ImportError(
                f"the package {name!r} that Python finds ({place}) is not this project's ({_init_file(name)}): "
                f"if it is yours, rename it or take its folder off the path; otherwise uninstall it {_OWN_ENVIRONMENT}"
            )
        if not _is_own(name):
            raise ImportError(_overwritten(name))


def warn_of_overwritten_packages() -> None:
    """Warns of packages of ours that another distribution, installed later, has overwritten."""
    for name in GENERIC_NAMES:
        if not _is_own(name):
            warnings.warn(_overwritten(name), stacklevel=3)


def _init_file(name: str) -> Path:
    return _FOLDER / name / "__init__.py"


def _is_own(name: str) -> bool:
    try:
        return _MARK in _init_file(name).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return False


def _overwritten(name: str) -> str:
    return (
        f"{_init_file(name)} is not this project's: another distribution was installed over it. "
        f"Uninstall that and repeat the installation of ncs-gym with --force-reinstall --no-deps, {_OWN_ENVIRONMENT}"
    )
