"""The tables of `ncs attack` fit into a terminal and say all that was counted."""

from dataclasses import replace

import pytest

from experiments.attack.attack_cases import attack_cases
from experiments.attack.safety_counts import SafetyCounts, counts_table
from tests.experiments.results import LONG_CAMPAIGN


@pytest.mark.parametrize("looks_ahead", [False, True])
def test_steps_of_which_nothing_is_claimed_have_columns_and_a_legend_where_there_are_any(looks_ahead):
    kept = replace(LONG_CAMPAIGN, episodes=200_000, broken_episodes=0, exits=0, violations=0, level=0.9)
    counts = {"CartPole-v0, its channel": kept, "CartPole-v0, late": kept}
    assert "no claim" not in counts_table(counts, looks_ahead=looks_ahead)
    counts["CartPole-v0, its channel"] = replace(kept, lapsed=2_000_000, lapsed_violations=1_234)
    lines = counts_table(counts, looks_ahead=looks_ahead).splitlines()
    rows = [line.split()[-2:] for line in lines if line.startswith((" its channel", " late", "all"))]
    assert rows[-3:] == [["5.0%", "1,234"], ["0.0%", "0"], ["2.5%", "1,234"]]
    assert any(line.startswith("no claim: steps from a broken contract on, ") for line in lines)


def test_the_channels_of_the_rows_are_explained():
    cases = attack_cases(0, 1)
    lines = counts_table(dict.fromkeys(cases, LONG_CAMPAIGN), looks_ahead=False).splitlines()
    for kind in {name.rpartition(", ")[2] for name in cases}:
        assert sum(line.startswith(f"{kind}: ") for line in lines) == 1, kind
    assert not any(line.startswith("rare: ") for line in _table_of("CartPole-v0, late"))


def _table_of(*names):
    return counts_table(dict.fromkeys(names, LONG_CAMPAIGN), looks_ahead=False).splitlines()


def test_margin_of_no_step_is_no_number():
    counts = SafetyCounts(steps=400, episodes=2, lapsed=400)
    assert counts_table({"CartPole-v0, its channel": counts}, looks_ahead=False).splitlines()[6].split()[7] == "-"


def test_cases_of_a_plant_stand_below_its_name_and_the_sum_below_a_rule():
    first, second = SafetyCounts(steps=400, episodes=2, exits=1), SafetyCounts(steps=600, episodes=3, violations=7)
    counts = {"CartPole-v0, late": first, "random plant 0, bursts": first, "CartPole-v0, rare": second}
    head, _, _, _, rule, *rows = counts_table(counts, looks_ahead=False).splitlines()
    assert head == "1,400 steps, 200 in each episode"
    assert [row.split()[0] for row in rows[:5]] == ["CartPole-v0", "late", "rare", "random", "bursts"]
    assert rows[2].split()[1:5] == ["3", "0", "7", "0"]
    assert rows[5] == rule
    assert rows[6].split()[:5] == ["all", "7", "2", "7", "0"]
