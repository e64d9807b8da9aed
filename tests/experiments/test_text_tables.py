"""What the tables of results print, and no negative zero."""

import re
from copy import deepcopy
from dataclasses import replace
from functools import cache

import pytest

from experiments.commands.compare import findings_of
from experiments.report import comparison_report, summary_text, sweep_table
from shields import Report
from shields.verification.condition import flag
from tests.experiments.results import run, summary_of

# Returns whose mean lies just below zero, and so do both ends of its interval.
TINY = (-1e-9, -1.2e-9)
NEGATIVE_ZERO = re.compile(r"(?<!\+)[-\N{MINUS SIGN}]0(\.0*)?(?![\d.])")


def results_of(runs=2, names=("unshielded", "trusting", "shielded")):
    results = {}
    for name in names:
        results[name] = [run(name, index, violations=(0, 0), returns=TINY) for index in range(runs)]
        for each in results[name]:
            episodes = [replace(episode, episode_return=-1e-9) for episode in each.episodes]
            each.episodes[:] = episodes
            each.scenarios.update({"worst-case disturbance": episodes, "ideal channel": episodes, "attacked": episodes})
    return results


@cache
def _comparison(runs):
    return summary_of(results_of(runs), seeds=runs)


def comparison(runs=2):
    return deepcopy(_comparison(runs))


def cell(**changes):
    return {"loss": 0.3, "mean_loss": 0.3, "delay": 2, "arms": comparison()["arms"]} | changes


def test_arms_that_nothing_filters_in_training_have_no_share_of_overridden_training_steps():
    summary = summary_of(results_of(1, ("unshielded", "shielded", "shield at test")), seeds=1)
    training = summary_text(summary["arms"], {}).partition("\n\n")[0].splitlines()
    last = {line[:14].strip(): line.split()[-1] for line in training[-3:]}
    assert last["unshielded"] == last["shield at test"] == "-"
    assert float(last["shielded"]) >= 0.0


@pytest.mark.cases(1)
@pytest.mark.parametrize("runs", [1, 2])
def test_no_table_prints_a_negative_zero(runs):
    summary = comparison(runs)
    page = comparison_report(summary, Report((flag("(S)", True),)), {}, [])
    printed = [
        summary_text(summary["arms"], {}),
        *findings_of(summary),
        run("shielded", violations=(0, 0), returns=TINY).outcome,
        sweep_table([cell()]),
        re.sub(r"<style>.*?</style>|<[^>]*>", " ", page, flags=re.DOTALL),
    ]
    assert [text for text in printed if NEGATIVE_ZERO.search(text)] == []


def test_sweep_says_where_the_proof_did_not_hold():
    broken = cell(loss=0.6)
    assert "The proof held in" not in sweep_table([cell(), broken])
    broken["arms"]["shielded"] |= {"guaranteed_episodes": 1, "eval_episodes": 4}
    text = "The proof held in some evaluation episodes only: shielded at loss 0.6, delay 2 (1 of 4)."
    assert " ".join(sweep_table([cell(), broken]).split()).endswith(text)
    many = [cell(loss=0.1 * k) for k in range(1, 10)]
    for each in many:
        each["arms"]["shielded"] |= {"guaranteed_episodes": 0, "eval_episodes": 4}
    assert " ".join(sweep_table(many).split()).endswith("shielded at loss 0.6, delay 2 (0 of 4) and 3 others.")


def test_training_has_a_table_only_where_something_was_trained():
    arms = comparison()["arms"]
    whole = summary_text(arms, {})
    untrained = {name: arm | {"train_steps": 0} for name, arm in arms.items()}
    short = summary_text(untrained, {})
    assert whole.startswith("training ")
    assert summary_text(arms, {"untrained": untrained["shielded"]}).startswith("training ")
    assert short.splitlines()[0].split()[:2] == ["evaluation", "violating:"]
    assert whole.endswith(f"\n\n{short}")
