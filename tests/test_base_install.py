"""What works without the training extra, in a virtual environment of its own."""

import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
pytestmark = pytest.mark.slow


# Every Python that pyproject.toml declares; the training extra is tested with the first.
VERSIONS = ("3.11", "3.12", "3.13", "3.14")


@pytest.fixture(scope="module", params=VERSIONS)
def binaries(request, tmp_path_factory):
    python = shutil.which(f"python{request.param}")
    if python is None or subprocess.run([python, "--version"], capture_output=True).returncode:
        pytest.skip(f"python{request.param} is not on the PATH")
    folder = tmp_path_factory.mktemp("base") / "venv"
    subprocess.run([python, "-m", "venv", str(folder)], check=True)
    pip = [str(folder / "bin" / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "-c", str(ROOT / "constraints.txt"), str(ROOT)], check=True)
    return folder / "bin"


def run(binary, *arguments, cwd):
    return subprocess.run([str(binary), *map(str, arguments)], cwd=cwd, capture_output=True, text=True, timeout=600)


def test_environments_shields_and_commands_about_certificates_work(binaries, tmp_path):
    code = """
import gymnasium, numpy, ncs_gym, shields, agents
env = shields.SafetyShield(gymnasium.make("ncs_gym/TruckTrailerCruise-v0"))
env.reset(seed=0)
print([env.step(numpy.ones(1, numpy.float32))[4] for _ in range(50)][-1]["episode_violations"])
envs = shields.VectorSafetyShield(gymnasium.make_vec("ncs_gym/TruckTrailerCruise-v0", num_envs=3))
envs.reset(seed=0)
print(envs.step(numpy.ones((3, 1), numpy.float32))[4]["episode_violations"].sum())
"""
    result = run(binaries / "python", "-c", code, cwd=tmp_path)
    assert result.stdout.split() == ["0.0", "0.0"], result.stderr
    file = tmp_path / "c.json"
    for arguments in (["synthesize", "--out", file], ["verify", file], ["paper"]):
        result = run(binaries / "ncs", *arguments, cwd=tmp_path)
        assert result.returncode == 0, result.stderr


def test_what_needs_an_extra_says_so_in_one_sentence(binaries, tmp_path):
    for command, extra in {"compare": "train", "train": "train", "sweep": "train", "render": "render"}.items():
        result = run(binaries / "ncs", command, cwd=tmp_path)
        assert result.returncode == 2
        (line,) = result.stderr.strip().splitlines()
        assert line.endswith(f": pip install 'ncs-gym[{extra}]'")
    last = run(binaries / "python", "-c", "from agents import SB3VecEnv", cwd=tmp_path).stderr.splitlines()[-1]
    assert "agents.SB3VecEnv needs stable_baselines3 and torch, and " in last


def test_declared_versions_are_those_tested():
    classifiers = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["classifiers"]
    declared = [line.rsplit(" ", 1)[1] for line in classifiers if line.startswith("Programming Language :: Python :: ")]
    assert tuple(declared) == VERSIONS
