"""The site is not built with a link, an anchor, a picture or a formula that is broken."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.site.hooks import HOOKS

ROOT = Path(__file__).resolve().parents[2]


def built(folder, text):
    """The run of a build of two pages with the project's own settings."""
    pytest.importorskip("zensical", reason="the extra [docs] is not installed")
    config = yaml.safe_load((ROOT / "mkdocs.yml").read_text())
    config |= {"nav": [{"Start": "index.md"}, {"Other": "other.md"}], "plugins": ["search"]}
    (folder / "docs").mkdir()
    (folder / "mkdocs.yml").write_text(yaml.safe_dump(config))
    shutil.copy(ROOT / "docs" / "style.css", folder / "docs")
    (folder / "docs" / "index.md").write_text(f"# Start\n\n{text}\n")
    (folder / "docs" / "other.md").write_text("# Other\n\n## There\n\nHere.\n")
    command = [sys.executable, "-m", "zensical", "build", "--strict"]
    environment = os.environ | {"PYTHONPATH": str(HOOKS)}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)


def test_page_has_formulas_notes_and_names_on_one_line(tmp_path):
    text = '!!! note "Trap"\n    $x^2$ and [there](other.md#there).\n\n```math\n\\frac{1}{2}\n```\n\n`ncs --seed 1`'
    run = built(tmp_path, text)
    assert run.returncode == 0, run.stdout + run.stderr
    page = (tmp_path / "site" / "index.html").read_text()
    assert page.count("<math") == 2
    assert '<div class="admonition note">' in page
    assert '<span class="unbroken">--seed</span>' in page
    assert "cdn" not in page


@pytest.mark.parametrize("text", ["[no page](none.md)", "[no anchor](other.md#none)", "[not here](#none)", r"$\frak{$"])
def test_broken_page_ends_the_build(tmp_path, text):
    assert built(tmp_path, text).returncode != 0


def test_notebook_becomes_a_page_with_its_pictures(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(HOOKS)
    import notebook_page

    nav = [{"Start": ["index.md", {"Other": "other.md"}]}]
    notebook_page.add_page(tmp_path, nav)
    assert nav == [{"Start": ["index.md", {"Notebook": "tour.md"}, {"Other": "other.md"}]}]
    page = (tmp_path / "tour.md").read_text()
    assert page.count("](tour-") == len(list(tmp_path.glob("tour-*.png"))) == 3
    cells = json.loads(notebook_page.NOTEBOOK.read_text())["cells"]
    assert page.count("```python\n") == sum(cell["cell_type"] == "code" for cell in cells)
    assert "shielded: violating steps 0" in page
    assert "](../" not in page
