"""How this was installed: what to type for an extra, and whether packages of generic names are this project's."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

# The folder that holds the four packages: a clone, or site-packages.
_FOLDER = Path(__file__).resolve().parent.parent
# Names that others give to folders and distributions, too.
GENERIC_NAMES = ("shields", "agents", "experiments")
# A line of their `__init__.py`, which other packages of these names do not have.
_MARK = '__distribution__ = "ncs-gym"'


def install_command(extra: str) -> str:
    """Returns what to type in order to install an extra, in a clone or beside an installed wheel."""
    if (_FOLDER / "pyproject.toml").is_file():
        return f"in {_FOLDER}, pip install -e '.[{extra}]'"
    return f"pip install 'ncs-gym[{extra}]'"


def require_own_packages(*names: str) -> None:
    """Raises ImportError unless the packages that Python finds by these of `GENERIC_NAMES` are this project's."""
    for name in names:
        spec, own = find_spec(name), _FOLDER / name / "__init__.py"
        place = "nowhere" if spec is None else spec.origin or ", ".join(spec.submodule_search_locations or ())
        if Path(place).resolve() != own or _MARK not in own.read_text(encoding="utf-8", errors="replace"):
            raise ImportError(
                f"the package {name!r} that Python finds ({place}) is not this project's ({own}): if it is yours, "
                "rename it or take its folder off the path; otherwise uninstall it, or install ncs-gym in a virtual "
                "environment of its own"
            )
