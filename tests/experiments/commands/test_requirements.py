"""`ncs requirements` and `ncs channel` as a user types them."""

from __future__ import annotations

import json

from ncs_gym import ChannelContract, LinearPlant
from shields import Certificate, verify
from tests.command import assert_one_sentence, ncs, succeeded


def test_requirements_leave_a_table_with_certificates_that_verify(plant_file, tmp_path):
    asked = ("--ages", 1, 25, "--resolutions", 0, 0.001, "--out", tmp_path / "r.json")
    said = succeeded("requirements", "--plant", plant_file, *asked).prose
    assert "Not rounded: the newest sample may be 1 step (100 ms) old when an input takes effect; for 25 no" in said
    table, plant = json.loads((tmp_path / "r.json").read_text()), LinearPlant.load(plant_file)
    assert (table["ages"], table["resolutions"]) == ([1, 25], [0.0, 0.001])
    assert [[each is None for each in row] for row in table["certificates"]] == [[False] * 2, [True] * 2]
    for age, row in zip(table["ages"], table["certificates"], strict=True):
        for step, checksum in zip(table["resolutions"], row, strict=True):
            if checksum is not None:
                certificate = Certificate.read(table["documents"][checksum])
                assert certificate.contract.follows_from(ChannelContract(age, step))
                assert verify(certificate, plant).valid


def test_requirements_of_an_environment_say_its_contract_of_today():
    said = succeeded("requirements", "--env", "ncs_gym/Pendulum-v0", "--ages", 0).prose
    assert "no older one was asked" in said
    assert "Today's contract: 2 steps (100 ms), not rounded." in said


def test_channel_refuses_a_file_in_one_sentence(tmp_path):
    asked = ("channel", tmp_path / "packets.csv", "--sampling-period", 0.02)
    for content, words in (
        ("0,1\n1,2\n", "its columns are"),
        ("sent,received\n0,0.001\n0.01,0.011\n", "spans one control step"),
    ):
        (tmp_path / "packets.csv").write_text(content)
        assert_one_sentence(ncs(*asked), words)
    assert_one_sentence(ncs(*asked, "--env", "ncs_gym/CSTR-v0"), "a control step of the plant takes 3 s")
