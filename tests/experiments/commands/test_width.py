"""Whatever a command shows fits into a terminal of 80 columns."""

from __future__ import annotations

import io
from collections import Counter

import numpy as np
import pytest

from experiments import settings
from experiments.__main__ import COMMANDS
from experiments.commands import reproduce
from experiments.commands.attack import table_of
from experiments.report.text_tables import sweep_table
from experiments.terminal import progress_bar, say, text_table, warnings_as_sentences
from ncs_gym.registration import registered_ids
from tests.command import ROOT, ncs, succeeded
from tests.experiments.results import run, summary_of

WIDTH = 80
CRUISE = "ncs_gym/TruckTrailerCruise-v0"
IDS = registered_ids()


def printed(*arguments):
    """What a command prints, without the lines that name its files."""
    done = succeeded(*arguments, COLUMNS=str(WIDTH))
    return "\n".join(
        line for line in done.stdout.splitlines() if not line.startswith(("files: ", "agent: ", "saved to "))
    )


class Shown:
    """What each command shows, by its name: of short runs, or of the largest numbers and the longest names."""

    def __init__(self, folder, request):
        self.folder, self.request = folder, request

    @property
    def plant(self):
        return self.request.getfixturevalue("plant_file")

    def compare(self):
        return self.request.getfixturevalue("smoke")[1].stdout.partition("files: ")[0]

    def train(self):
        small = ("n_envs=2", "n_steps=64", "batch_size=64", 'policy_kwargs={"net_arch": [8, 8]}')
        return printed("train", "--steps", 128, "--episodes", 1, "--hyperparams", *small, "--out", self.folder / "r")

    def evaluate(self):
        return printed("evaluate", "pretrained", "--env", CRUISE, "--shield", "lookahead", "--episodes", 1)

    def sweep(self):
        arms = summary_of({"shielded:project+penalty": [run("shielded:project+penalty")]})["arms"]
        for arm in arms.values():
            arm |= {"train_steps": 9_000_000, "train_violation_steps": 8_000_000, "eval_episodes": 5_000}
        sides = {
            "mean_loss": 0.04,
            "loss": 0.05,
            "downlink_loss": 0.05,
            "delay": 12,
            "quantization_step": 0.05,
            "burst_length": 25.0,
        }
        here, there = sides | {"mass_factor": 1.05, "arms": arms}, dict.fromkeys(sides, 0) | {"mass_factor": 1.0}
        return sweep_table([here, there | {"arms": arms}])

    def render(self):
        return printed("render", "--smoke", "--side-by-side", "--out", self.folder / "a.png")

    def synthesize(self):
        return printed("synthesize", "--plant", self.plant, "--max-age", 2, "--out", self.folder / "c.json")

    def verify(self):
        folder = ROOT / "shields" / "packaged_certificates"
        shown = [printed("verify", folder / f"{name}-v0.json") for name in ("CSTR", "CartPoleTwoWay")]
        return "\n".join(line for text in shown for line in text.splitlines() if " verifies" not in line)

    def channel(self):
        record = self.request.getfixturevalue("record")
        return printed("channel", record(0.02 * np.arange(500), delay=0.01, loss=0.2), "--env", "ncs_gym/CartPole-v0")

    def bounds(self):
        rows = ["u1,x1", *(f"0,{0.01 * (-1) ** k}" for k in range(40))]
        (self.folder / "record.csv").write_text("\n".join(rows))
        return printed("bounds", self.folder / "record.csv", "--plant", self.plant)

    def requirements(self):
        columns = (1e-4 * k for k in range(12))
        return printed("requirements", "--plant", self.plant, "--ages", 0, "--resolutions", *columns)

    def attack(self):
        names = ("steps", "episodes", "outside S", "outside box", "no claim", "overridden")
        rows = {f"{each.partition('/')[2]}, blackout": Counter(dict.fromkeys(names, 9_999_999)) for each in IDS}
        return table_of(rows)

    def audit(self):
        """`tests/experiments/commands/test_audit.py` has every claim, which takes longer."""
        from experiments.commands.audit import text_of
        from experiments.paper.audit import audited_claims
        from experiments.paper.paper_example import PaperExample

        claims = audited_claims(PaperExample())
        return text_of([next(claims) for _ in range(3)], WIDTH)

    def reproduce(self):
        names = ("outside_set", "outside_box", "input_asked_beyond", "steps", "largest_level", "largest_input")
        names += ("largest_error", "epsilon", "largest_estimation_error")
        return reproduce.table_of(
            dict.fromkeys(("printed", "charitable", "certified"), dict.fromkeys(names, 9_999_999))
        )


