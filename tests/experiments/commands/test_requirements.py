"""`ncs requirements` and `ncs channel` as a user types them."""

from __future__ import annotations

import json
import runpy

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import ChannelContract, LinearPlant
from shields import Certificate, certificate_for, verify
from shields.json_documents import document_of
from tests.command import ROOT, ncs, succeeded


def test_requirements_that_are_refused_leave_nothing(plant_file, tmp_path):
    run = ncs("requirements", "--plant", plant_file, "--losses", -1, "--out", tmp_path / "out")
    assert run.returncode == 2
    assert "max_consecutive_losses must be a whole number" in run.stderr
    assert not (tmp_path / "out").exists()


def test_requirements_leave_table_figure_certificates_and_are_resumed(plant_file, tmp_path, without_workers):
    asked = ("--send-periods", 1, 2, "--losses", 0, 12, "--out", tmp_path / "r")
    arguments = ("requirements", "--plant", plant_file, *asked)
    first = succeeded(*arguments)
    assert "no certificate was found" in first.prose
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
    assert "runs were finished before" in again.stderr
    assert again.stdout == first.stdout


@pytest.mark.parametrize("forged", ["age", "plant", "altered", "missing"])
def test_certificates_of_stored_searches_are_verified_again(forged, plant_file, tmp_path, without_workers):
    arguments = ("requirements", "--plant", plant_file, "--send-periods", 1, "--losses", 3, "--out", tmp_path / "r")
    assert ncs(*arguments).returncode == 0
    (file,) = (tmp_path / "r/runs").glob("*-ages-3-to-3.json")
    document = json.loads(file.read_text())["run"]
    (answer,) = document["result"]["found"]
    if forged == "age":
        answer["certificate"] = certificate_for(LinearPlant.load(plant_file), ChannelContract(2)).document
    elif forged == "missing":
        document["result"]["found"] = []
    elif forged == "plant":
        answer["certificate"] = certificate_for(
            gym.make("ncs_gym/CSTR-v0").unwrapped.plant, ChannelContract(3)
        ).document
    else:
        answer["certificate"]["certificate"]["K"][0][0] += 1e-3
    file.write_text(json.dumps(document_of("run", "ncs-gym run 3", document)))
    again = ncs(*arguments)
    assert again.returncode == 2
    assert "is no result of its run" in again.stderr
    words = {"altered": "checksum does not match", "missing": "no answer for age 3"}
    assert words.get(forged, "no certificate of this plant for age 3") in again.stderr


def test_requirements_say_how_often_a_record_breaks_what_is_certified(plant_file, record, tmp_path, without_workers):
    # Samples at every step of .1 s; three silences of 15 steps, and one of 8.
    sent = np.cumsum([0.0] + [0.1] * 99 + [1.5] * 3 + [0.1] * 99 + [0.8] + [0.1] * 99)
    asked = ("--send-periods", 1, "--losses", 2, 14, "--log", record(sent), "--out", tmp_path / "r")
    said = succeeded("requirements", "--plant", plant_file, *asked).prose
    assert "may be 10 steps (1 s) old" in said
    assert "The widest contract with a certificate, 10 steps of 0.1 s, the record breaks 3 times, " in said
    assert "Read as a table: 'sent' in s, 'received' in s." in said
    assert json.loads((tmp_path / "r/summary.json").read_text())["log"].startswith("Read as a table")
    (tmp_path / "packets.csv").write_text("0,1\n1,2\n")
    refused = ncs("requirements", "--plant", plant_file, *asked, "--force")
    assert refused.returncode != 0
    assert "no names" in refused.stderr


def test_requirements_say_that_a_record_does_not_count_where_no_sample_is_needed(record, tmp_path, without_workers):
    asked = ("--losses", 0, "--log", record(0.1 * np.arange(99)), "--out", tmp_path / "r")
    said = succeeded("requirements", "--env", "ncs_gym/TruckTrailer-v0", *asked).prose
    assert "certificate that needs no samples at all keeps whatever the record lost" in said


def test_requirements_say_how_often_the_box_can_be_left_over_a_record_today(record, tmp_path, without_workers):
    # Samples at every step of .05 s; three silences of 2 steps, which the contract does not allow, and one of 3.
    sent = np.cumsum([0.0] + [0.05] * 50 + [0.2, *[0.05] * 20] * 3 + [0.25] + [0.05] * 50)
    asked = ("--losses", 2, "--log", record(sent), "--out", tmp_path / "r")
    said = succeeded("requirements", "--env", "ncs_gym/Pendulum-v0", *asked).prose
    assert "Today's contract, 2 steps of 0.05 s, the record breaks 4 times" in said
    assert "today's contract allows the box is kept until the newest sample is 3 steps old" in said
    assert "that protects; the record exceeds that once" in said


def test_channel_prints_the_contract_that_was_kept(record, tmp_path):
    file, out = record(0.02 * np.arange(500), delay=0.01, loss=0.2), tmp_path / "numbers.json"
    found = succeeded("channel", file, "--env", "ncs_gym/CartPole-v0", "--out", out)
    numbers = json.loads(out.read_text())
    assert numbers["lost"] == sum(line.endswith(",") for line in file.read_text().splitlines()) > 0
    assert f"max_age = {numbers['kept']}" in found.stdout
    assert numbers["kept"] <= numbers["replay"]
    assert "Read as a table: 'sent' in s, 'received' in s." in found.stdout
    assert "The environment's contract, a newest sample of at most 4 steps, was" in found.stdout


