"""What is installed is what is tested, and imports point one way."""

import ast
import importlib
import importlib.util
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml

import ncs_gym
from ncs_gym.installation import GENERIC_NAMES
from tests.command import ncs

ROOT = Path(__file__).resolve().parent.parent
ORDER = ("ncs_gym", "shields", "agents", "experiments")
SOLVERS = {"cvxpy", "clarabel"}
LEARNERS = {"torch", "stable_baselines3"}
COMPILERS = {"numba", "llvmlite", "jax", "jaxlib", "cython", "pyximport", "torch._dynamo"}
MODULES = sorted(path for package in ORDER for path in (ROOT / package).rglob("*.py"))


def name_of(path: Path) -> str:
    """Dotted name of a module."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


NAMES = {name_of(path) for path in MODULES}


def imports(path: Path, *, later: bool = True) -> set[str]:
    """Dotted names of everything a module imports; what functions and type checkers import as well, if `later`."""
    names, waiting = set(), [ast.parse(path.read_text())]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= inner if inner <= NAMES else inner | {node.module}
        is_later = isinstance(node, ast.FunctionDef)
        is_later |= isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        if (later or not is_later) and not isinstance(node, ast.expr):
            waiting += ast.iter_child_nodes(node)
    return names


def test_no_modules_import_each_other():
    edges = {name_of(path): (imports(path, later=False) & NAMES) - {name_of(path)} for path in MODULES}
    while leaves := {name for name, used in edges.items() if not used & edges.keys()}:
        edges = {name: used for name, used in edges.items() if name not in leaves}
    assert edges == {}


def test_only_what_solves_programs_imports_a_solver():
    importing = [path for path in MODULES if SOLVERS & {name.partition(".")[0] for name in imports(path)}]
    users = {path.parent.relative_to(ROOT).as_posix() for path in importing}
    assert users == {"shields/synthesis", "shields/paper", "shields/runtime/backup_plans", "experiments/baselines"}


def test_what_takes_long_is_imported_when_it_is_needed():
    """One process does one thing after the other, those that need least first; after each it looks for the rest.

    Nothing is compiled where shields are made and steps are taken, nothing that draws is imported before anything is
    drawn, and the published method is there without a further import.
    """
    drawing, solving = {"matplotlib", "pygame"}, SOLVERS | {"scipy.optimize"}
    plant = """import numpy
model, limits = ncs_gym.Model([[0.9]], [[1.0]], None, dt=0.1), ncs_gym.Limits(state=[1.0], input=1.0)
plant = ncs_gym.LinearPlant(model, limits, ncs_gym.Bounds(disturbance=1e-3, sensor=0.0, first_error=0.0))
certificate = shields.synthesize(plant)
env = shields.SafetyShield(gymnasium.make("ncs_gym/LinearNCS-v0", plant=plant), certificate)
many = shields.VectorSafetyShield(gymnasium.make_vec("ncs_gym/LinearNCS-v0", num_envs=2, plant=plant), certificate)
for each, shape in ((env, (1,)), (many, (2, 1))):
    each.reset(seed=0)
    each.step(numpy.ones(shape, numpy.float32))
"""
    later = {
        "import experiments.__main__": {"numpy", "tyro"},
        "import ncs_gym": {"scipy.linalg", "scipy.optimize", "scipy.stats", "filterpy"} | drawing,
        "import shields": SOLVERS | LEARNERS | drawing | {"scipy.stats", "filterpy"},
        "import gymnasium; shields.SafetyShield(gymnasium.make('ncs_gym/CartPole-v0')).reset(seed=0)": solving,
        "import experiments.settings": SOLVERS | LEARNERS | drawing | {"scipy.stats", "filterpy"},
        "from agents import LoopConfig, Episode, Evaluation, TrainingPoint, evaluate, tuned_hyperparams": LEARNERS,
        "shields.paper.synthesize; import experiments.commands.attack": COMPILERS | drawing,
        plant: COMPILERS | drawing | {"filterpy"},
        "import experiments.commands.compare": LEARNERS,
    }
    code = (
        f"import sys\nfor what, late in {later!r}.items():\n    exec(what)\n    print(sorted(late & set(sys.modules)))"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert run.stdout.splitlines() == len(later) * ["[]"]


@pytest.mark.parametrize("package", ORDER)
def test_tested_packages_are_those_of_this_tree(package):
    assert Path(importlib.util.find_spec(package).origin).parent == ROOT / package


@pytest.mark.cases(1)
@pytest.mark.parametrize("name", GENERIC_NAMES)
def test_package_of_the_same_name_elsewhere_is_refused_in_one_sentence(name, tmp_path):
    (tmp_path / name).mkdir()
    (tmp_path / name / "__init__.py").write_text("")
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); "
    if name == "experiments":  # `ncs` itself cannot start then
        code += f"from ncs_gym.installation import require_own_packages; require_own_packages({name!r})"
    else:
        code = f"from experiments.__main__ import main; {code} main()"
    run = subprocess.run([sys.executable, "-c", code, "--help"], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode != 0
    assert f"the package {name!r} that Python finds ({tmp_path / name}" in run.stderr
    assert "if it is yours, rename it" in run.stderr
    assert "virtual environment of its own" in run.stderr
    if name != "experiments":
        assert run.returncode == 2
        assert len(run.stderr.strip().splitlines()) == 1


def test_version_is_one():
    run = ncs("--version")
    assert run.stdout == f"ncs-gym {ncs_gym.__version__}\n", run.stderr
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == ncs_gym.__version__
    assert re.search(rf"^## \[{re.escape(ncs_gym.__version__)}\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert "version" not in project


def test_distributions_hold_every_file_of_the_repository_and_the_four_packages_alone(tmp_path):
    build = [sys.executable, "-m", "hatchling", "build", "-d", str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (sdist,), (wheel,) = tmp_path.glob("*.tar.gz"), tmp_path.glob("*.whl")
    with tarfile.open(sdist) as archive:
        files = {name.partition("/")[2] for name in archive.getnames()}
    named = {"Makefile", "constraints.txt", "CONTRIBUTING.md", "CITATION.cff", "benchmarks/speed.py", ".ci/run"}
    assert named <= files
    if (ROOT / ".git").exists():
        tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
        present = {name for name in tracked.stdout.split("\0") if name and (ROOT / name).is_file()}
        assert present - files == set()
    files = set(zipfile.ZipFile(wheel).namelist())
    names = {name.split("/")[0] for name in files}
    assert {name for name in names if not name.endswith(".dist-info")} == set(ORDER)
    sources = {path for package in ORDER for path in (ROOT / package).rglob("*") if path.is_file()}
    assert files >= {path.relative_to(ROOT).as_posix() for path in sources if "__pycache__" not in path.parts}
    data = {"experiments/templates/comparison.html.j2", "agents/tuned/ppo.json"}
    assert {f"{package}/py.typed" for package in ORDER} | data <= files
