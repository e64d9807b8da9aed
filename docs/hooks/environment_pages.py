"""A page of every registered environment, made when the site is built: a new id gets its page by itself."""

import contextlib
import io
import tempfile
from pathlib import Path
from typing import Any

from environment_page import environment_page

from experiments.commands.render import RenderSettings, render
from ncs_gym.registration import needing_extras, registered_ids

# Steps of the episode whose last picture a page shows.
STEPS = 12
# Comment on the page of all environments that a list of the pages takes the place of.
MARK = "<!-- a page per environment -->"


def add_pages(docs: Path, nav: list[Any]) -> None:
    """Writes the pages and their pictures, and adds them to the navigation below the page of all environments.

    Args:
        docs: Folder of the site's pages.
        nav: The navigation, which is changed.
    """
    names = _ids_by_name()
    (docs / "environments").mkdir()
    for name, env_id in names.items():
        text, picture = _made(name, env_id)
        (docs / "environments" / f"{name}.md").write_text(text)
        (docs / "environments" / f"{name}.png").write_bytes(picture)
    _enter(nav, [{name: f"environments/{name}.md"} for name in names])
    page = docs / "ncs_gym.md"
    page.write_text(page.read_text().replace(MARK, _list_of(names)))


def _enter(nav: list[Any], pages: list[Any]) -> None:
    """Puts the pages below the page of all environments, wherever that is."""
    for index, entry in enumerate(nav):
        ((title, target),) = entry.items() if isinstance(entry, dict) else ((None, entry),)
        if target == "ncs_gym.md":
            nav[index] = {title: [target, *pages]}
        elif isinstance(target, list):
            _enter(target, pages)


def _list_of(names: dict[str, str]) -> str:
    """Returns the sentence with links to the pages."""
    pages = [f"[{name}](environments/{name}.md)" for name in names]
    absent = ", ".join(f"`{env_id}`" for env_id in needing_extras())
    missing = f" (not {absent}: its extra was not installed when this site was built)" if absent else ""
    return f"Each that has a plant of its own has a page: {', '.join(pages)}{missing}."


def _made(name: str, env_id: str) -> tuple[str, bytes]:
    """Returns the page of an environment, and its picture."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "picture.png"
        with contextlib.redirect_stdout(io.StringIO()):
            render(RenderSettings(env=env_id, out=file, steps=STEPS))
        return environment_page(env_id, f"{name}.png"), file.read_bytes()


def _ids_by_name() -> dict[str, str]:
    """Returns the ids by their names; of several versions the one registered last."""
    return {env_id.rpartition("/")[2].rpartition("-v")[0]: env_id for env_id in registered_ids()}
