"""The notebook runs from top to bottom, and is stored without what it printed."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOK = ROOT / "examples" / "tour.ipynb"


@pytest.fixture(scope="module")
def cells():
    content = json.loads(NOTEBOOK.read_text())
    assert (content["nbformat"], content["nbformat_minor"]) == (4, 5)
    return content["cells"]


def program_of(cells):
    """What the cells with code do, one after the other."""
    return "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")


def test_notebook_is_stored_without_outputs(cells):
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert len(code) >= 5
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)
    assert len({cell["id"] for cell in cells}) == len(cells)
    compile(program_of(cells), NOTEBOOK.name, "exec")


@pytest.mark.slow
def test_notebook_runs_from_top_to_bottom(cells):
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    environment = os.environ | {"PYTHONPATH": path, "MPLBACKEND": "Agg"}
    command = [sys.executable, "-c", program_of(cells)]
    run = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=600)
    assert run.returncode == 0, run.stderr
    assert "all of them hold: True" in run.stdout
    assert re.search(r"^bare: violating steps [1-9]", run.stdout, re.MULTILINE)
    assert "shielded: violating steps 0\n" in run.stdout
    assert re.search(r"overridden actions: [1-9]\d*, proved to be safe: True", run.stdout)
    assert re.search(r"^unshielded +[1-9]\d* +[1-9]", run.stdout, re.MULTILINE)
    assert re.search(r"^shielded +0 +0 ", run.stdout, re.MULTILINE)
