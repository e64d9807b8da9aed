"""The figures on the pages are those of the stored study."""

import json
from pathlib import Path
from unittest import mock

import pytest

from experiments.plots.figure_style import CaptionedFigure
from experiments.study.figures import study_figures
from experiments.study.study import quoted, results_page, results_tables
from experiments.study.tables import tables_by_name

ROOT = Path(__file__).resolve().parents[2]
STORED = ROOT / "docs" / "results.json"


@pytest.fixture(scope="module")
def stored():
    return json.loads(STORED.read_text())


@pytest.mark.parametrize("page", ["README.md", "docs/index.md", "docs/when_not.md"])
def test_quoted_tables_are_those_of_the_stored_study(page, stored):
    text = (ROOT / page).read_text()
    assert quoted(text, tables_by_name(stored)) == text
    altered = text.replace("-->\n```\n", "-->\n```\nanother figure\n")
    assert altered != text == quoted(altered, tables_by_name(stored))


def test_results_are_the_page_of_the_stored_study(stored):
    with mock.patch.object(CaptionedFigure, "png", b""):  # the page has their names and captions
        figures = study_figures(stored)
    assert results_page(stored, figures, "images/results-") == (ROOT / "docs" / "results.md").read_text()
    assert results_tables(stored) == (ROOT / "docs" / "results.txt").read_text()
    assert all((ROOT / "docs" / "images" / f"results-{name}.png").is_file() for name in figures)
