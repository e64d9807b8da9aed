"""The figures on the pages are those of the stored benchmark."""

import json

import pytest

from benchmarks.suite import NUMBERS, PAGE, ROOT, all_tables, quotable, quoted


@pytest.fixture(scope="module")
def stored():
    return json.loads((ROOT / NUMBERS).read_text())


def test_quoted_tables_are_those_of_the_stored_benchmark(stored):
    text, tables = (ROOT / PAGE).read_text(), quotable(stored)
    assert quoted(text, tables) == text
    altered = text.replace("-->\n```\n", "-->\n```\nanother figure\n")
    assert altered != text == quoted(altered, tables)


def test_all_tables_and_figures_stand_beside_the_page(stored):
    assert all_tables(stored) == (ROOT / NUMBERS).with_suffix(".txt").read_text()
    for name in ("violations", "return", "training"):
        assert f"images/results-{name}.png" in (ROOT / PAGE).read_text()
        assert (ROOT / "docs" / "images" / f"results-{name}.png").is_file()
