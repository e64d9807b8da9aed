"""Worker processes: what becomes of the others when one fails."""

import time
from dataclasses import replace

import pytest

from experiments.backends.execution import execute, local_workers, results_of
from experiments.backends.worker import execute_here
from experiments.errors import RunStopped
from experiments.settings import BackendSettings
from tests.experiments.results import training_run


@pytest.fixture(scope="module")
def endless(certificate):
    """A run that would run for hours."""
    return training_run(certificate, steps=0, episodes=10_000_000)


def test_a_run_told_to_stop_gives_up_at_its_next_report(endless):
    reports = []
    with pytest.raises(RunStopped, match="zero-input-0"):
        execute_here(endless, reports.append, lambda: True, None)
    assert reports == []


def test_a_run_told_to_stop_gives_up_where_it_reports_no_steps():
    class Asking:
        name = "asking"

        def execute(self, on_progress, log_folder=None):
            on_progress(0)

    execute_here(Asking(), print, lambda: False, None)
    with pytest.raises(RunStopped, match="asking"):
        execute_here(Asking(), print, lambda: True, None)


def test_the_first_failure_stops_the_others_and_is_the_one_reported(endless):
    broken = replace(endless, arm="broken", policy_kind="Nowhere")
    begin, kept = time.monotonic(), []
    with pytest.raises(Exception, match="Nowhere") as caught:
        execute([endless, broken], local_workers(2), lambda run, result: kept.append(run))
    assert not isinstance(caught.value, RunStopped)
    assert kept == []
    assert time.monotonic() - begin < 300.0


def test_progress_bar_names_what_its_steps_are(endless, tmp_path, capsys, without_workers):
    results_of([replace(endless, episodes=1)], tmp_path / "fixed", BackendSettings(jobs=1))
    assert "\nevaluation: 100%" in capsys.readouterr().err
    small = dict(n_envs=1, n_steps=8, batch_size=8, n_epochs=1, policy_kwargs=dict(net_arch=[8, 8]))
    run = replace(endless, policy_kind="trained", episodes=1, steps=8, settings=small)
    results_of([run], tmp_path / "trained", BackendSettings(jobs=1))
    shown = capsys.readouterr().err
    assert "\ntraining and evaluation: 100%" in shown
    assert f"/{run.total_steps} [" in shown
