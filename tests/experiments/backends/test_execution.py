"""Runs side by side in worker processes: what is kept, and what becomes of the others when one fails or dies."""

import os
import signal
import subprocess
import sys
import time

import pytest

from experiments.backends import execution
from experiments.backends.execution import RunError, results_of
from experiments.settings import BackendSettings
from tests.command import children_of, environment, is_alive
from tests.experiments.backends.small_runs import Small
from tests.experiments.results import training_run

TWO = BackendSettings(jobs=2)
# For what would hang: much longer than it may take on a busy machine [s].
PATIENCE = 120.0


def until(condition):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def stored(folder):
    return sorted(path.stem for path in (folder / "runs").glob("*.json"))


@pytest.mark.slow
def test_finished_runs_are_kept_and_not_executed_again(tmp_path, capsys):
    runs = [Small(name, "work", tmp_path) for name in "abc"]
    with pytest.warns(UserWarning, match=r"[ab] warns"):
        assert [result.arm for result in results_of(runs[:2], tmp_path, TWO)] == ["a said so", "b said so"]
    assert "evaluation: 100%" in capsys.readouterr().err
    (tmp_path / "a began").unlink()
    with pytest.warns(UserWarning, match="c warns"):
        assert [result.arm[0] for result in results_of(runs[::-1], tmp_path, TWO)] == ["c", "b", "a"]
    assert not (tmp_path / "a began").exists()
    assert "2 of 3 runs were finished before" in capsys.readouterr().err


@pytest.mark.slow
def test_first_failure_stops_the_others_is_named_and_keeps_what_is_finished(tmp_path):
    works = Small("a", "work", tmp_path)
    others = [Small("b", "wait", tmp_path), Small("c", "fail", tmp_path, awaits="b began")]
    with (
        pytest.warns(UserWarning, match="a warns"),
        pytest.raises(RunError, match=r"run c: KeyError: 'mine' \(NCS_DEBUG=1") as caught,
    ):
        results_of([works, *others, Small("d", "wait", tmp_path)], tmp_path, TWO)
    assert isinstance(caught.value.__cause__, KeyError)
    assert (tmp_path / "b gave up").exists()
    assert (tmp_path / "d began").exists() == (tmp_path / "d gave up").exists()
    assert stored(tmp_path) == ["a"]


@pytest.mark.slow
def test_dead_worker_costs_its_own_run_only(tmp_path):
    runs = [Small("a", "die", tmp_path), Small("b", "work", tmp_path, awaits="a began"), Small("c", "work", tmp_path)]
    with (
        pytest.warns(UserWarning, match="[bc] warns"),
        pytest.raises(RunError, match=r"worker processes died in a: the same command goes on with what is missing"),
    ):
        results_of(runs, tmp_path, TWO)
    assert stored(tmp_path) == ["b", "c"]


def test_a_run_told_to_stop_gives_up_at_its_next_report(certificate, monkeypatch):
    endless = training_run(certificate, steps=0, episodes=10_000_000)
    monkeypatch.setattr(execution, "_counts", [0, 1])
    with pytest.raises(RunError, match="zero-input-0"):
        execution._work(0, endless, None)


def command(folder):
    """Two runs, the second of which waits, in a session of their own, once that waits."""
    # Ctrl-C is ignored where tests run in the background.
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); import runpy; "
    code += "runpy.run_module('tests.experiments.backends.small_runs', run_name='__main__')"
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True, "env": environment()}
    process = subprocess.Popen([sys.executable, "-c", code, folder], start_new_session=True, **pipes)
    until(lambda: (folder / "b began").exists() or process.poll() is not None)
    assert process.poll() is None
    return process


@pytest.mark.skipif(sys.platform == "win32", reason="sessions are POSIX's")
@pytest.mark.slow
@pytest.mark.parametrize(("send", "number"), [(os.killpg, signal.SIGINT), (os.kill, signal.SIGTERM)])
def test_stop_keeps_what_is_finished_and_is_one_line(send, number, tmp_path):
    process = command(tmp_path)
    send(process.pid, number)  # Ctrl-C reaches the whole group
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert errors.strip().splitlines()[-1] == "ncs: interrupted"
    assert "Traceback" not in errors
    assert (tmp_path / "b gave up").exists()
    assert stored(tmp_path) == ["a"]


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/proc"), reason="processes are looked up in /proc")
def test_workers_end_when_their_parent_is_killed(tmp_path):
    process = command(tmp_path)
    children = children_of(process.pid)
    process.kill()
    process.communicate(timeout=PATIENCE)
    assert len(children) >= 2
    until(lambda: not any(map(is_alive, children)))
    assert stored(tmp_path) == ["a"]
