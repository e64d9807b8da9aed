"""The benchmark: rows, blocks, intervals for another block, tables of exact numbers, impairments on and off."""

import json
import re

import gymnasium as gym
import numpy as np
import pytest

from benchmarks import suite
from benchmarks.suite import (
    ATTACKED,
    ENTRIES,
    IDEAL,
    PRIMARY,
    SWITCHES,
    TASKS,
    all_tables,
    rows_of,
    switched,
    task_table,
)
from experiments.analysis.statistics import clopper_pearson
from experiments.runs.loops import AS_TRAINED, changed_channel
from ncs_gym.envs.env import ncs_env
from tests.workers import no_worker_processes

RUNS = 3


def row(mean=150.0, own=0.0, attacked=0.0, trains=True):
    """The numbers of a row in a block, of runs that differ by 1 in return."""
    shares = {AS_TRAINED: own, ATTACKED: attacked, IDEAL: 0.0}
    scenarios = {
        name: {
            "violating": [share] * RUNS,
            "return": [mean - 1.0, mean, mean + 1.0],
            "overridden": [0.1] * RUNS,
            "proved": [0.0 if attacked else 1.0] * RUNS,
            "episodes": 50 * RUNS,
        }
        for name, share in shares.items()
    }
    curve = {"steps": [[1e4, 2e4]], "return": [[1.0, 2.0]] * RUNS, "violating_steps": [[3.0, 4.0]] * RUNS}
    return {"scenarios": scenarios, "training": [7] * RUNS if trains else [], "curve": curve if trains else {}}


@pytest.fixture
def found():
    """Numbers of two tasks with every row, of which the second block is better by 2 in return."""
    tasks = {}
    for task in ("Convoy-v0", "BatchReactor-v0"):
        tasks[task] = {
            str(block): {
                name: row(150.0 + 2.0 * block, 0.0, 0.5 * (name == "unshielded"), name not in suite.REGULATED)
                for name in rows_of(task)
                if name in PRIMARY or not block
            }
            for block in (0, 1)
        }
    switches = {"lqr": dict(zip(("none", *SWITCHES, "all"), np.linspace(0.0, 1.0, 6).tolist(), strict=True))}
    return {"budget": [[0, 1], RUNS, 1000, 50], "tasks": tasks, "impairments": {"Convoy-v0": switches}}


def cells(table, name):
    line = next(line for line in table.splitlines() if line.startswith(f"{name} "))
    return re.split(r"\s{2,}", line)


def test_row_shows_both_blocks_and_where_another_one_would_lie(found):
    shown = cells(task_table(found["tasks"]["Convoy-v0"]), "unshielded")
    assert shown[1] == "150.0 152.0 2.6"
    runs = [149.0, 150.0, 151.0, 151.0, 152.0, 153.0]
    half = 2.5706 * np.std(runs, ddof=1) * np.sqrt(1.0 / 6.0 + 1.0 / 3.0)  # 2.5706: Student, five degrees of freedom
    blocks = [each["unshielded"] for each in found["tasks"]["Convoy-v0"].values()]
    low, high = suite._interval(blocks, "return", AS_TRAINED)
    assert (low, high) == pytest.approx((151.0 - half, 151.0 + half), abs=1e-3)
    shielded = [each["shielded"] for each in found["tasks"]["Convoy-v0"].values()]
    assert suite._interval(shielded, "violating", ATTACKED) == tuple(clopper_pearson(0, 100 * RUNS))


def test_tables_have_every_row_and_no_negative_zero(found):
    found["tasks"]["Convoy-v0"]["0"]["shielded"] = row(-1e-9)
    text = all_tables(found)
    assert all(f"\n{name} " in text for name in ENTRIES)
    assert not re.search(r"(?<![\d.])-0(\.0+)?(?![\d.])", text)
    assert max(map(len, text.splitlines())) <= 95
    assert all_tables(json.loads(json.dumps(found))) == text


