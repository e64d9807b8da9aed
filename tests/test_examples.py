"""Every example runs as it is, with a tiny budget, and prints what it is about."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.command import environment
from tests.programs import output_of_file

ROOT = Path(__file__).resolve().parent.parent
NUMBER = r"-?[\d.,]+"

# Arguments of a tiny run, and what has to stand in its output.
RUNS = {
    "both_directions.py": ([], ["applied as decided: 3000 of 3000", "proved: 3000 of 3000 steps"]),
    "change_the_channel.py": ([], [rf"{re.escape('30 % lost, 2 steps late')} +root mean square error {NUMBER}"]),
    "loggers.py": (["--steps", "1024"], [r"violation_rate 0\.000 safety/intervention_rate 0\.[1-9]"]),
    "lost_hour.py": ([], [rf"proved in {share} of 9600 steps, outside the box in 0" for share in ("9600", r"24\d\d")]),
    "delayed_classics.py": (["--smoke", "--only", "CartPole-v1"], [rf"CartPole +PPO +bursts +{NUMBER} +{NUMBER}"]),
    "pettingzoo_network.py": ([], [rf"both see three steps late: {NUMBER}"]),
    "mpc_loop.py": ([], [r"monitor: outside the box in [1-9]", r"project: outside the box in 0 .* in 300 of 300"]),
    "own_plant.py": (["--steps", "12800"], ["without a violation: 64 of 64"]),
    "plain_loop.py": ([], [r"overridden: \d+ of 1000; closest to the limit: 0\.\d+", "proved to be safe: True"]),
    "quick_start.py": ([], ["violating steps: 0", r"overridden actions: [1-9]", "the proof held: True"]),
    "random_networks.py": (
        ["--steps", "6400"],
        [rf"trained on the {name}, worst network: return {NUMBER}, violating steps: 0" for name in ("best", "range")],
    ),
    "recurrent_ppo.py": (["--steps", "1024"], [rf"mean return of the last 4 episodes: {NUMBER}", "violating steps: 0"]),
    "quadruple_tank.py": ([], [r"without a shield: [1-9]\d+ of 400", "with a shield: 0 of 400 steps outside"]),
    "servo_requirements.py": ([], ["a step of 0.005 s: max_age = 6", "a step of 0.02 s: max_age = 1"]),
    "sb3_ten_lines.py": (
        ["--steps", "210"],
        [rf"{name}: last return {NUMBER}; 0 violating steps, [1-9]\d* actions" for name in ("PPO", "SAC", "TD3")],
    ),
    "minari_dataset.py": ([], [r"steps of each: \[0\.0, 0\.0, 0\.0\]", "those applied: True"]),
    "sb3_processes.py": ([], [r"10 episodes, violating steps: 0\b"]),
    "single_file_ppo.py": (
        ["--total-timesteps", "512", "--num-envs", "2", "--epochs", "2"],
        ["violating steps: 0; actions overridden: [1-9]"],
    ),
    "single_file_sac.py": (
        ["--total-timesteps", "420", "--learning-starts", "390"],
        ["violating steps: 0; actions overridden: [1-9]"],
    ),
    "tianshou_processes.py": ([], [r"violating steps: \[0\.0, 0\.0\]"]),
    "torch_tensors.py": ([], [r"update 100: mean action applied 0\.\d+, [1-4]\d\d of 500 pass as they are"]),
    "torchrl_rollout.py": ([], [rf"return of 200 random steps: {NUMBER}; violating steps: 0\b"]),
    "udp_loop.py": ([], [r"no command in time: [1-9]", r"proved: \d+ of 140 steps; now: False, the downlink broke"]),
    "unstable_plant_loop.py": ([], ["in use: 4 steps, allowed: 4", "proved: 5000 of 5000 steps"]),
    "your_gym_env.py": (["--steps", "4096"], ["episodes without a violation: 16 of 16"]),
    "wifi_record.py": ([], ["packets.csv: 360,000 packets, 76 stalls in 14 clusters"]),
    "write_a_task.py": ([], [rf"return of doing nothing: {NUMBER}"]),
}
TRAINING = {
    "loggers.py",
    "own_plant.py",
    "random_networks.py",
    "recurrent_ppo.py",
    "sb3_processes.py",
    "sb3_ten_lines.py",
    "single_file_sac.py",
    "your_gym_env.py",
}
# They synthesize certificates, or simulate an hour: in processes of their own, of `make test-slow`, alone.
LONG = {"both_directions.py", "lost_hour.py", "mpc_loop.py", "quadruple_tank.py", "servo_requirements.py"}
LONG |= {"unstable_plant_loop.py"}
# Packages that no extra installs.
FOREIGN = {
    "minari_dataset.py": ("minari", "jax", "h5py"),
    "tianshou_processes.py": ("tianshou",),
    "torchrl_rollout.py": ("torchrl",),
}


def run_example(name, *arguments, cwd, **variables):
    command = [sys.executable, str(ROOT / "examples" / name), *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=environment(**variables), cwd=cwd, timeout=600)


def test_every_example_is_run_here():
    assert {path.name for path in (ROOT / "examples").glob("*.py")} == set(RUNS)


@pytest.mark.cases(1)
@pytest.mark.parametrize("name", sorted(RUNS.keys() - TRAINING - LONG - FOREIGN.keys()))
def test_example_prints_what_it_is_about(name):
    assert_expected(name, output_of_file(ROOT / "examples" / name, *RUNS[name][0]))


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(RUNS))
def test_example_runs_in_a_process_of_its_own_and_prints_what_it_is_about(name, tmp_path):
    missing = [package for package in FOREIGN.get(name, ()) if importlib.util.find_spec(package) is None]
    if missing:
        pytest.skip(f"{', '.join(missing)} not installed: a virtual environment of its own (docs/agents.md)")
    run = run_example(name, *RUNS[name][0], cwd=tmp_path, MINARI_DATASETS_PATH=str(tmp_path))
    assert run.returncode == 0, run.stderr
    assert_expected(name, run.stdout)


def assert_expected(name, printed):
    for pattern in RUNS[name][1]:
        assert re.search(pattern, printed), f"{pattern!r} is not in {printed!r}"
