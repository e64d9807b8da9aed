"""`ncs requirements` and `ncs channel` as a user types them."""

from __future__ import annotations

import json
import runpy

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import LinearPlant
from shields import Certificate, certificate_for, verify
from tests.command import ROOT, ncs, succeeded


@pytest.fixture
def plant_file(tmp_path):
    """An unstable plant of one state, of which searches take no time."""
    bounds = {"disturbance_bound": 0.02, "sensor_bound": 0.01, "initial_bound": 0.01}
    LinearPlant(A=[[1.2]], B=[[1.0]], box=[1.0], u_max=1.0, dt=0.1, **bounds).save(tmp_path / "plant.json")
    return tmp_path / "plant.json"


def test_requirements_that_are_refused_leave_nothing(plant_file, tmp_path):
    run = ncs("requirements", "--plant", plant_file, "--losses", -1, "--out", tmp_path / "out")
    assert run.returncode == 2
    assert "max_consecutive_losses must be a whole number" in run.stderr
    assert not (tmp_path / "out").exists()


def test_requirements_leave_table_figure_certificates_and_are_resumed(plant_file, tmp_path, without_workers):
    asked = ("--send-periods", 1, 2, "--losses", 0, 12, "--out", tmp_path / "r")
    arguments = ("requirements", "--plant", plant_file, *asked)
    first = succeeded(*arguments)
    assert "no certificate was found" in " ".join(first.stdout.split())
    assert "Cheapest" in first.stdout
    summary = json.loads((tmp_path / "r/summary.json").read_text())
    assert [point["max_age"] for point in summary["points"]] == [0, 12, 1, 25]
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


def test_requirements_say_how_often_a_record_breaks_what_is_certified(plant_file, tmp_path, without_workers):
    # Samples at every step of .1 s; three silences of 15 steps, and one of 8.
    sent = np.cumsum([0.0] + [0.1] * 99 + [1.5] * 3 + [0.1] * 99 + [0.8] + [0.1] * 99)
    (tmp_path / "packets.csv").write_text("sent,received\n" + "".join(f"{each:.1f},{each:.1f}\n" for each in sent))
    asked = ("--send-periods", 1, "--losses", 2, 14, "--log", tmp_path / "packets.csv", "--out", tmp_path / "r")
    found = succeeded("requirements", "--plant", plant_file, *asked)
    assert "may be 10 steps (1 s) old" in (said := " ".join(found.stdout.split()))
    assert "The widest contract with a certificate, 10 steps of 0.1 s, the record breaks 3 times, " in said
    assert "Read as a table: 'sent' in s, 'received' in s." in said
    assert json.loads((tmp_path / "r/summary.json").read_text())["log"].startswith("Read as a table")
    (tmp_path / "packets.csv").write_text("0,1\n1,2\n")
    refused = ncs("requirements", "--plant", plant_file, *asked, "--force")
    assert refused.returncode != 0
    assert "no names" in refused.stderr


def test_requirements_say_that_a_record_does_not_count_where_no_sample_is_needed(tmp_path, without_workers):
    (tmp_path / "packets.csv").write_text(
        "sent,received\n" + "".join(f"{0.1 * k:.1f},{0.1 * k:.1f}\n" for k in range(99))
    )
    asked = ("--losses", 0, "--log", tmp_path / "packets.csv", "--out", tmp_path / "r")
    found = succeeded("requirements", "--env", "ncs_gym/TruckTrailer-v0", *asked)
    assert "certificate that needs no samples at all keeps whatever the record lost" in " ".join(found.stdout.split())


def test_requirements_say_how_often_the_box_can_be_left_over_a_record_today(tmp_path, without_workers):
    # Samples at every step of .05 s; three silences of 2 steps, which the contract does not allow, and one of 3.
    sent = np.cumsum([0.0] + [0.05] * 50 + [0.2, *[0.05] * 20] * 3 + [0.25] + [0.05] * 50)
    (tmp_path / "packets.csv").write_text("sent,received\n" + "".join(f"{each:.2f},{each:.2f}\n" for each in sent))
    asked = ("--losses", 2, "--log", tmp_path / "packets.csv", "--out", tmp_path / "r")
    found = succeeded("requirements", "--env", "ncs_gym/Pendulum-v0", *asked)
    said = " ".join(found.stdout.split())
    assert "Today's contract, 2 steps of 0.05 s, the record breaks 4 times" in said
    assert "today's contract allows the box is kept until the newest sample is 3 steps old" in said
    assert "that protects; the record exceeds that once" in said


def test_channel_prints_the_contract_that_was_kept(tmp_path):
    rng = np.random.default_rng(0)
    lines = [f"{0.02 * i},{'' if rng.random() < 0.2 else 0.02 * i + 0.01}" for i in range(500)]
    (tmp_path / "packets.csv").write_text("sent,received\n" + "\n".join(lines))
    found = succeeded(
        "channel", tmp_path / "packets.csv", "--env", "ncs_gym/CartPole-v0", "--out", tmp_path / "numbers.json"
    )
    numbers = json.loads((tmp_path / "numbers.json").read_text())
    assert numbers["lost"] == sum(line.endswith(",") for line in lines)
    assert f"max_age = {numbers['kept']}" in found.stdout
    assert numbers["kept"] <= numbers["replay"]
    assert "Read as a table: 'sent' in s, 'received' in s." in found.stdout
    assert "The environment's contract, a newest sample of at most 4 steps, was" in found.stdout


