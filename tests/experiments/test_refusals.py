"""What settings and commands refuse, and the words that users need: a new refusal is a row."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from benchmarks.requests import best_period
from experiments.commands.attack import AttackSettings
from experiments.commands.channel import ChannelSettings
from experiments.commands.compare import CompareSettings
from experiments.commands.sweep import SweepSettings
from experiments.commands.train import TrainSettings, train
from experiments.runs.arms import Arm
from experiments.runs.loops import changed_channel, scenario_named, worse_channel
from experiments.settings import BackendSettings
from ncs_gym import Channel, ChannelContract
from tests.command import assert_one_sentence, ncs

NAN, INF = float("nan"), float("inf")
HORIZON = "--horizon must be at least 1 and at most 50, got"

SETTINGS = [
    *((kind, {"steps": 0}, "--steps must be at least 1") for kind in (CompareSettings, SweepSettings)),
    *((kind, {"jobs": 0}, "--jobs must be at least 1") for kind in (BackendSettings, CompareSettings)),
    (BackendSettings, {"ray_address": "auto"}, "--ray-address is a setting of --engine ray"),
    *((CompareSettings, {name: value}, f"--{name.replace('_', '-')} must be")
      for name, value in {"seeds": 0, "steps": -1, "episodes": 0, "seed": -1, "intervention_penalty": -0.1,
                          "violation_penalty": np.inf}.items()),
    *((CompareSettings, {"algorithms": names}, "--algorithms must be different") for names in ((), ("SAC", "SAC"))),
    (CompareSettings, {"horizon": 0, "mode": "lookahead"}, f"{HORIZON} 0"),
    (CompareSettings, {"horizon": 51, "arms": ("lookahead",)}, f"{HORIZON} 51"),
    *((ChannelSettings, {"file": "f"} | given, "give --certificate and --plant, or --env")
      for given in ({"plant": "p", "env": "e"}, {"certificate": "c"}, {"certificate": "c", "plant": "p", "env": "e"})),
    (CompareSettings, {"horizon": 6}, "--horizon 6 is for mode lookahead, which is not asked for"),
    *((AttackSettings, {name: value}, f"--{name} must be at least")
      for name, value in [("steps", 0), ("steps", NAN), ("seed", -1)]),
    *((ChannelSettings, {"file": Path("packets.csv"), "sampling_period": period},
       "--sampling-period must be a number > 0") for period in (0.0, -0.02, NAN, INF)),
]  # fmt: skip

ARMS = ["", "shielded:hope", "monitor+penalty", "penalized:", "penalized:-1", "penalized:nan", "trusting:project"]
ARMS += ["unshielded at test", "at test", "trusting+psf", "lqr+", "lqr+penalty", "K x_hat+K x_hat", "trusting:7"]

CALLS = [
    *(((Arm.of, name), "unknown arm .*known are unshielded") for name in ARMS),
    ((scenario_named, "worse"), "unknown scenario 'worse'; known are as trained, worst-case disturbance"),
    ((train, TrainSettings(algorithms=("PPO", "SAC"))), "--algorithms must be one for `ncs train`"),
    ((worse_channel, Channel(), ChannelContract(max_age=0)), "no channel within the contract is worse"),
    ((best_period, Channel(0.5), ChannelContract(3)), "any number of packets"),
    ((changed_channel, Channel(), {"lag": 3}), "--channel lag: a channel has no such setting; known are loss"),
]  # fmt: skip

# Most of these the library shows in a box that reads the command line.
USAGE = [
    ("compare --steps 0", "--steps must be at least 1"),
    ("compare --hyperparams gamma", "expected NAME=VALUE"),
    ("compare --channel loss=0.1 loss=0.2", "loss is given twice"),
    ("compare --channel loss=[64", "expected loss=VALUE with a word or a JSON value"),
    ("evaluate nowhere --episodes 0", "--episodes must be at least 1"),
    ("evaluate nowhere --shield project --horizon 6", "--horizon 6 is for mode lookahead"),
    ("render --side-by-side --shield none", "--side-by-side compares with a shield"),
    ("requirements --env ncs_gym/CartPole-v0 --plant x.json", "either --env or --plant"),
    ("requirements --ages -1", "an age must be a whole number >= 0"),
    ("requirements --ages 1 1", "ages must be different values"),
    ("bounds r.csv --plant x.json --out y.json", "a plant is written with --out FILE and --factor"),
    ("sweep --losses 0.1 0.1", "--losses must be different"),
    ("sweep --arms shielded shielded", "--arms must be different values"),
    ("sweep --channel loss=0.5", "--channel loss is a side of the grid"),
    ("paper --starts 0", "--starts must be"),
]

ONE_SENTENCE = [
    ("fly", "unknown command 'fly'; there are compare, train, evaluate"),
    ("compare --env CartPole-v1", "has no plant of its own", "ncs_gym.Networked puts a network"),
    ("compare --env cstr", "unknown environment 'cstr'; known are", "ncs_gym/CSTR-v0"),
    ("channel nofile.csv", "cannot read packets from nofile.csv: No such file or directory"),
    ("bounds r.csv --plant nofile.json", "cannot read the plant in nofile.json: No such file or directory"),
    ("compare --arms shieled", "unknown arm 'shieled'; known are unshielded, monitor, penalized[:WEIGHT]"),
    ("compare --arms shielded shielded", "--arms must be arms that differ"),
    ("compare --channel loss=1.5", "loss"),
    ("compare --certificate nowhere.json", "cannot read certificate nowhere.json"),
    ("train --hyperparams gama=0.9", "PPO: unknown hyperparameter 'gama'"),
    ("evaluate pretrained", "give --env"),
    ("train --env ncs_gym/BatchReactor-v0 --channel quantization_step=0.1", "rounds to 0.1, the contract allows 0.001"),
    ("synthesize --env no_such_module:Plants/Truck-v0", "there is no module 'no_such_module'"),
    ("synthesize --env ../own_plants:Plants/Truck-v0", "needs the name of a module, got '../own_plants'"),
    ("synthesize --env ncs_gym:Plants/Tank-v0", "module 'ncs_gym' registers no environment 'Plants/Tank-v0'"),
    ("synthesize --env ncs_gym:CartPole-v1", "expected an NCSEnv inside", "ncs_gym.Networked puts a network"),
    ("render --out a.avi", "--out must end in .gif or .png"),
    ("render --policy nowhere", "no policy nowhere:", "those with a name are zero input, random, lqr"),
    ("evaluate nofile.zip", "no agent in nofile.zip: cannot read agent.json"),
]  # fmt: skip

# Known without a certificate, which may take minutes.
BEFORE_A_CERTIFICATE = [
    ("compare --env ncs_gym/CSTR-v0 --scenarios gaussian", "noise=\"gaussian\" needs a Gaussian"),
    ("sweep --env ncs_gym/TruckTrailer-v0 --arms governor", "unknown arm 'governor'; known are unshielded"),
]  # fmt: skip

# There are a file `file` and a folder `here`.
UNWRITABLE = [
    ("synthesize --out here", "Is a directory: here"),
    ("synthesize --out file/c.json", "Not a directory: file"),
    ("verify c.json --out nowhere/v.json", "No such file or directory: nowhere"),
    ("paper --out file", "File exists: file"),
    ("compare --smoke --out file", "file"),
]


@pytest.mark.parametrize(("kind", "given", "words"), SETTINGS)
def test_settings_are_refused(kind, given, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        kind(**given)


@pytest.mark.parametrize(("call", "words"), CALLS)
def test_calls_are_refused(call, words):
    with pytest.raises(ValueError, match=words) as caught:
        call[0](*call[1:])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("line", "words"), USAGE)
def test_usage_errors_are_the_parsers(line, words):
    run = ncs(*line.split(), COLUMNS="200")
    assert run.returncode == 2
    assert "Traceback" not in run.stderr
    assert words in " ".join(run.stderr.replace("│", " ").split())


@pytest.mark.parametrize(("line", "words"), BEFORE_A_CERTIFICATE)
def test_arms_and_scenarios_are_refused_before_a_certificate_is_sought(line, words, tmp_path, monkeypatch):
    for command in ("compare", "sweep"):
        monkeypatch.delattr(f"experiments.commands.{command}.certificate_of")
    assert_one_sentence(ncs(*line.split(), cwd=tmp_path), words)


@pytest.mark.parametrize(("line", "words"), [(line, words) for line, *words in ONE_SENTENCE])
def test_other_errors_are_one_sentence_before_anything_is_written(line, words, tmp_path):
    assert_one_sentence(ncs(*line.split(), cwd=tmp_path), *words)
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


@pytest.mark.parametrize(("line", "words"), [(line, words) for line, *words in UNWRITABLE])
def test_file_that_cannot_be_written_is_refused_before_anything_is_computed(line, words, tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "here").mkdir()
    run = ncs(*line.split(), cwd=tmp_path)
    assert_one_sentence(run, *words)
    assert run.stdout == ""
    assert (tmp_path / "file").read_text() == "mine"
    assert {path.name for path in tmp_path.iterdir()} == {"file", "here"}