@pytest.mark.parametrize("task", TASKS)
def test_every_impairment_keeps_the_contract_and_has_what_is_on(task):
    env = ncs_env(gym.make(f"ncs_gym/{task}"))
    for on in ((), *((each,) for each in SWITCHES), SWITCHES):
        channel = changed_channel(env.channel, switched(env.channel, env.contract, on)) or env.channel
        assert env.contract is None or env.contract.is_kept_by(channel)
        assert (
            channel.loss > 0.0,
            channel.delay > 0,
            channel.send_period > 1,
            channel.quantization_step > 0.0,
        ) == tuple(name in on for name in SWITCHES)


@pytest.mark.slow
def test_a_small_suite_keeps_its_runs_trains_once_and_nothing_breaks_the_shield(tmp_path):
    def made(*names, **changed):
        settings = {"tasks": TASKS[:1], "arms": names, "seeds": 2, "steps": 1500, "episodes": 40}
        suite.measure(**settings | changed, jobs=1, out=tmp_path / "out", numbers=tmp_path / "numbers.json")
        return json.loads((tmp_path / "numbers.json").read_text())

    with no_worker_processes():
        found = made("unshielded", "shielded", "shield at test", "unshielded, attacked", "lqr:observer+shielded")
        assert made("unshielded", "shield at test") == found  # finished runs are kept, and other rows stay
        with pytest.raises(ValueError, match="has other blocks, runs, steps or episodes"):
            made("unshielded", steps=1600)
    first, second = found["tasks"]["CSTR-v0"].values()
    assert set(second) == {"unshielded", "shielded", "shield at test", "lqr:observer+shielded"}
    assert first["unshielded"]["curve"] == first["shield at test"]["curve"]  # the same agents
    assert first["unshielded"]["training"] != first["unshielded, attacked"]["training"]
    for block in (first, second):
        for name in set(block) & {"shielded", "shield at test", "lqr:observer+shielded"}:
            assert not any(any(each["violating"]) for each in block[name]["scenarios"].values())
    shares = found["impairments"]["CSTR-v0"]
    assert list(shares["unshielded"]) == ["none", *SWITCHES, "all"]
    assert set(shares["shielded"].values()) == {0.0}
    assert all(len(each) == 2 for each in (first["unshielded"]["training"], second["unshielded"]["training"]))


def test_pages_show_what_was_measured_in_the_order_of_the_tasks(found, tmp_path):
    (tmp_path / "docs" / "images").mkdir(parents=True)
    page, numbers = tmp_path / suite.PAGE, tmp_path / "numbers.json"
    page.write_text("<!-- suite: budget -->\n<!-- end -->\n")
    numbers.write_text(json.dumps(found | {"tasks": dict(reversed(found["tasks"].items()))}))
    suite.pages(numbers, tmp_path)
    assert "2 blocks of 3 runs per primary arm, 1,000 training steps each" in page.read_text()
    assert list(json.loads((tmp_path / suite.NUMBERS).read_text())["tasks"]) == ["Convoy-v0", "BatchReactor-v0"]
    assert (tmp_path / suite.NUMBERS).with_suffix(".txt").read_text() == all_tables(found)
    for name in ("violations", "return", "training"):
        assert (tmp_path / "docs" / "images" / f"results-{name}.png").read_bytes().startswith(b"\x89PNG")


def test_policy_of_ones_own_has_a_row_on_the_same_episodes(monkeypatch):
    for name, value in {"SCENARIOS": (ATTACKED,), "SEEDS": 2, "EPISODES": 3}.items():
        monkeypatch.setattr(suite, name, value)
    own = suite.row_of(
        "CSTR-v0", lambda loop, seed: lambda observations, infos: np.zeros((len(observations), 1)), "shielded"
    )
    assert len(own["scenarios"][AS_TRAINED]["return"]) == 2
    assert not any(own["scenarios"][ATTACKED]["violating"])
    assert own["training"] == []
