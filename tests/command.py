"""The `ncs` command: in this process, which has imported everything, or in one of its own as a user starts it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from unittest import mock

from experiments.__main__ import main

ROOT = Path(__file__).resolve().parent.parent
# A command whose files many tests look at (the fixture `smoke`), whose unshielded agents explore enough to violate in
# training.
SMOKE = ("compare", "--seeds", 2, "--steps", 2048, "--episodes", 5)
SMOKE += ("--arms", "unshielded", "shielded", "--baselines", "zero input", "lqr+shielded")
SMOKE += ("--hyperparams", 'policy_kwargs={"log_std_init": 0.0}', "n_epochs=2", "n_steps=16")


class Run(NamedTuple):
    """What a command left."""

    returncode: int
    stdout: str
    stderr: str

    @property
    def prose(self) -> str:
        """What was printed, without its line breaks."""
        return " ".join(self.stdout.split())


def environment(*first: str | os.PathLike[str], **changes: str) -> dict[str, str]:
    """Environment variables of a process that imports from the folders given, then from this tree."""
    path = os.pathsep.join(map(str, filter(None, [*first, ROOT, os.environ.get("PYTHONPATH")])))
    return os.environ | {"PYTHONPATH": path} | changes


def ncs_process(*arguments, cwd=None, **changes: str) -> subprocess.CompletedProcess[str]:
    """Runs `ncs` in a process of its own: for what depends on how it starts or ends."""
    command = [sys.executable, "-m", "experiments", *map(str, arguments)]
    given = environment() | changes
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, env=given, timeout=300)


def ncs(*arguments, cwd=None, **changes: str) -> Run:
    """Runs `ncs` in this process: exit code and everything written, warnings and worker processes included."""
    with (
        tempfile.TemporaryDirectory() as folder,
        _captured("stdout", 1, Path(folder) / "out") as out,
        _captured("stderr", 2, Path(folder) / "err") as err,
        mock.patch.object(sys, "argv", ["ncs", *map(str, arguments)]),
        mock.patch.dict(os.environ, changes),
        contextlib.chdir(cwd or os.curdir),
        _warnings_as_at_the_start(),
        _signals_kept(),
    ):
        code = _exit_code()
        sys.stdout.flush()
        sys.stderr.flush()
        return Run(code, out.read_text("utf-8"), err.read_text("utf-8"))


def succeeded(*arguments, cwd=None, **changes: str) -> Run:
    """Runs `ncs` in this process, and fails if it does not end well."""
    run = ncs(*arguments, cwd=cwd, **changes)
    assert run.returncode == 0, run.stderr
    return run


def assert_one_sentence(run, *words):
    assert run.returncode == 2, run.stderr
    assert "Traceback" not in run.stderr
    lines = run.stderr.strip().splitlines()
    assert len(lines) == 1, run.stderr
    assert lines[0].startswith("ncs: ")
    assert all(word in lines[0] for word in words), lines[0]


def children_of(pid: int) -> list[int]:
    """Process ids of direct children, from /proc."""
    stats = [path.read_text().rsplit(")", 1) for path in Path("/proc").glob("[0-9]*/stat") if path.exists()]
    return [int(head.split()[0]) for head, tail in stats if int(tail.split()[1]) == pid]


def is_alive(pid: int) -> bool:
    """Whether a process runs (a zombie does not)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def _exit_code() -> int:
    try:
        main()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    return 0


@contextlib.contextmanager
def without_pictures() -> Iterator[None]:
    """Commands draw their figures and leave files without a picture, which takes most of the time."""
    with mock.patch("experiments.figures.CaptionedFigure.png", b"\x89PNG"):
        yield


@contextlib.contextmanager
def _captured(name: str, descriptor: int, file: Path) -> Iterator[Path]:
    """Sends a stream to a file, also what native code and worker processes write to its descriptor."""
    getattr(sys, name).flush()
    before = os.dup(descriptor)
    try:
        with file.open("w", buffering=1, encoding="utf-8") as stream, mock.patch.object(sys, name, stream):
            os.dup2(stream.fileno(), descriptor)
            yield file
    finally:
        os.dup2(before, descriptor)
        os.close(before)


@contextlib.contextmanager
def _warnings_as_at_the_start() -> Iterator[None]:
    """Warnings are filtered and shown as in a new process, not as pytest does."""

    def show(message, category, filename, lineno, file=None, line=None) -> None:
        sys.stderr.write(warnings.formatwarning(message, category, filename, lineno, line))

    with warnings.catch_warnings():
        warnings.resetwarnings()
        for ignored in (ResourceWarning, ImportWarning, PendingDeprecationWarning, DeprecationWarning):
            warnings.simplefilter("ignore", ignored)
        warnings.filterwarnings("default", category=DeprecationWarning, module="__main__")
        warnings.showwarning = show
        yield


@contextlib.contextmanager
def _signals_kept() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
