"""The notebook runs from top to bottom, and is stored with what it printed and drew."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.command import environment

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOK = ROOT / "examples" / "tour.ipynb"


@pytest.fixture(scope="module")
def cells():
    content = json.loads(NOTEBOOK.read_text())
    assert (content["nbformat"], content["nbformat_minor"]) == (4, 5)
    return content["cells"]


def program_of(cells):
    """What the cells with code do, one after the other, without the one that installs."""
    code = ("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    return "\n\n".join(source for source in code if "%pip" not in source)


def assert_shows_what_it_is_about(printed):
    assert "all of them hold: True" in printed
    assert re.search(r"^bare: violating steps [1-9]", printed, re.MULTILINE)
    assert "shielded: violating steps 0\n" in printed
    assert re.search(r"overridden actions: [1-9]\d*, proved to be safe: True", printed)
    assert re.search(r"^unshielded +[1-9]\d* +[1-9]", printed, re.MULTILINE)
    assert re.search(r"^shielded +0 +0 ", printed, re.MULTILINE)


def test_notebook_is_stored_as_it_was_run_from_top_to_bottom(cells):
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell["outputs"]]
    assert {output["output_type"] for output in outputs} == {"stream", "display_data"}
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 3
    assert_shows_what_it_is_about("".join("".join(output.get("text", ())) for output in outputs))


@pytest.mark.slow
def test_notebook_runs_from_top_to_bottom(cells):
    command, given = [sys.executable, "-c", program_of(cells)], environment(MPLBACKEND="Agg")
    run = subprocess.run(command, capture_output=True, text=True, env=given, timeout=600)
    assert run.returncode == 0, run.stderr
    assert_shows_what_it_is_about(run.stdout)
