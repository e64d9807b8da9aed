from dataclasses import replace
from unittest import mock

import pytest

from experiments.settings import CompareSettings
from experiments.study.channel_sweep import SWEPT_ARMS, SWEPT_CONDITIONS, channel_sweep
from experiments.study.channel_sweep import _changed as changed
from experiments.study.channel_sweep import _points as points_of
from experiments.study.study_figures import sweep_figure
from ncs_gym.envs.env import ncs_env
from tests.workers import no_worker_processes

CRUISE, REACTOR = "ncs_gym/TruckTrailerCruise-v0", "ncs_gym/BatchReactor-v0"


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    settings = CompareSettings(env=CRUISE, episodes=3, jobs=1, out=tmp_path_factory.mktemp("sweep"))
    few = {"_LOSSES": (0.9,), "_DELAYS": (4,), "_QUANTIZATION": (4.0,)}  # where it is hardest
    with no_worker_processes(), mock.patch.multiple("experiments.study.channel_sweep", **few):
        return channel_sweep(settings), channel_sweep(settings)


def test_with_the_error_set_nothing_leaves_and_without_it_the_worst_disturbance_drives_the_state_out(rows):
    for each in rows[0]:
        if each["arm"] == "lqr+shielded":
            assert each["outside_set"] == each["violating"] == 0
        if each["arm"] == "lqr+lookahead":
            assert each["violating"] == 0
    worst = [r for r in rows[0] if r["condition"] == "worst-case disturbance" and r["arm"] == "lqr+trusting"]
    assert all(each["outside_set"] == each["episodes"] == 3 for each in worst)


def test_a_finished_sweep_is_read_again(rows):
    assert rows[0] == rows[1]
    sides = {each["side"] for each in rows[0]}
    assert sides == {"loss", "delay", "quantization_step"}
    assert {(r["arm"], r["condition"]) for r in rows[0]} == {(a, c) for a in SWEPT_ARMS for c in SWEPT_CONDITIONS}


def test_figure_has_a_panel_for_every_side_and_measure(rows):
    figure = sweep_figure("Cruise", rows[0])
    assert len(figure.axes) == 6
    assert "3 episodes" in figure.caption


def test_channels_that_break_the_contract_are_left_out():
    import gymnasium as gym

    env = ncs_env(gym.make(REACTOR))
    kept = points_of(REACTOR)
    assert kept
    assert all(env.contract.is_kept_by(changed(point).applied_to(env.channel) or env.channel) for point in kept)
    too_late = replace(kept[0], side="delay", value=float(env.contract.max_age + 1))
    assert too_late.name not in {point.name for point in kept}
    assert not env.contract.is_kept_by(changed(too_late).applied_to(env.channel))
