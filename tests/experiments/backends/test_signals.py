"""Signals to a command with worker processes: a second one ends everything, and nothing is left."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress

import pytest

from tests.command import environment

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals and sessions are POSIX's")

# When the first signal comes after the work began, and how long after it the second [s].
MOMENTS = [(0.0, 0.03), (0.05, 0.3), (0.1, 0.1), (0.2, 0.05), (0.4, 0.2), (0.7, 0.03), (1.0, 0.3), (1.5, 0.1)]
MOMENTS += [(2.0, 0.05), (3.0, 0.15)]
# For one that would hang: much longer than it may take on a busy machine.
PATIENCE = 60.0


# Ctrl-C is ignored where tests run in the background.
TAKEN = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)"


def started(code, *arguments):
    """A program in a session of its own, as a terminal starts it."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": environment()}
    return subprocess.Popen([sys.executable, "-c", code, *arguments], start_new_session=True, **pipes)


def begun(*arguments):
    """The command, once it begins to start its workers."""
    module = "tests.experiments.backends.endless_runs"
    process = started(f"{TAKEN}; import runpy; runpy.run_module('{module}', run_name='__main__')", *arguments)
    assert process.stdout.readline() == "begins\n"
    return process


def ended(process):
    """Exit code and what it wrote, once it has ended and nothing of its group is left."""
    try:
        _, errors = process.communicate(timeout=PATIENCE)
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:  # what is killed takes a moment to go
            try:
                os.killpg(process.pid, 0)
            except ProcessLookupError:
                return process.returncode, errors
            time.sleep(0.01)
        raise AssertionError("processes are left")
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def send(process, number):
    """As a terminal sends Ctrl-C, and `timeout` its signal: to all processes of the group."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, number)


def require_quiet(code, errors):
    assert code in (130, -signal.SIGINT, -signal.SIGTERM), errors  # the latter where Python was about to end anyway
    assert errors.count("ncs: interrupted\n") == 1
    for word in ("Traceback", "refused", "Exception", "Error", "leaked"):
        assert word not in errors, errors


def sent_twice(moment, number, *arguments):
    process = begun(*arguments)
    for wait in moment:
        time.sleep(wait)
        send(process, number)
    return ended(process)


def test_signal_that_another_thread_gets_waits_until_a_process_has_started():
    """Its handler runs in the main thread, which had blocked it."""
    program = """
import signal, threading, time
from experiments.backends.worker import signals_blocked

signal.signal(signal.SIGTERM, lambda number, frame: print("handled", flush=True))
other = threading.Thread(target=threading.Event().wait, daemon=True)
other.start()
with signals_blocked():
    signal.pthread_kill(other.ident, signal.SIGTERM)
    time.sleep(0.5)  # by then the other thread has it
    print("started", flush=True)
print("after", flush=True)
"""
    process = started(program)
    said, errors = process.communicate(timeout=PATIENCE)
    assert (said.split(), errors) == (["started", "handled", "after"], "")


QUICK = [MOMENTS[i] for i in (1, 7)]
SLOW = [pytest.param(each, marks=() if each in QUICK else pytest.mark.slow) for each in MOMENTS]


@pytest.mark.cases(1)
@pytest.mark.parametrize("moment", SLOW)
@pytest.mark.parametrize("deaf", [True, False], ids=["deaf runs", "runs that report"])
def test_second_interrupt_ends_everything_without_a_word(moment, deaf):
    require_quiet(*sent_twice(moment, signal.SIGINT, "--seed", str(int(deaf))))


@pytest.mark.cases(1)
@pytest.mark.parametrize("moment", SLOW)
def test_second_termination_ends_everything_without_a_word(moment):
    require_quiet(*sent_twice(moment, signal.SIGTERM))


@pytest.mark.cases(1)
@pytest.mark.parametrize("moment", SLOW)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_one_signal_ends_runs_that_report(moment, number):
    process = begun()
    time.sleep(sum(moment))
    send(process, number)
    require_quiet(*ended(process))


def test_many_signals_in_a_row_end_everything():
    process = begun("--seed", "1")
    time.sleep(0.5)
    for _ in range(10):
        send(process, signal.SIGINT)
        time.sleep(0.02)
    require_quiet(*ended(process))


def test_workers_end_when_their_parent_is_killed():
    process = begun("--seed", "1")
    time.sleep(1.0)
    process.kill()
    code, errors = ended(process)
    assert code == -signal.SIGKILL
    assert "Traceback" not in errors
