"""What is installed is what is tested, and imports point one way."""

import ast
import importlib.util
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
ORDER = ("ncs_gym", "shields", "agents", "experiments")
SOLVERS = {"cvxpy", "clarabel"}
LEARNERS = {"torch", "stable_baselines3"}


def imports(path: Path) -> set[str]:
    """Top-level names of everything a module imports."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add(node.module.split(".")[0])
    return names


@pytest.mark.parametrize("package", ORDER)
def test_packages_import_only_from_those_to_their_left(package):
    later = set(ORDER[ORDER.index(package) + 1 :])
    for path in (ROOT / package).rglob("*.py"):
        assert not imports(path) & later, path


def test_only_synthesis_and_paper_import_a_solver():
    users = {path.name for package in ORDER for path in (ROOT / package).rglob("*.py") if imports(path) & SOLVERS}
    synthesis = {"semidefinite_programs.py", "invariant_set_program.py"}
    assert users == synthesis | {"optimization_problem.py", "cone_program.py"}


def test_environment_and_shields_do_not_import_the_learners():
    for package in ORDER[:2]:
        for path in (ROOT / package).rglob("*.py"):
            assert not imports(path) & LEARNERS, path


@pytest.mark.parametrize(
    ("module", "later"),
    [
        ("shields", {"cvxpy", "numba", "torch", "matplotlib"}),
        ("experiments.commands.compare", {"torch", "stable_baselines3"}),
        ("experiments.backends.worker_init", {"numpy", "gymnasium"}),
        ("experiments.__main__", {"numpy", "tyro"}),
    ],
)
def test_what_takes_long_is_imported_when_it_is_needed(module, later):
    code = f"import sys, {module}; print(sorted({later!r} & set(sys.modules)))"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


@pytest.mark.parametrize("package", ORDER)
def test_tested_packages_are_those_of_this_tree(package):
    assert Path(importlib.util.find_spec(package).origin).parent == ROOT / package


def test_no_init_file_below_tests():
    assert not list((ROOT / "tests").rglob("__init__.py"))


def test_command_is_declared_and_runs_as_a_module():
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts == {"ncs": "experiments.__main__:main"}
    run = subprocess.run([sys.executable, "-m", "experiments", "--help"], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0
    assert "compare" in run.stdout


def test_foreign_agents_package_is_refused_in_one_sentence(tmp_path):
    (tmp_path / "agents").mkdir()
    (tmp_path / "agents" / "__init__.py").write_text("")
    code = "import sys; sys.path.insert(0, sys.argv.pop()); from experiments.__main__ import main; main()"
    run = subprocess.run(
        [sys.executable, "-c", code, "--help", str(tmp_path)], cwd=ROOT, capture_output=True, text=True
    )
    assert run.returncode == 2
    assert "virtual environment of its own" in run.stderr
    assert len(run.stderr.strip().splitlines()) == 1


def test_wheel_holds_the_four_packages_and_nothing_else(tmp_path):
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    files = set(zipfile.ZipFile(wheel).namelist())
    names = {name.split("/")[0] for name in files}
    assert {name for name in names if not name.endswith(".dist-info")} == set(ORDER)
    sources = {path for package in ORDER for path in (ROOT / package).rglob("*") if path.is_file()}
    assert files >= {path.relative_to(ROOT).as_posix() for path in sources if "__pycache__" not in path.parts}
    assert {f"{package}/py.typed" for package in ORDER} | {"experiments/report/templates/page.html.j2"} <= files
