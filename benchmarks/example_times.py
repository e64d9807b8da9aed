"""How long every example takes as it is, beside what it says; each in a process of its own, one after the other.

CPU time and wall-clock time differ where more threads compute than are needed, or where something waits.

python benchmarks/example_times.py [NAME ...]
"""

import ast
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
STATED = re.compile(r"[Tt]akes about (.*?) on one core")
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def main() -> None:
    names = sys.argv[1:] or sorted(path.name for path in (ROOT / "examples").iterdir() if path.is_file())
    environment = {name: value for name, value in os.environ.items() if name not in THREADS}
    environment |= {"PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
    print(f"{'example':<26}{'stated':>16}{'CPU [s]':>10}{'wall [s]':>10}")
    for name in names:
        text, arguments = about(ROOT / "examples" / name)
        with tempfile.TemporaryDirectory() as folder:
            environment["MINARI_DATASETS_PATH"] = folder
            seconds, wall, run = timed([sys.executable, *arguments], folder, environment)
        stated = found[1] if (found := STATED.search(text)) else "-"
        if run.returncode == 0:
            print(f"{name:<26}{stated:>16}{seconds:>10.1f}{wall:>10.1f}", flush=True)
        else:
            print(f"{name:<26}{stated:>16}  {run.stderr.strip().splitlines()[-1]}", flush=True)


def about(path: Path) -> tuple[str, list[str]]:
    """Returns what an example says of itself, and what Python is called with to run it."""
    if path.suffix == ".ipynb":
        cells = json.loads(path.read_text())["cells"]
        said = "".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
        code = [cell for cell in cells if cell["cell_type"] == "code" and "%pip" not in "".join(cell["source"])]
        return said, ["-c", "\n\n".join("".join(cell["source"]) for cell in code)]
    return ast.get_docstring(ast.parse(path.read_text())) or "", [str(path)]


def timed(command: list[str], folder: str, environment: dict[str, str]) -> tuple[float, float, Any]:
    """Returns the CPU time of a process and its children [s], its wall-clock time [s], and how it ended."""
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    run = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - started
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, wall, run


if __name__ == "__main__":
    main()
