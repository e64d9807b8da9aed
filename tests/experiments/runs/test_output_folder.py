"""Finished results are not replaced by those of other settings, unless it is asked for; one command has a folder."""

import errno
import json
import multiprocessing
import os
import signal
import sys
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from experiments.errors import FolderInUseError, OtherResultsError
from experiments.runs.output_folder import claim_folder as folder_of
from experiments.settings import (
    CompareSettings,
    ReproduceSettings,
    SweepSettings,
    TrainSettings,
)
from experiments.settings.arguments import registration_of
from ncs_gym import Channel, Regulation, register_plant, truck_trailer
from tests.command import assert_one_sentence, ncs


def claim_folder(command, settings):
    """Claims a folder and gives it back."""
    with folder_of(command, settings):
        pass


def finished(command, settings, file="summary.json"):
    """Leaves what a finished command leaves."""
    claim_folder(command, settings)
    (settings.out / file).parent.mkdir(exist_ok=True)
    (settings.out / file).write_text("{}")
    return settings


@pytest.mark.parametrize("error", [ValueError("no"), FileNotFoundError("no"), RuntimeError("no"), KeyboardInterrupt()])
@pytest.mark.parametrize("computed", [False, True])
def test_a_command_that_refuses_before_it_computed_anything_leaves_nothing(error, computed, tmp_path):
    settings = CompareSettings(out=tmp_path / "runs" / "out")

    def failing():
        with folder_of("compare", settings):
            (settings.out / "runs" / "empty").mkdir(parents=True)
            if computed:
                (settings.out / "runs" / "a.json").write_text("{}")
            raise error

    with pytest.raises(type(error)):
        failing()
    is_refused = isinstance(error, (ValueError, OSError)) and not computed
    assert settings.out.exists() != is_refused
    assert (settings.out / "settings.json").exists() != is_refused
    claim_folder("compare", settings)  # it was given back


def test_files_of_ones_own_stay_where_a_command_refuses_and_nothing_is_added(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="no"), folder_of("compare", CompareSettings(out=tmp_path)):
        raise ValueError("no")
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_settings_of_an_earlier_command_stay_where_a_later_one_refuses(tmp_path):
    settings = CompareSettings(out=tmp_path / "out")
    with folder_of("compare", settings):
        pass
    before = (settings.out / "settings.json").read_bytes()
    with pytest.raises(ValueError, match="no"), folder_of("compare", settings):
        raise ValueError("no")
    assert (settings.out / "settings.json").read_bytes() == before


@pytest.mark.parametrize(
    ("command", "kind", "change", "words"),
    [
        ("compare", CompareSettings, {"seed": 1}, r"\(seed 0, now 1\)"),
        ("compare", CompareSettings, {"seeds": 2}, r"\(seeds 3, now 2\)"),
        ("compare", CompareSettings, {"arms": ("shielded",)}, "arms"),
        ("compare", CompareSettings, {"noise": "gaussian"}, "noise"),
        ("compare", CompareSettings, {"channel": {"loss": 0.5}}, r"\(channel.loss null, now 0.5\)"),
        ("compare", CompareSettings, {"hyperparams": {"gamma": 0.9}}, r"\(hyperparams.gamma null, now 0.9\)"),
        ("compare", CompareSettings, {"seed": 1, "seeds": 1, "steps": 1, "episodes": 1}, r"; \.\.\.\)"),
        ("train", TrainSettings, {"arm": "unshielded"}, "arm"),
        ("sweep", SweepSettings, {"losses": (0.0, 0.3)}, "losses"),
        ("sweep", SweepSettings, {"quantization_steps": (0.1,)}, "quantization_steps"),
        ("reproduce", ReproduceSettings, {"starts": 3}, "starts"),
    ],
)
def test_folder_with_results_of_other_settings_is_refused(command, kind, change, words, tmp_path):
    settings = finished(command, kind(out=tmp_path / "out"), "summary.json")
    before = (tmp_path / "out" / "settings.json").read_bytes()
    with pytest.raises(OtherResultsError, match=f"of other settings.*{words}.*: give another --out, or --force"):
        claim_folder(command, replace(settings, **change))
    assert (tmp_path / "out" / "settings.json").read_bytes() == before
    claim_folder(command, replace(settings, **change, force=True))
    kept = json.loads((tmp_path / "out" / "settings.json").read_bytes())["settings"]
    assert "force" not in kept
    claim_folder(command, replace(settings, **change))


@pytest.mark.parametrize(
    ("command", "kind", "change"),
    [
        ("compare", CompareSettings, {}),
        ("compare", CompareSettings, {"jobs": 7, "smoke": True}),
        ("compare", CompareSettings, {"seeds": 4, "arms": (*CompareSettings.arms, "psf")}),
        ("sweep", SweepSettings, {"engine": "ray", "ray_address": "auto", "cpus_per_run": 0.5}),
        ("sweep", SweepSettings, {"losses": (0.9, 0.0, 0.3, 0.6), "burst_lengths": (0.0, 5.0)}),
    ],
)
def test_what_changes_no_result_or_adds_to_them_is_taken(command, kind, change, tmp_path):
    settings = finished(command, kind(out=tmp_path), "summary.json")
    claim_folder(command, replace(settings, **change))


