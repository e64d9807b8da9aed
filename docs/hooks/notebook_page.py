"""The notebook as a page of the site, with what it printed and drew when it was run."""

import base64
import json
from pathlib import Path
from typing import Any

NOTEBOOK = Path(__file__).resolve().parent.parent.parent / "examples" / "tour.ipynb"


def add_page(docs: Path, nav: list[Any]) -> None:
    """Writes the page and its pictures, and adds it to the navigation after the first page.

    Args:
        docs: Folder of the site's pages.
        nav: The navigation, which is changed.
    """
    parts = []
    for cell in json.loads(NOTEBOOK.read_text())["cells"]:
        source = "".join(cell["source"])
        parts.append(
            source.replace("](../docs/", "](") if cell["cell_type"] == "markdown" else _fenced(source, "python")
        )
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if "image/png" in data:
                name = f"tour-{len(parts)}.png"
                (docs / name).write_bytes(base64.b64decode("".join(data["image/png"])))
                parts.append(f"![What the program above draws]({name})")
            elif text := "".join(output.get("text", data.get("text/plain", ()))):
                parts.append(_fenced(text, ""))
    (docs / "tour.md").write_text("\n\n".join(parts) + "\n")
    _enter(nav)


def _fenced(text: str, language: str) -> str:
    return f"```{language}\n{text.rstrip()}\n```"


def _enter(nav: list[Any]) -> bool:
    for index, entry in enumerate(nav):
        target = next(iter(entry.values())) if isinstance(entry, dict) else entry
        if target == "index.md":
            nav.insert(index + 1, {"Notebook": "tour.md"})
            return True
        if isinstance(target, list) and _enter(target):
            return True
    return False