@pytest.fixture
def shown(tmp_path, request, without_workers):
    return Shown(tmp_path, request)


@pytest.mark.parametrize("command", COMMANDS)
def test_everything_that_a_command_prints_fits_into_80_columns(command, shown):
    lines = getattr(shown, command)().splitlines()
    assert len(lines) > 1
    assert [line for line in lines if len(line) > WIDTH] == []


@pytest.mark.parametrize("command", COMMANDS)
def test_help_fits_into_80_columns_and_every_command_has_a_seed_and_a_place_for_its_files(command):
    usage, *lines = printed(command, "--help").splitlines()
    assert usage.startswith("usage: ")  # tyro's own, which may be longer
    assert [line for line in lines if len(line) > WIDTH] == []
    assert any("--out" in line for line in lines)
    assert any("--seed" in line for line in lines) or command == "channel"


@pytest.mark.parametrize(("arguments", "code"), [(["--help"], 0), ([], 2)])
def test_overview_has_a_sentence_for_every_command_in_80_columns(arguments, code):
    run = ncs(*arguments, COLUMNS=str(WIDTH))
    assert run.returncode == code
    lines = run.stdout.splitlines()
    assert [line for line in lines if len(line) > WIDTH] == []
    assert len(lines) < 40
    text = " ".join(run.stdout.split())
    for command, (kind, *_) in COMMANDS.items():
        first = " ".join(getattr(settings, kind).__doc__.partition("\n\n")[0].split())
        assert f" {command} {first}" in text


def test_columns_that_find_no_room_stand_below_behind_their_keys():
    rows = [["name", *(f"column {i}" for i in range(12))], ["title"], ["a", *map(str, range(12))]]
    first, second = text_table(rows).split("\n\n")
    assert max(map(len, first.splitlines())) <= WIDTH
    assert first.splitlines()[0].split() + second.splitlines()[0].split()[1:] == " ".join(rows[0]).split()
    assert [part.splitlines()[2:][0] for part in (first, second)] == ["title"] * 2
    cells = [part.splitlines()[-1].split() for part in (first, second)]
    assert cells[0] + cells[1][1:] == rows[2]
    assert cells[1][0] == "a"


def test_only_a_key_and_a_cell_that_are_wider_together_make_a_row_longer():
    assert max(map(len, text_table([["k" * 70, "v" * 20, "w"], ["", "", ""]]).splitlines())) == 91


class Terminal(io.StringIO):
    """A terminal that takes what is written to it."""

    def isatty(self):
        return True


@pytest.mark.parametrize("stream", [Terminal, io.StringIO])
def test_messages_share_no_line_with_a_progress_bar(stream, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    monkeypatch.setattr("sys.stderr", errors := stream())
    with warnings_as_sentences(), progress_bar(1000, "training and evaluation", "step") as bar:
        bar.update(500)
        say(f"shielded-0: {'many words of an outcome ' * 8}")
        bar.update(500)
    seen = [line.rpartition("\r")[2].rstrip() for line in errors.getvalue().splitlines()]
    message = [line for line in seen if "words" in line]
    assert not any("%" in line for line in message)
    assert message[0].startswith("shielded-0: many")
    assert len(message) == (3 if stream is Terminal else 1)  # in a file a message is a line
    assert "100%" in seen[-1]
    assert "\r" not in errors.getvalue() or stream is Terminal


def test_a_bar_without_a_unit_shows_the_share_alone(monkeypatch):
    monkeypatch.setattr("sys.stderr", errors := Terminal())
    with progress_bar(2000, "search", "") as bar:
        bar.update(2000)
    assert "search: 100%" in errors.getvalue()
    assert "2.00k" not in errors.getvalue()
