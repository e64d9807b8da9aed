"""The figures on the pages are those of the stored study."""

import json

import pytest

from benchmarks.study import NUMBERS, PAGES, ROOT, all_tables, quotable, quoted


@pytest.fixture(scope="module")
def stored():
    return json.loads((ROOT / NUMBERS).read_text())


@pytest.mark.parametrize("page", PAGES)
def test_quoted_tables_are_those_of_the_stored_study(page, stored):
    text = (ROOT / page).read_text()
    assert quoted(text, quotable(stored)) == text
    altered = text.replace("-->\n```\n", "-->\n```\nanother figure\n")
    assert altered != text == quoted(altered, quotable(stored))


def test_all_tables_and_figures_stand_beside_the_page(stored):
    assert all_tables(stored) == (ROOT / NUMBERS).with_suffix(".txt").read_text()
    for name in ("violations", "return", "training"):
        assert f"images/results-{name}.png" in (ROOT / "docs" / "experiments.md").read_text()
        assert (ROOT / "docs" / "images" / f"results-{name}.png").is_file()
