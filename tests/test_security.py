"""What SECURITY.md says: nothing that is read runs code, nothing goes over the network."""

import ast
import json
import sys
from pathlib import Path

import pytest

from agents.agent import Agent
from agents.control_loop import ControlLoop
from agents.sharing.agent_file import AgentError, digest
from agents.training import untrained
from experiments.settings import CompareSettings, settings_json
from shields import Certificate, CertificateError
from tests.command import assert_one_sentence, ncs

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("ncs_gym", "shields", "agents", "experiments")
# Calls that run what they are given.
RUNNING = {"eval", "exec", "compile", "__import__", "os.system", "os.popen", "yaml.load", "yaml.unsafe_load"}
RUNNING |= {"yaml.full_load", "runpy.run_path", "runpy.run_module", "torch.hub.load", "numpy.lib.format.read_array"}
# Calls that run nothing with this argument alone.
SAFE_WITH = {"torch.load": ("weights_only", True), "numpy.load": ("allow_pickle", False)}
SAFE_WITH |= {"stable_baselines3.common.save_util.load_from_zip_file": ("load_data", False)}
# Modules that unpickle or reach the network.
UNPICKLING = {"pickle", "cPickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}
NETWORK = {"socket", "ssl", "urllib", "urllib3", "http", "ftplib", "smtplib", "requests", "httpx", "aiohttp"}

# What goes from a driver to its own workers, over Ray, which unpickles what it is sent itself (SECURITY.md).
BETWEEN_DRIVER_AND_WORKERS = {
    "experiments/backends/ray_cluster.py": ["pickle", "socket"],
    "experiments/backends/ray_backend.py": ["pickle"],
}


def imported(tree):
    """What names stand for in a module: the dotted name of everything it imports, by the name it has there."""
    names = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {each.asname or each.name.partition(".")[0]: each.name for each in node.names if each.asname}
            names |= {
                each.name.partition(".")[0]: each.name.partition(".")[0] for each in node.names if not each.asname
            }
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {each.asname or each.name: f"{node.module}.{each.name}" for each in node.names}
    return names


def dangers(source):
    """Calls and imports in a module's source that could run what a file holds, or reach the network."""
    tree = ast.parse(source)
    names = imported(tree)
    found = [name for name in names.values() if name.partition(".")[0] in UNPICKLING | NETWORK]
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            first, _, rest = ast.unparse(node.func).partition(".")
            called = ".".join(filter(None, [names.get(first, first), rest])).replace("builtins.", "")
            keywords = {each.arg: ast.unparse(each.value) for each in node.keywords}
            keyword, value = SAFE_WITH.get(called, (None, None))
            unsafe = called in SAFE_WITH and keywords.get(keyword) != str(value)
            if called in RUNNING or unsafe or keywords.get("shell", "False") != "False":
                found.append(called)
            if called.endswith(".load") and called.startswith(("stable_baselines3.", "sb3_contrib.")):
                found.append(called)  # stable-baselines3's own `load` unpickles
    return found


@pytest.mark.parametrize("package", PACKAGES)
def test_nothing_that_runs_what_a_file_holds_is_called_in(package):
    files = sorted((ROOT / package).rglob("*.py"))
    assert files
    found = {path.relative_to(ROOT).as_posix(): dangers(path.read_text()) for path in files}
    assert {name: those for name, those in found.items() if those} == {
        name: those for name, those in BETWEEN_DRIVER_AND_WORKERS.items() if name.startswith(package)
    }


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("eval(text)", "eval"),
        ("import builtins\nbuiltins.exec(text)", "exec"),
        ("import os as o\no.system(text)", "os.system"),
        ("from os import popen as p\np(text)", "os.popen"),
        ("import subprocess\nsubprocess.run(text, shell=True)", "subprocess.run"),
        ("def f():\n    import pickle\n    pickle.load(file)", "pickle"),
        ("from cloudpickle import loads", "cloudpickle.loads"),
        ("import yaml\nyaml.load(text, yaml.Loader)", "yaml.load"),
        ("import torch as th\nth.load(file)", "torch.load"),
        ("import torch\ntorch.load(file, weights_only=False)", "torch.load"),
        ("import numpy as np\nnp.load(file, allow_pickle=True)", "numpy.load"),
        ("from stable_baselines3 import PPO\nPPO.load(file)", "stable_baselines3.PPO.load"),
        (
            "from stable_baselines3.common.save_util import load_from_zip_file as f\nf(file)",
            "stable_baselines3.common.save_util.load_from_zip_file",
        ),
        ("import urllib.request", "urllib"),
    ],
)
def test_what_is_looked_for_is_found(source, name):
    assert name in dangers(source)


@pytest.mark.parametrize(
    "source", ["import torch\ntorch.load(file, weights_only=True)", "model.eval()", "re.compile(a)"]
)
def test_what_is_harmless_is_not_found(source):
    assert dangers(source) == []


@pytest.fixture
def evil(tmp_path, monkeypatch):
    """A module that leaves a file where it is imported; `gym.make` imports what stands before a colon in an id."""
    (tmp_path / "evil.py").write_text("from pathlib import Path\nPath(__file__).with_name('imported').touch()\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    assert not (tmp_path / "imported").exists()


@pytest.mark.parametrize("command", ["compare", "train", "sweep", "render", "synthesize"])
def test_no_module_is_imported_for_an_id_alone(command, evil):
    assert_one_sentence(ncs(command, "--env", "evil/Evil-v0", cwd=evil), "unknown environment 'evil/Evil-v0'")


def test_module_that_the_user_names_is_imported(evil, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    run = ncs("synthesize", "--env", "evil:Evil-v0", cwd=evil)
    assert_one_sentence(run, "module 'evil' registers no environment 'Evil-v0'")
    del sys.modules["evil"]
    (evil / "imported").unlink()


def test_settings_of_others_import_no_module(evil):
    content = settings_json("compare", CompareSettings())
    content["settings"]["env"] = "evil:Evil-v0"
    (evil / "settings.json").write_text(json.dumps(content))
    assert_one_sentence(ncs("compare", "--config", "settings.json", cwd=evil), "unknown environment 'evil:Evil-v0'")


def test_settings_files_name_no_module():
    assert settings_json("compare", CompareSettings(env="evil:Evil-v0"))["settings"]["env"] == "Evil-v0"


def test_agents_of_others_import_no_module(evil):
    untrained(ControlLoop(env="ncs_gym/TruckTrailer-v0"), seed=0).save(evil)
    document = json.loads((evil / "agent.json").read_text())
    document["agent"]["env"] = "evil:Evil-v0"
    document["sha256"] = digest(document["agent"])
    (evil / "agent.json").write_text(json.dumps(document))
    with pytest.raises(AgentError, match="evil:Evil-v0, which is not registered"):
        Agent.load(evil)


@pytest.mark.parametrize("content", [b"\x80\x04cos\nsystem\n", b"[" * 100_000, b'{"format": ' + b"9" * 100_000 + b"}"])
def test_certificates_that_are_none_are_refused(content, tmp_path):
    (tmp_path / "c.json").write_bytes(content)
    with pytest.raises(CertificateError):
        Certificate.load(tmp_path / "c.json")
