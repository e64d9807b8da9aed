"""Results are not replaced by those of other settings, unless it is asked for."""

import json
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from experiments.commands.compare import CompareSettings
from experiments.commands.paper import PaperSettings
from experiments.commands.sweep import SweepSettings
from experiments.commands.train import TrainSettings
from experiments.runs.output_folder import claim_folder
from experiments.runs.provenance import registration_of
from ncs_gym import Channel, Regulation, register_plant, truck_trailer


def finished(command, settings, file="summary.json"):
    """Leaves what a finished command leaves."""
    claim_folder(command, settings)
    (settings.out / file).parent.mkdir(parents=True, exist_ok=True)
    (settings.out / file).write_text("{}")
    return settings


@pytest.mark.parametrize("file", ["summary.json", "runs/shielded-0.json"])
@pytest.mark.parametrize(
    ("command", "kind", "change", "words"),
    [
        ("compare", CompareSettings, {"seed": 1}, r"\(seed 0, now 1\)"),
        ("compare", CompareSettings, {"channel": {"loss": 0.5}}, r"\(channel {}, now {'loss': 0.5}\)"),
        ("train", TrainSettings, {"arm": "unshielded"}, "arm"),
        ("sweep", SweepSettings, {"episodes": 3}, "episodes"),
        ("paper", PaperSettings, {"starts": 3}, "starts"),
    ],
)
def test_folder_with_results_of_other_settings_is_refused(command, kind, change, words, file, tmp_path):
    settings = finished(command, kind(out=tmp_path / "out"), file)
    before = (tmp_path / "out" / "settings.json").read_bytes()
    with pytest.raises(ValueError, match=f"of other settings.*{words}.*: give another --out, or --force"):
        claim_folder(command, replace(settings, **change))
    assert (tmp_path / "out" / "settings.json").read_bytes() == before
    assert (tmp_path / "out" / file).exists()
    claim_folder(command, replace(settings, **change, force=True))
    assert not (tmp_path / "out" / "summary.json").exists()  # which stands for complete results
    kept = json.loads((tmp_path / "out" / "settings.json").read_bytes())["settings"]
    assert kept.keys().isdisjoint({"force", "out", "jobs"})
    claim_folder(command, replace(settings, **change))


@pytest.mark.parametrize(
    ("command", "kind", "change"),
    [
        ("compare", CompareSettings, {"jobs": 7, "smoke": True}),
        ("compare", CompareSettings, {"seeds": 4, "arms": (*CompareSettings.arms, "psf")}),
        ("sweep", SweepSettings, {"engine": "ray", "ray_address": "auto"}),
        ("sweep", SweepSettings, {"losses": (0.9, 0.0, 0.3, 0.6), "delays": (1,)}),
    ],
)
def test_what_changes_no_result_or_adds_to_them_is_taken(command, kind, change, tmp_path):
    claim_folder(command, replace(finished(command, kind(out=tmp_path)), **change))


@pytest.mark.parametrize(
    "changed",
    [
        {"task": Regulation(state_cost=np.diag([4.0, 1.0]))},
        {"max_episode_steps": 50},
        {"disturbance": lambda rng, plant, nominal: np.zeros(2)},
        {"channel": Channel(loss=0.1)},
        {"plant": truck_trailer(mass=900.0)},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_what_an_environment_is_registered_with_is_known(changed):
    def registered(**more):
        gym.registry.pop("Own/Truck-v0", None)
        register_plant("Own/Truck-v0", **{"plant": truck_trailer()} | more)
        return registration_of("module:Own/Truck-v0")

    try:
        before = registered()
        assert registered() == registration_of("Own/Truck-v0") == before
        assert registered(**changed) != before
    finally:
        del gym.registry["Own/Truck-v0"]


def test_results_of_another_command_are_refused(tmp_path):
    finished("compare", CompareSettings(out=tmp_path))
    with pytest.raises(ValueError, match="holds results of ncs compare: give another --out"):
        claim_folder("train", TrainSettings(out=tmp_path))


@pytest.mark.parametrize("content", [None, b"{}", b"\xff", b"[" * 5000, b"3"])
@pytest.mark.parametrize("has_results", [True, False])
def test_settings_of_something_else_are_refused(content, has_results, tmp_path):
    if has_results:
        (tmp_path / "summary.json").write_text("{}")
    if content is not None:
        (tmp_path / "settings.json").write_bytes(content)
    if content is not None or has_results:
        words = "results without their settings" if has_results else "another settings"
        with pytest.raises(ValueError, match=rf"holds {words}\.json: give another --out, or --force"):
            claim_folder("compare", CompareSettings(out=tmp_path))
        assert content is None or (tmp_path / "settings.json").read_bytes() == content
    claim_folder("compare", CompareSettings(out=tmp_path, force=True))
