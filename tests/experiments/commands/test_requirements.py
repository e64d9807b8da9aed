"""`ncs requirements` and `ncs channel` as a user types them."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from ncs_gym import LinearPlant
from shields import Certificate, verify


@pytest.fixture(scope="module")
def plant_file(tmp_path_factory):
    model = ([[0.0, 1.0], [0.0, -20.0]], [[0.0], [40.0]], [[1.0, 0.0]], [[0.0]])
    bounds = {"disturbance_bound": [0.0, 0.4], "sensor_bound": 5e-4, "initial_bound": [1e-3, 0.05]}
    path = tmp_path_factory.mktemp("plant") / "servo.json"
    LinearPlant.from_statespace(model, 0.01, box=[0.2, 4.0], u_max=12.0, **bounds).save(path)
    return path


def ncs(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "experiments", *map(str, arguments)], capture_output=True, text=True, timeout=400
    )


def test_requirements_leave_table_figure_certificates_and_are_resumed(plant_file, tmp_path):
    asked = ("--send-periods", 1, 2, "--losses", 0, 20, "--out", tmp_path / "r")
    arguments = ("requirements", "--plant", plant_file, *asked)
    first = ncs(*arguments)
    assert first.returncode == 0, first.stderr
    assert "no certificate was found" in " ".join(first.stdout.split())
    assert "Cheapest" in first.stdout
    summary = json.loads((tmp_path / "r/summary.json").read_text())
    assert [point["max_age"] for point in summary["points"]] == [0, 20, 1, 41]
    assert [point["possible"] for point in summary["points"]] == [True, False, True, False]
    plant = LinearPlant.load(plant_file)
    for point in summary["points"]:
        if point["possible"]:
            certificate = Certificate.load(tmp_path / "r/certificates" / f"{point['certificate_sha256'][:16]}.json")
            assert verify(certificate, plant).valid
    assert (tmp_path / "r/figures/share.png").read_bytes().startswith(b"\x89PNG")
    again = ncs(*arguments)
    assert "searches were finished before" in again.stderr
    assert again.stdout == first.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--env", "ncs_gym/CartPole-v0", "--plant", "x.json"), "either --env or --plant"),
        (
            (
                "--env",
                "nothing",
            ),
            "unknown environment",
        ),
        (("--losses", -1), "max_consecutive_losses"),
        (("--keep", 0), "--keep"),
        (("--delays", 1, 1), "different values"),
    ],
)
def test_wrong_settings_are_one_sentence(arguments, message, tmp_path):
    found = ncs("requirements", *arguments, "--out", tmp_path / "r")
    assert found.returncode == 2
    assert message in found.stderr
    assert "Traceback" not in found.stderr


def test_channel_prints_the_contract_that_was_kept(tmp_path):
    rng = np.random.default_rng(0)
    lines = [f"{0.02 * i},{'' if rng.random() < 0.2 else 0.02 * i + 0.01}" for i in range(500)]
    (tmp_path / "packets.csv").write_text("sent,received\n" + "\n".join(lines))
    found = ncs("channel", tmp_path / "packets.csv", "--env", "ncs_gym/CartPole-v0", "--out", tmp_path / "numbers.json")
    assert found.returncode == 0, found.stderr
    numbers = json.loads((tmp_path / "numbers.json").read_text())
    assert numbers["lost"] == sum(line.endswith(",") for line in lines)
    assert f"max_age = {numbers['kept']}" in found.stdout
    assert numbers["kept"] <= numbers["promised"]
    assert "The environment's contract, max_age = 4" in found.stdout
