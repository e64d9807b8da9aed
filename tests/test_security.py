"""What SECURITY.md says: nothing that is read runs code, nothing goes over the network."""

import ast
import hashlib
import io
import json
import zipfile
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from agents.agent import Agent, AgentError
from agents.loop import LoopConfig
from agents.training import untrained
from tests.command import assert_one_sentence, ncs

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("ncs_gym", "shields", "agents", "experiments")
# Calls that run what they are given.
RUNNING = {"eval", "exec", "compile", "__import__", "os.system", "os.popen", "yaml.load", "yaml.unsafe_load"}
RUNNING |= {"yaml.full_load", "runpy.run_path", "runpy.run_module", "torch.hub.load", "numpy.lib.format.read_array"}
# Calls that run nothing with this argument alone.
SAFE_WITH = {"torch.load": ("weights_only", True), "numpy.load": ("allow_pickle", False)}
# Modules that unpickle or reach the network.
UNPICKLING = {"pickle", "cPickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}
NETWORK = {"socket", "ssl", "urllib", "urllib3", "http", "ftplib", "smtplib", "requests", "httpx", "aiohttp"}

KNOWN = {
    "experiments/runs/provenance.py": ["cloudpickle.dumps"],  # what is registered, for a digest: nobody reads it
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


def dotted(node):
    """The name of what is called, empty in place of what is no name."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return dotted(node.func) if isinstance(node, ast.Call) else getattr(node, "id", "")


def dangers(source):
    """Calls and imports in a module's source that could run what a file holds, or reach the network."""
    tree = ast.parse(source)
    names = imported(tree)
    found = [name for name in names.values() if name.partition(".")[0] in UNPICKLING | NETWORK]
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            first, _, rest = dotted(node.func).partition(".")
            called = ".".join(filter(None, [names.get(first, first), rest])).replace("builtins.", "")
            keywords = {each.arg: getattr(each.value, "value", None) for each in node.keywords}
            keyword, value = SAFE_WITH.get(called, (None, None))
            unsafe = called in SAFE_WITH and keywords.get(keyword) is not value
            if called in RUNNING or unsafe or keywords.get("shell", False) is not False:
                found.append(called)
            if called.endswith(".load") and called.startswith(
                ("stable_baselines3.", "sb3_contrib.", "algorithm_class")
            ):
                found.append(called)  # stable-baselines3's own `load` unpickles
    return found


@pytest.mark.parametrize("package", PACKAGES)
def test_nothing_that_runs_what_a_file_holds_is_called_in(package):
    files = sorted((ROOT / package).rglob("*.py"))
    assert files
    found = {path.relative_to(ROOT).as_posix(): dangers(path.read_text()) for path in files}
    assert {name: those for name, those in found.items() if those} == {
        name: those for name, those in KNOWN.items() if name.startswith(package)
    }


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("eval(text)", "eval"),
        ("import subprocess\nsubprocess.run(text, shell=True)", "subprocess.run"),
        ("import yaml\nyaml.load(text, yaml.Loader)", "yaml.load"),
        ("import torch\ntorch.load(file, weights_only=False)", "torch.load"),
        ("from stable_baselines3 import PPO\nPPO.load(file)", "stable_baselines3.PPO.load"),
        ("import urllib.request", "urllib"),
    ],
)
def test_what_is_looked_for_is_found(source, name):
    assert name in dangers(source)


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


def forge(folder, **values):
    """Changes the file of an agent."""
    document = json.loads((folder / "agent.json").read_text())
    (folder / "agent.json").write_text(json.dumps(document | values))


def test_agents_of_others_import_no_module(evil):
    untrained(LoopConfig(env="ncs_gym/TruckTrailer-v0"), seed=0).save(evil)
    forge(evil, env="evil:Evil-v0")
    with pytest.raises(AgentError, match="evil:Evil-v0, which is not registered"):
        Agent.load(evil)


@pytest.fixture
def agent(tmp_path):
    """The folder of an agent."""
    untrained(LoopConfig(env="ncs_gym/TruckTrailer-v0"), seed=0).save(tmp_path / "a" / "agent")
    return tmp_path / "a" / "agent"


@pytest.mark.parametrize("name", ["../evil.pth", "/{root}/evil.pth"])
def test_members_of_the_weights_of_others_are_not_unpacked(name, agent, tmp_path):
    data = io.BytesIO()
    with zipfile.ZipFile(agent / "model.zip") as source, zipfile.ZipFile(data, "w") as target:
        for member in source.namelist():
            target.writestr(member, source.read(member))
        target.writestr(name.replace("/{root}", str(tmp_path)), source.read("policy.pth"))
    (agent / "model.zip").write_bytes(data.getvalue())
    forge(agent, sha256_of_model=hashlib.sha256(data.getvalue()).hexdigest())
    before = {path for path in tmp_path.rglob("*")}
    with suppress(AgentError):  # members that are no weights are not read at all
        Agent.load(agent)
    assert {path for path in tmp_path.rglob("*")} == before


def test_texts_in_a_certificate_mean_nothing_to_a_terminal(certificate):
    assumptions = {"assumptions": ["\x1b[2J\x1b]0;title\x07all conditions hold", "\ud800"]}
    text = str(replace(certificate, provenance=certificate.provenance | assumptions))
    assert "\\x1b[2J" in text
    assert "\\ud800" in text
    assert all(each.isprintable() or each == "\n" for each in text)
