"""A page of every registered environment, made when the site is built: a new id gets its page by itself."""

import contextlib
import io
import tempfile
from functools import lru_cache
from pathlib import Path
from typing import Any

from environment_page import environment_page
from mkdocs.structure.files import File

from experiments.commands.render import render
from experiments.settings import RenderSettings
from ncs_gym.registration import needing_extras, registered_ids

# Steps of the episode whose last picture a page shows.
STEPS = 12
# Comment on the page of all environments that a list of the pages takes the place of.
MARK = "<!-- a page per environment -->"


def on_config(config: Any) -> Any:
    """Adds the pages to the navigation, below the page of all environments."""
    for section in config.nav:
        for entries in section.values():
            places = [index for index, entry in enumerate(entries) if entry == {"Environments": "ncs_gym.md"}]
            for index in places:
                pages = [{name: f"environments/{name}.md"} for name in _ids_by_name()]
                entries[index] = {"Environments": ["ncs_gym.md", *pages]}
    return config


def on_files(files: Any, config: Any) -> Any:
    """Adds the pages and their pictures to the files of the site."""
    for name, env_id in _ids_by_name().items():
        text, picture = _made(name, env_id)
        files.append(File.generated(config, f"environments/{name}.md", content=text))
        files.append(File.generated(config, f"environments/{name}.png", content=picture))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Puts a list of the pages on the page of all environments."""
    pages = [f"[{name}](environments/{name}.md)" for name in _ids_by_name()]
    absent = ", ".join(f"`{env_id}`" for env_id in needing_extras())
    missing = f" (not {absent}: its extra was not installed when this site was built)" if absent else ""
    return markdown.replace(MARK, f"Each that has a plant of its own has a page: {', '.join(pages)}{missing}.")


@lru_cache
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
