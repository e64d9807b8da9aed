"""A real Ray on this machine: what it does when processes die, and what a user sees."""

import signal
import subprocess
import sys
import time
import zipfile

import pytest

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install -e '.[ray]'")

from experiments.backends.execution import RunError, results_of  # noqa: E402
from experiments.backends.ray_tasks import RETRIES, _on_node  # noqa: E402
from experiments.runs.provenance import versions  # noqa: E402
from experiments.settings import BackendSettings  # noqa: E402
from tests.command import environment, ncs_process  # noqa: E402
from tests.experiments.backends.small_runs import Small  # noqa: E402

pytestmark = pytest.mark.slow

GRID = ["--losses", "0.4", "0.5", "--delays", "1", "--seeds", "2", "--episodes", "3"]
GRID += ["--steps", "2048", "--hyperparams", "n_envs=4"]
RUNS = 8
TIMEOUT = 300.0


def ncs(*arguments):
    run = ncs_process(*arguments)
    assert "Traceback" not in run.stderr
    return run


def _take_interrupts():
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def started(*arguments):
    """A process in a group of its own, as a terminal starts it; SIGINT may be ignored where tests run."""
    return subprocess.Popen(
        [sys.executable, "-m", "experiments", *map(str, arguments)],
        env=environment(),
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=_take_interrupts,
    )


def until_one_is_stored(out, run):
    deadline = time.monotonic() + TIMEOUT
    while not list((out / "runs").glob("*.json")):
        assert run.poll() is None, "it ended too early"
        assert time.monotonic() < deadline, "nothing was stored"
        time.sleep(0.05)


def lines_of_runs(text):
    """Names of the runs whose lines are in what was written to stderr."""
    return [line.partition(": ")[0] for line in text.replace("\r", "\n").splitlines() if " episodes violating," in line]


def assert_same(out, other):
    """Rows, summary and the trained networks are the same, bit for bit."""
    for name in ("summary.json", "episodes.parquet"):
        assert (out / name).read_bytes() == (other / name).read_bytes()
    models = sorted(path.relative_to(out) for path in out.glob("models/*/model.zip"))
    assert len(models) == RUNS
    for model in models:
        mine, others = zipfile.ZipFile(out / model), zipfile.ZipFile(other / model)
        assert mine.read("policy.pth") == others.read("policy.pth")


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    out = tmp_path_factory.mktemp("local") / "out"
    run = ncs("sweep", *GRID, "--jobs", "2", "--out", out)
    assert run.returncode == 0, run.stderr
    return out


def test_rows_are_those_of_the_local_engine_bit_for_bit(local, tmp_path):
    out, folder = tmp_path / "out", tmp_path / "here"
    (folder / "agents").mkdir(parents=True)  # must not hide the package of that name from the workers
    (folder / "agents" / "__init__.py").write_text("raise RuntimeError('hidden')")
    entry = "import sys; sys.path.pop(0); from experiments.__main__ import main; main()"
    arguments = [sys.executable, "-c", entry, "sweep", *GRID, "--engine", "ray", "--out", "../out"]
    run = subprocess.run(arguments, cwd=folder, env=environment(), capture_output=True, text=True, timeout=TIMEOUT)
    assert run.returncode == 0, run.stderr
    assert_same(out, local)
    assert len(lines_of_runs(run.stderr)) == len(set(lines_of_runs(run.stderr))) == RUNS
    noise = [line for line in run.stderr.replace("\r", "\n").splitlines() if line.strip() and "step/s]" not in line]
    assert len(noise) == RUNS, run.stderr


def test_worker_that_always_dies_is_given_up_and_named(tmp_path):
    run = Small("its-name", "die", tmp_path)
    with pytest.raises(RunError, match="worker processes died in its-name"):
        results_of([run], tmp_path, BackendSettings(engine="ray"))
    assert (tmp_path / "its-name began").read_text() == "began\n" * (1 + RETRIES)


def test_node_with_another_source_is_refused_in_one_sentence():
    with pytest.raises(RunError, match=r"node .* has another source than the driver: install the same on every"):
        _on_node(versions() | {"source": "other"}, None)


def test_interrupted_sweep_goes_on_to_the_same_rows(local, tmp_path):
    given = ("sweep", *GRID, "--engine", "ray", "--out", tmp_path / "out")
    run = started(*given)
    until_one_is_stored(tmp_path / "out", run)
    run.send_signal(signal.SIGINT)
    _, errors = run.communicate(timeout=60)
    assert (run.returncode, errors.strip().splitlines()[-1]) == (130, "ncs: interrupted")
    again = ncs(*given)
    assert again.returncode == 0, again.stderr
    assert_same(tmp_path / "out", local)
