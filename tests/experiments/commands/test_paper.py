"""The audit's figures, against those of a second, independent computation and of the page; and the simulation."""

import itertools
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from experiments.commands.paper import StateFeedback, outcome
from experiments.paper.audit import Claim, Verdict, audited_claims, defects
from experiments.paper.paper_example import PaperExample
from ncs_gym.registration import CASE_STUDY_BOX
from tests.command import ROOT, succeeded

HOLDS, ROUNDED, FAILS, UNDECIDED = Verdict.HOLDS, Verdict.ROUNDED, Verdict.FAILS, Verdict.UNDECIDED


@pytest.fixture(scope="module")
def claims(made_once):
    """What `ncs paper --out` writes."""
    folder = made_once("audit", lambda folder: succeeded("paper", "--out", folder / "out"))
    return [Claim(**claim) for claim in json.loads((folder / "out" / "claims.json").read_text())]


EXPECTED = [
    ("A and B", HOLDS, ["4.0e-05"]),
    ("(C1)", ROUNDED, ["0.90298"]),
    ("(C2)", FAILS, ["5.743", "3.984", "5.9e-06", "3.83", "row 12"]),
    ("(C3)", ROUNDED, ["1.000016"]),
    ("(C5)", FAILS, ["17.99", "row 12"]),
    ("the input", FAILS, ["4.24", "row 12"]),
    ("the set is", FAILS, ["1.0197", "0.924 with e = 0", "d = [0.02, -0.01]", "confirmed in exact arithmetic"]),
    ("the same", HOLDS, ["0.932", "proved in exact arithmetic"]),
    ("epsilon", FAILS, ["0.149", "0.371", "0.0056 for g_bar^2 = kappa cond(L)"]),
    ("the largest simulated", UNDECIDED, ["0.0124", "0.0024", "0.068", "row 9", "norm"]),
    ("OP is feasible", FAILS, ["infeasible under the theorem as printed", "0.034", "chi2 = 0.103", "1.27",
                               "and OP is feasible, though"]),
    ("K and M", FAILS, ["1.4038, 0.2183", "u_max = 6", "5.998", "K = [2.0927, 0.3514]", "9.84e-04", "17.99"]),
    ("Definition 4", FAILS, ["alpha = 5.7e+06", "0.2904 K", "1.0219", "confirmed in exact arithmetic"]),
    ("Theorem 5", FAILS, ["diag(1, 100)", "diag(0.9, 0)", "radius 0.04", "0.978", "0.81", "1.69"]),
    ("Delta(gamma)", FAILS, ["gamma = 0.0005", "51 %"]),
    ("the error stays", UNDECIDED, ["0.029 to 0.035", "0.00068", "does not say"]),
    ("the sensor", Verdict.NOT_PRINTED, ["H = I", "R = 0.0001 I"]),
    ("the simulation", Verdict.VACUOUS, ["u = 0", "1.823", "1.575", "shown in exact arithmetic"]),
]  # fmt: skip


@pytest.mark.slow
def test_every_claim_has_its_verdict_and_figures(claims):
    for claim, (start, verdict, figures) in zip(claims, EXPECTED, strict=True):
        assert claim.claim.startswith(start)
        assert claim.verdict == verdict, start
        assert bool(claim.defect) is (verdict == FAILS), start
        for figure in figures:
            assert figure in claim.computed + claim.charitable, start


@pytest.mark.slow
def test_verdicts_follow_the_numbers():
    # With a smaller printed epsilon and gain other claims would hold: nothing is a constant. The row about OP would
    # take seconds.
    other = replace(PaperExample(), K=0.5 * PaperExample().K, epsilon=0.2)
    quick = itertools.islice(audited_claims(other), 10)
    found = {claim.claim.split(" ")[0]: claim for claim in quick}
    assert found["(C1)"].verdict == FAILS
    assert found["(C5)"].verdict == HOLDS
    assert found["(C5)"].charitable == found["(C5)"].defect == ""
    assert found["epsilon"].verdict == HOLDS


@pytest.mark.slow
def test_defects_are_counted_once(claims):
    found = defects(claims)
    assert list(found.values()) == [[3, 7, 11], [5, 6, 12], [9], [13], [14], [15]]
    assert defects([claim for claim in claims if claim.verdict != FAILS]) == {}


@pytest.mark.slow
def test_page_says_what_the_audit_prints_and_nothing_else(claims):
    """Row by row: the verdict, and every number."""
    page = (ROOT / "docs" / "paper.md").read_text()
    rows = re.findall(r"^\| (\d+) \| (.*) \| (.*) \| (.*) \|$", page, re.MULTILINE)
    assert [int(number) for number, *_ in rows] == list(range(1, len(claims) + 1))
    for claim, (number, said, verdict, computed) in zip(claims, rows, strict=True):
        assert verdict == claim.verdict, number
        printed = set(_numbers(f"{claim.claim} {claim.printed} {claim.computed} {claim.charitable}"))
        assert set(_numbers(f"{said} {computed}")) <= printed, number
        assert _numbers(computed), number
    text = " ".join(page.split())
    counts = re.search(r"of (\d+) rows (\d+) hold, (\d+) do not \((\d+) distinct defects\), (\d+) are undecided", text)
    held = sum(claim.verdict in (HOLDS, ROUNDED) for claim in claims)
    failed, undecided = (sum(claim.verdict == verdict for claim in claims) for verdict in (FAILS, UNDECIDED))
    assert [int(count) for count in counts.groups()] == [len(claims), held, failed, len(defects(claims)), undecided]


def _numbers(text):
    """The numbers in a text, as printed; those that are part of a name, as in Section 5 or x1, are among them."""
    return re.findall(r"\d+(?:\.\d+)?(?:e[+-]\d+)?", text)


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
def test_simulation_leaves_a_figure_and_summary(tmp_path):
    run = succeeded("paper", "--simulate", "--starts", 4, "--steps", 50, "--out", tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert len(summary) == 3
    assert all(outcome["steps"] == 200 for outcome in summary.values())
    assert summary["certified"]["outside_set"] == 0
    assert summary["certified"]["input_asked_beyond"] == 0
    assert (tmp_path / "out" / "figures" / "states.png").stat().st_size > 10_000
    assert "claimed epsilon" in run.stdout
