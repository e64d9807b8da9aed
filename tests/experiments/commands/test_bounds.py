"""`ncs bounds` as a user types it."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from ncs_gym import Bounds, Limits, LinearPlant, Model, Through, bounds_from_recording
from tests.command import assert_one_sentence, ncs, succeeded

MODEL = Model.sampled([[0, 1], [0, -0.5]], [[0], [1]], [[1, 0], [1, 1]], 0.1)
E = [[0.005], [0.1]]
LABELS = {"states": {"position": "m", "speed": "m/s"}, "inputs": {"force": "N"}}


@pytest.fixture
def files(tmp_path):
    """A plant, whose second output is no state, and a record of 40 steps with a column of times."""
    LinearPlant(MODEL, Limits(state=[1, 2], input=2), Bounds(Through(E, 0), 0.001, 0), LABELS).save(tmp_path / "p.json")
    rng, x, rows = np.random.default_rng(0), np.zeros(2), []
    for k in range(41):
        u = rng.uniform(-1, 1, 1)
        y = MODEL.H @ x + rng.uniform(-0.001, 0.001, 2)
        rows.append([0.1 * k, *y, *u])
        x = MODEL.A @ x + MODEL.B @ u + np.array(E) @ rng.uniform(-0.1, 0.1, 1)
    table = pd.DataFrame(rows, columns=["time", "position", "y2", "force"])
    table.loc[40, "force"] = np.nan
    table.to_csv(tmp_path / "record.csv", index=False)
    table.to_parquet(tmp_path / "record.parquet")
    return tmp_path, table


@pytest.mark.parametrize("name", ["record.csv", "record.parquet"])
def test_bounds_of_a_table_are_those_of_its_columns(name, files):
    folder, table = files
    said = succeeded("bounds", folder / name, "--plant", folder / "p.json", "--out", folder / "b.json").prose
    u, y = table[["force"]].to_numpy()[:-1], table[["position", "y2"]].to_numpy()
    expected = bounds_from_recording(MODEL, u, y, E, sensor=0.001, labels=LABELS)
    left = json.loads((folder / "b.json").read_text())
    assert left.pop("plant") == LinearPlant.load(folder / "p.json").fingerprint
    assert left == json.loads(json.dumps(expected.document))
    assert " ".join(str(expected).split()) in said
    assert "if sensor noise was within position 0.001, y2 0.001." in said


def test_sensors_are_given(files):
    folder, _ = files
    known = succeeded("bounds", folder / "record.csv", "--plant", folder / "p.json", "--sensor", 0.002, 0.003).prose
    assert "within position 0.002, y2 0.003." in known


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (
            "time,force\n0,1\n",
            "it has 0 columns named 'position'; a record has the columns force, position, y2 of numbers",
        ),
        ("force,force,position,y2\n0,1,2,3\n", "it has 2 columns named 'force'"),
        ("force,position,y2\n0,1,2\n0,,2\n0,1,1\n", "row 2 has no 'position'; give a part of the record without gaps"),
        ("force,position,y2\n0,1,2\n,1,2\n0,1,1\n", "row 2 has no 'force'"),
        ("force,position,y2\n0,1,one\n", "line 2: 'one' is no number; a record has the columns"),
        ("force,position,y2\n0,1\n", "line 2 has not 3 cells"),
        ("force,position,y2\n", "it has no rows; a record has the columns"),
        ("force,position,y2\n0,1,2\n", "the record is too short: it has 0 steps, 20 are needed"),
        ("\xff", "it is no text in UTF-8"),
    ],
)
def test_wrong_tables_are_refused_in_one_sentence(content, words, files):
    folder, _ = files
    (folder / "record.csv").write_bytes(content.encode("latin-1"))
    assert_one_sentence(ncs("bounds", folder / "record.csv", "--plant", folder / "p.json"), words)