def test_channel_compares_a_record_with_a_certificate_of_one_s_own_as_with_that_of_an_environment(tmp_path):
    rng = np.random.default_rng(1)
    lines = [f"{0.02 * i},{'' if rng.random() < 0.4 else 0.02 * i + 0.01}" for i in range(500)]
    (tmp_path / "packets.csv").write_text("sent,received\n" + "\n".join(lines))
    env = gym.make("ncs_gym/CartPole-v0").unwrapped
    env.plant.save(tmp_path / "plant.json")
    certificate_for(env.plant, env.certificate_contract).save(tmp_path / "certificate.json")
    own = ("--certificate", tmp_path / "certificate.json", "--plant", tmp_path / "plant.json")
    texts = []
    for given in (own, ("--env", "ncs_gym/CartPole-v0")):
        found = succeeded("channel", tmp_path / "packets.csv", *given, "--least-safe-steps", 3)
        texts.append(" ".join(found.stdout.split()))
    assert texts[0].replace("The certificate's contract", "The environment's contract") == texts[1]
    assert "The certificate's contract, a newest sample of at most 4 steps, was broken" in texts[0]


def test_channel_counts_silences_beyond_the_steps_that_a_shield_promises(tmp_path):
    # Samples at every step of .02 s; five silences of 20 steps and one of 60.
    sent = np.cumsum([0.02] * 99 + [0.42] * 5 + [0.02] * 99 + [1.22] + [0.02] * 99)
    (tmp_path / "packets.csv").write_text("sent,received\n" + "".join(f"{each},{each}\n" for each in sent))
    for least, times in ((10, "6 times"), (30, "once"), (49, "once")):
        given = ("--env", "ncs_gym/CartPole-v0", "--least-safe-steps", least)
        found = succeeded("channel", tmp_path / "packets.csv", *given)
        said = " ".join(found.stdout.split())
        assert f"the box is kept at least until the newest sample is {4 + least} steps old" in said
        assert f"In the record it was older {times}" in said
    (tmp_path / "packets.csv").write_text("sent,received\n" + "".join(f"{0.02 * k},{0.02 * k}\n" for k in range(500)))
    kept = ncs("channel", tmp_path / "packets.csv", "--env", "ncs_gym/CartPole-v0")
    assert "is 5 steps old, in every mode that protects; the record exceeds that at no time" in " ".join(
        kept.stdout.split()
    )
    assert "was broken at no time; a record of this length excludes more than" in " ".join(kept.stdout.split())


@pytest.mark.slow
def test_pages_show_what_the_command_prints_of_the_record_of_the_example(tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("sys.argv", ["wifi_record.py", str(tmp_path / "packets.csv")])
    runpy.run_path(str(ROOT / "examples" / "wifi_record.py"), run_name="__main__")
    found = succeeded("channel", tmp_path / "packets.csv", "--env", "ncs_gym/CartPole-v0", "--least-safe-steps", 35)
    promised = "    If a shield" + found.stdout.partition("If a shield")[2].replace("\n", "\n    ")
    for name in ("contracts.md", "requirements.md"):
        page = (ROOT / "docs" / name).read_text()
        block = page.partition("    ncs channel packets.csv")[2].partition("\n\n    ")[2]
        shown = [line.removeprefix("    ") for line in block.splitlines()]
        shown = shown[: next(n for n, line in enumerate(shown) if "in 0.169 % of steps" in line) + 1]
        assert [line for line in shown if line and line != "..." and line not in found.stdout.splitlines()] == []
        kept = "    From any belief" + found.stdout.partition("From any belief")[2].replace("\n", "\n    ")
        assert ([promised.rstrip() in page, kept.partition("If a shield")[0].rstrip() in page]) == (
            [name == "contracts.md"] * 2
        )


def test_channel_does_not_call_a_contract_kept_that_a_pause_broke(tmp_path):
    sent = [0.1 * i for i in range(100)] + [75.0 + 0.1 * i for i in range(1000)]
    lines = "".join(f"{each},{each + 0.25}\n" for each in sent)
    (tmp_path / "packets.csv").write_text("sent,received\n" + lines)
    found = succeeded("channel", tmp_path / "packets.csv", "--env", "ncs_gym/Convoy-v0")
    said = " ".join(found.stdout.split())
    assert "Contract kept by the record: max_age = 653 (65.3 s; first half 653, second half" in said
    assert "Span and number of packets disagree" in said
    assert "was broken once" in said
    assert "at no time" not in said


@pytest.mark.parametrize(
    ("content", "words"),
    [("0,1\n1,2\n", "no names"), ("sent,received\n0,0.001\n0.01,0.011\n", "spans one control step")],
)
def test_channel_refuses_a_file_in_one_sentence(content, words, tmp_path):
    (tmp_path / "packets.csv").write_text(content)
    other = ncs("channel", tmp_path / "packets.csv", "--sampling-period", 0.02, "--env", "ncs_gym/CSTR-v0")
    assert (other.returncode, other.stdout) == (2, "")
    assert "a control step of the environment takes 3 s" in other.stderr
    found = ncs("channel", tmp_path / "packets.csv", "--sampling-period", 0.02)
    assert found.returncode != 0
    assert len(found.stderr.strip().splitlines()) == 1
    assert words in found.stderr