def test_channel_compares_a_record_with_a_certificate_of_one_s_own_as_with_that_of_an_environment(record, tmp_path):
    file = record(0.02 * np.arange(500), delay=0.01, loss=0.4, seed=1)
    env = gym.make("ncs_gym/CartPole-v0").unwrapped
    env.plant.save(tmp_path / "plant.json")
    certificate_for(env.plant, env.certificate_contract).save(tmp_path / "certificate.json")
    own = ("--certificate", tmp_path / "certificate.json", "--plant", tmp_path / "plant.json")
    both = own, ("--env", "ncs_gym/CartPole-v0")
    texts = [succeeded("channel", file, *given).prose for given in both]
    behind = " Behind a downlink the certificate's own also counts the steps by which inputs are committed ahead, which"
    behind += " --committed-ahead takes off."
    assert behind in texts[0]
    assert texts[0].replace("The certificate's contract", "The environment's contract").replace(behind, "") == texts[1]
    assert "The certificate's contract, a newest sample of at most 4 steps, was broken" in texts[0]


def test_samples_have_what_inputs_committed_ahead_leave_of_a_certificate_s_contract(record, tmp_path):
    file = record(0.02 * np.arange(500), delay=0.01, loss=0.4, seed=1)
    env = gym.make("ncs_gym/CartPoleTwoWay-v0").unwrapped
    ahead = env.certificate_contract.max_age - env.contract.max_age
    assert ahead > 0
    env.plant.save(tmp_path / "plant.json")
    certificate_for(env.plant, env.certificate_contract).save(tmp_path / "certificate.json")
    own = (
        "--certificate",
        tmp_path / "certificate.json",
        "--plant",
        tmp_path / "plant.json",
        "--committed-ahead",
        ahead,
    )
    ours, theirs = (succeeded("channel", file, *each).prose for each in (own, ("--env", "ncs_gym/CartPoleTwoWay-v0")))
    assert theirs.partition("The environment's")[2] in ours.partition("The certificate's")[2].replace(
        " Behind a downlink the certificate's own also counts the steps by which inputs are committed ahead, which "
        "--committed-ahead takes off.",
        "",
    )
    cruise = gym.make("ncs_gym/TruckTrailerCruise-v0").unwrapped.plant
    cruise.save(tmp_path / "cruise.json")
    certificate_for(cruise).save(tmp_path / "cruise-certificate.json")
    without = "--certificate", tmp_path / "cruise-certificate.json", "--plant", tmp_path / "cruise.json", *own[-2:]
    for given, words in (
        ((*own[:-1], 9), "--committed-ahead 9: the certificate's contract is of 8 steps in all"),
        (("--committed-ahead", 1), "--committed-ahead is of --certificate"),
        (without, "--committed-ahead is counted by contracts, and this certificate needs none"),
    ):
        refused = ncs("channel", file, *given)
        assert refused.returncode == 2
        assert words in refused.stderr


def test_channel_counts_silences_after_which_the_box_may_be_left(record):
    # Samples at every step of .02 s; five silences of 20 steps and one of 60.
    sent = np.cumsum([0.02] * 99 + [0.42] * 5 + [0.02] * 99 + [1.22] + [0.02] * 99)
    said = succeeded("channel", record(sent), "--env", "ncs_gym/CartPole-v0").prose
    assert "is 5 steps old, in every mode that protects; the record exceeds that 6 times" in said
    kept = succeeded("channel", record(0.02 * np.arange(500)), "--env", "ncs_gym/CartPole-v0").prose
    assert "is 5 steps old, in every mode that protects; the record exceeds that at no time" in kept
    assert "was broken at no time; a record of this length excludes more than" in kept


@pytest.mark.slow
def test_pages_show_what_the_command_prints_of_the_record_of_the_example(tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("sys.argv", ["wifi_record.py", str(tmp_path / "packets.csv")])
    runpy.run_path(str(ROOT / "examples" / "wifi_record.py"), run_name="__main__")
    found = succeeded("channel", tmp_path / "packets.csv", "--env", "ncs_gym/CartPole-v0")
    for name in ("contracts.md", "requirements.md"):
        page = (ROOT / "docs" / name).read_text()
        block = page.partition("    ncs channel packets.csv")[2].partition("\n\n    ")[2]
        shown = [line.removeprefix("    ") for line in block.splitlines()]
        shown = shown[: next(n for n, line in enumerate(shown) if "in 0.169 % of steps" in line) + 1]
        assert [line for line in shown if line and line != "..." and line not in found.stdout.splitlines()] == []
        kept = "    From any belief" + found.stdout.partition("From any belief")[2].replace("\n", "\n    ")
        assert (kept.rstrip() in page) == (name == "contracts.md")


def test_channel_does_not_call_a_contract_kept_that_a_pause_broke(record):
    sent = [0.1 * i for i in range(100)] + [75.0 + 0.1 * i for i in range(1000)]
    said = succeeded("channel", record(sent, delay=0.25), "--env", "ncs_gym/Convoy-v0").prose
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


def test_age_of_the_newest_sample_is_said_without_the_steps_by_which_inputs_are_late(
    plant_file, tmp_path, without_workers
):
    given = ("requirements", "--plant", plant_file, "--send-periods", 1, "--losses", 0)
    for late in ((0,), (2,), (0, 2)):
        out = tmp_path / "-".join(map(str, late))
        said = succeeded(*given, "--input-delays", *late, "--out", out).prose
        (largest,) = json.loads((out / "summary.json").read_text())["largest_ages"]
        if late == (2,):
            assert f"inputs 2 steps late: the newest sample may be {largest['certified'] - 2} steps (" in said
            assert f"for {largest['none_found'] - 2} no certificate was found" in said
        elif late == (0,):
            assert f": the newest sample may be {largest['certified']} steps (" in said
        else:
            together = "the age of the newest sample and the steps that inputs are late may be"
            assert f": {together} {largest['certified']} steps (" in said
            assert " together; for " in said
