"""`ncs bounds` as a user types it."""

from __future__ import annotations

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
    said = succeeded("bounds", folder / name, "--plant", folder / "p.json").prose
    u, y = table[["force"]].to_numpy()[:-1], table[["position", "y2"]].to_numpy()
    expected = bounds_from_recording(MODEL, u, y, E, sensor=0.001, labels=LABELS)
    assert " ".join(str(expected).split()) in said
    assert "if sensor noise was within position 0.001, y2 0.001." in said


def test_a_factor_writes_the_plant_with_the_bounds_found(files):
    """As `ncs synthesize --plant` takes it: with all else as it was, also the first error, which no sample tells."""
    folder, table = files
    given = LinearPlant.load(folder / "p.json")
    command = ["bounds", folder / "record.csv", "--plant", folder / "p.json", "--out", folder / "found.json"]
    said = succeeded(*command, "--factor", 1.5, "--sensor", 0.002, 0.003).prose
    u, y = table[["force"]].to_numpy()[:-1], table[["position", "y2"]].to_numpy()
    expected = bounds_from_recording(MODEL, u, y, E, sensor=[0.002, 0.003])
    made = LinearPlant.load(folder / "found.json")
    assert made.bounds.disturbance.parts[0].set.half == pytest.approx(1.5 * expected.upper)
    assert (made.bounds.sensor.parts[0].half == [0.002, 0.003]).all()
    assert made.bounds.first_error.parts[0].half == pytest.approx(expected.first_error)
    assert (made.labels, made.limits.input, made.region) == (given.labels, given.limits.input, given.region)
    assert f"saved to {folder / 'found.json'}" in said


def test_what_one_sample_does_not_tell_stays_the_plants_own(tmp_path):
    model = Model.sampled([[0, 1], [0, -0.5]], [[0], [1]], [[1, 0]], 0.1)
    bounds = Bounds(Through(E, 0), 0.001, [0.01, 0.05])
    LinearPlant(model, Limits(state=[1, 2], input=2), bounds).save(tmp_path / "p.json")
    rng, x, rows = np.random.default_rng(0), np.zeros(2), []
    for _ in range(80):
        u = rng.uniform(-1, 1, 1)
        rows.append([*(model.H @ x), *u])
        x = model.A @ x + model.B @ u + np.array(E) @ rng.uniform(-0.1, 0.1, 1)
    pd.DataFrame(rows, columns=["x1", "u1"]).to_csv(tmp_path / "r.csv", index=False)
    command = ["bounds", tmp_path / "r.csv", "--plant", tmp_path / "p.json", "--out", tmp_path / "o.json"]
    succeeded(*command, "--factor", 2, "--of", "explaining")
    made = LinearPlant.load(tmp_path / "o.json").bounds
    assert made.first_error.parts[0].half.tolist() == [0.01, 0.05]
    found = bounds_from_recording(model, [each[1:] for each in rows], [each[:1] for each in rows], E, sensor=0.001)
    assert made.disturbance.parts[0].set.half == pytest.approx(2 * found.explaining)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("time,force\n0,1\n", "it has 0 columns named 'position'; a record has the columns force, position, y2"),
        ("force,force,position,y2\n0,1,2,3\n", "it has 2 columns named 'force'"),
        ("force,position,y2\n0,1,2\n0,,2\n0,1,1\n", "row 2 has no 'position'; give a part of the record without gaps"),
        ("force,position,y2\n0,1,one\n", "line 2: 'one' is no number; a record has the columns"),
        ("force,position,y2\n0,1\n", "line 2 has not 3 cells"),
        ("force,position,y2\n", "it has no rows; a record has the columns"),
        ("force,position,y2\n0,1,2\n", "the record is too short: it has 0 steps, 20 are needed"),
        ("\xff", "it is no text in UTF-8"),
        (None, "record.csv: No such file or directory"),
    ],
)
def test_wrong_tables_are_refused_in_one_sentence(content, words, files):
    folder, _ = files
    (folder / "record.csv").unlink()
    if content is not None:
        (folder / "record.csv").write_bytes(content.encode("latin-1"))
    assert_one_sentence(ncs("bounds", folder / "record.csv", "--plant", folder / "p.json"), words)