@pytest.mark.parametrize(
    "changed",
    [
        {"task": Regulation(state_cost=np.diag([4.0, 1.0]))},
        {"max_episode_steps": 50},
        {"disturbance": lambda rng, plant, nominal: np.zeros(2)},
        {"channel": Channel(loss=0.1)},
        {"plant": truck_trailer(mass=900.0)},
        {"terminate_on_violation": True},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_folder_of_an_environment_that_is_registered_otherwise_now_is_refused(changed, tmp_path):
    def registered(**more):
        gym.registry.pop("Own/Truck-v0", None)
        register_plant("Own/Truck-v0", **{"plant": truck_trailer()} | more)

    try:
        registered()
        settings = finished("compare", CompareSettings(env="own:Own/Truck-v0", out=tmp_path))
        before = registration_of("Own/Truck-v0")
        registered()
        assert registration_of("module:Own/Truck-v0") == before
        claim_folder("compare", settings)
        finished("compare", settings)
        registered(**changed)
        assert registration_of("Own/Truck-v0") != before
        with pytest.raises(OtherResultsError, match=r"\(Own/Truck-v0, which is registered otherwise"):
            claim_folder("compare", settings)
        claim_folder("compare", replace(settings, force=True))
    finally:
        del gym.registry["Own/Truck-v0"]


def test_a_plant_in_a_file_counts_with_what_the_file_holds(tmp_path):
    try:
        truck_trailer().save(tmp_path / "plant.json")
        register_plant("Own/File-v0", tmp_path / "plant.json")
        before = registration_of("Own/File-v0")
        truck_trailer(mass=900.0).save(tmp_path / "plant.json")
        assert registration_of("Own/File-v0") != before
    finally:
        del gym.registry["Own/File-v0"]


def test_single_finished_runs_are_kept_and_a_folder_without_any_is_taken(tmp_path):
    settings = CompareSettings(out=tmp_path)
    claim_folder("compare", settings)
    claim_folder("compare", replace(settings, seed=1))
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "shielded-0.json").write_text("{}")
    with pytest.raises(OtherResultsError, match="seed 1, now 2"):
        claim_folder("compare", replace(settings, seed=2))


def test_results_of_another_command_are_refused(tmp_path):
    finished("compare", CompareSettings(out=tmp_path))
    with pytest.raises(OtherResultsError, match="holds finished results of ncs compare: give another --out"):
        claim_folder("train", TrainSettings(out=tmp_path))


@pytest.mark.parametrize("content", [None, "{", "[]", "{}", '{"command": "compare", "settings": 3}'])
def test_results_of_unknown_settings_are_refused(content, tmp_path):
    (tmp_path / "summary.json").write_text("{}")
    if content is not None:
        (tmp_path / "settings.json").write_text(content)
    with pytest.raises(OtherResultsError, match=r"no settings\.json that says of what"):
        claim_folder("compare", CompareSettings(out=tmp_path))


def test_settings_that_an_earlier_version_did_not_have_are_the_defaults(tmp_path):
    finished("train", TrainSettings(out=tmp_path))
    document = json.loads((tmp_path / "settings.json").read_bytes())
    for name in ("smoke", "horizon", "lagrangian"):
        del document["settings"][name]
    (tmp_path / "settings.json").write_text(json.dumps(document))
    finished("train", TrainSettings(out=tmp_path))
    with pytest.raises(OtherResultsError, match="horizon null, now 3"):
        claim_folder("train", TrainSettings(out=tmp_path, arm="lookahead", horizon=3))


@pytest.mark.parametrize("content", [b"{}", b'{"editor.fontSize": 12} // comment', b"\xff", b"[" * 5000, b"3"])
def test_settings_of_something_else_are_not_replaced(content, tmp_path):
    (tmp_path / "settings.json").write_bytes(content)
    with pytest.raises(OtherResultsError, match="none of ours: give another --out, or --force"):
        claim_folder("compare", CompareSettings(out=tmp_path))
    assert (tmp_path / "settings.json").read_bytes() == content
    claim_folder("compare", CompareSettings(out=tmp_path, force=True))


@pytest.mark.parametrize(
    "arguments",
    [
        *(["compare", "--smoke"], ["train", "--smoke"], ["sweep", "--smoke"]),
        *(["reproduce"], ["compare", "--smoke", "--force"]),
    ],
)
def test_folder_that_another_command_has_is_refused(arguments, tmp_path):
    with folder_of("compare", CompareSettings(out=tmp_path)):
        before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
        run = ncs(*arguments, "--out", tmp_path)
        assert_one_sentence(run, f"another command is writing to {tmp_path}", "give another --out")
        assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def hold(out, connection):
    """Has a folder until it is told to give it back."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # in the background it may be ignored
    with folder_of("compare", CompareSettings(out=out)):
        connection.send("has it")
        connection.recv()


@pytest.mark.parametrize(
    "number",
    [signal.SIGKILL, *(pytest.param(each, marks=pytest.mark.slow) for each in (signal.SIGTERM, signal.SIGINT, None))],
)
def test_folder_is_free_again_when_its_command_is_killed_or_interrupted_or_ends(number, tmp_path):
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=hold, args=(tmp_path, there))
    process.start()
    there.close()
    assert here.recv() == "has it"
    with pytest.raises(FolderInUseError):
        claim_folder("compare", CompareSettings(out=tmp_path))
    if number is None:
        here.send("end")
    else:
        os.kill(process.pid, number)
    process.join()
    claim_folder("compare", CompareSettings(out=tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["settings.json"]


def test_the_lock_is_no_file_that_stays(tmp_path):
    (tmp_path / ".lock").write_text("of a process that was killed")
    claim_folder("compare", CompareSettings(out=tmp_path))


def test_file_system_without_locks_is_pointed_out(tmp_path, monkeypatch):
    def no_locks(*arguments):
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))

    monkeypatch.setattr(sys.modules["filelock"].FileLock, "_acquire_native", no_locks, raising=True)
    with pytest.warns(UserWarning, match="has no locks: start no second command in it"):
        claim_folder("compare", CompareSettings(out=tmp_path))
    assert (tmp_path / "settings.json").exists()
