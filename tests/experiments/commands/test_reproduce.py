import json

import numpy as np
import pytest

from experiments.commands.reproduce import StateFeedback, outcome
from experiments.paper.paper_example import PaperExample
from ncs_gym.registration import CASE_STUDY_BOX
from tests.command import succeeded


def test_outcome_counts_what_left_the_set_the_box_and_the_limit():
    case = PaperExample()
    design = StateFeedback("printed", case.plant, CASE_STUDY_BOX, 4.0 * np.eye(2), case.K, 0.01)
    states = np.array([[[0.0, 0.0]], [[1.9, 1.9]], [[2.1, 0.0]]])
    errors = np.array([[[0.1, 0.0]], [[0.0, 0.0]]])
    found = outcome(design, states, np.array([[[4.5]], [[-1.0]]]), errors)
    counts = [found[name] for name in ("steps", "outside_set", "outside_box", "input_asked_beyond")]
    assert counts == [2, 2, 1, 1]
    assert found["largest_level"] == pytest.approx(2 * 1.9**2 / 4)
    expected = np.square(case.plant.B @ case.K @ [0.1, 0.0]).sum()
    assert found["largest_error"] == pytest.approx(expected)
    assert found["largest_estimation_error"] == pytest.approx(0.01)


@pytest.mark.slow
def test_command_leaves_a_figure_and_summary(tmp_path):
    run = succeeded("reproduce", "--starts", 4, "--steps", 50, "--out", tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert len(summary) == 3
    assert all(outcome["steps"] == 200 for outcome in summary.values())
    assert summary["certified"]["outside_set"] == 0
    assert summary["certified"]["input_asked_beyond"] == 0
    assert (tmp_path / "out" / "figures" / "states.png").stat().st_size > 10_000
    assert "claimed epsilon" in run.stdout
