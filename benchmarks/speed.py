"""How fast things are that a user waits for: `python -m benchmarks.speed COMMAND`.

Commands: imports, first-shield, environments, networked, rendering, examples, ppo.
"""

from __future__ import annotations

import ast
import json
import os
import re
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import tyro
from filterpy.kalman import KalmanFilter
from gymnasium.spaces import Box, Discrete
from gymnasium.wrappers import DelayObservation
from scipy.signal import cont2discrete
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper, VecNormalize

from agents import LoopConfig, SB3VecEnv, evaluate
from agents.agent import Normalization
from agents.algorithms import build_model, normalized_env
from agents.hyperparams import complete_hyperparams
from benchmarks.commands import run, table
from benchmarks.timing import Steps, in_rounds, process_times
from ncs_gym import Channel, GilbertElliott, Networked, VectorNetworked
from ncs_gym.registration import registered_ids
from shields import SafetyShield, VectorSafetyShield

ROOT = Path(__file__).resolve().parent.parent
CRUISE, CASE_STUDY = "ncs_gym/TruckTrailerCruise-v0", "ncs_gym/TruckTrailer-v0"


def imports() -> None:
    """Processor time of what a user waits for first, in processes of their own, each after one that imports gymnasium.

    The time is the best of seven, the ratio to the process before it is the median: what else the machine does slows
    both.
    """
    reference = ["-c", "import gymnasium"]
    starts = {
        "import gymnasium": reference,
        "import ncs_gym": ["-c", "import ncs_gym"],
        "import shields": ["-c", "import shields"],
        "ncs --help": ["-m", "experiments", "--help"],
        "ncs compare --help": ["-m", "experiments", "compare", "--help"],
    }
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

    def seconds(arguments: list[str]) -> float:
        return process_times([sys.executable, *arguments], env=environment, check=True)[0]

    show = table("[s]", "time", "times gymnasium")
    for name, arguments in starts.items():
        pairs = [(seconds(reference), seconds(arguments)) for _ in range(7)]
        ratio = statistics.median(time / reference for reference, time in pairs)
        show(name, f"{min(time for _, time in pairs):.2f}", f"{ratio:.1f}")


_FIRST_SHIELD = """
import sys, time
import gymnasium as gym, ncs_gym
from shields import SafetyShield, VectorSafetyShield
times = [time.process_time()]
SafetyShield(gym.make(sys.argv[1]))
times.append(time.process_time())
env = VectorSafetyShield(gym.make_vec(sys.argv[1], num_envs=1024))
env.reset(seed=0)
times.append(time.process_time())
env.step(env.action_space.sample())
times.append(time.process_time())
print(*(f"{1e3 * (later - earlier):.0f}" for earlier, later in zip(times, times[1:])))
"""


def first_shield(ids: tyro.conf.Positional[tuple[str, ...]] = ()) -> None:
    """Processor time until the first shield of each registered environment is made, in a process of its own.

    Imports are not counted: `imports` has them.
    """
    show = table("processor time [ms]", "shield", "1024, reset", "first step")
    for env_id in ids or registered_ids():
        show(env_id, *process_times([sys.executable, "-c", _FIRST_SHIELD, env_id], check=True)[2].stdout.split())


class PlainTruckTrailer(gym.Env):
    """What a user would write instead: the truck-trailer behind a lossy channel, on filterpy, in forty lines.

    One environment, the late packet applied as if it were current, no bound on the error, almost no info.
    """

    def __init__(self, mass=4000.0, loss=0.3, step=0.05, period=2, delay=2, u_max=4.0):
        continuous: Any = (np.array([[0.0, 1.0], [-4500.0 / mass, -4600.0 / mass]]), np.array([[0.0], [1.0]]))
        model: Any = cont2discrete((*continuous, np.eye(2), np.zeros((2, 1))), 0.5)
        self.A, self.B = model[:2]
        self.loss, self.step_size, self.period, self.delay, self.u_max = loss, step, period, delay, u_max
        self.observation_space = Box(-100.0, 100.0, (3,), np.float32)
        self.action_space = Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.steps, self.in_flight = 0.2 * self.np_random.uniform(-1, 1, 2), 0, {}
        self.speed, self.target = self.np_random.uniform(0, 25, 2)
        self.filter: Any = KalmanFilter(dim_x=2, dim_z=2, dim_u=1)
        self.filter.x, self.filter.F, self.filter.B, self.filter.H = self.x.copy(), self.A, self.B, np.eye(2)
        self.filter.P, self.filter.Q, self.filter.R = 1e-4 * np.eye(2), 6e-4 * np.eye(2), 3e-4 * np.eye(2)
        return self._observation(), {}

    def step(self, action):
        u, rng = self.u_max * np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0), self.np_random
        noise = 0.01 * rng.standard_normal(2) + rng.uniform(-1.0, 1.0, 2) * (0.02, 0.01)
        self.x = self.A @ self.x + self.B @ u + noise
        self.steps += 1
        self.speed += 0.5 * u[0]
        if rng.random() < 0.02:
            self.target = rng.uniform(0, 25)
        if self.steps % self.period == 0 and rng.random() >= self.loss:
            y = np.round((self.x + 0.01 * rng.standard_normal(2)) / self.step_size) * self.step_size
            self.in_flight[self.steps + self.delay] = y
        self.filter.predict(u)
        if self.steps in self.in_flight:
            self.filter.update(self.in_flight.pop(self.steps))
        reward = -0.2 * min(abs(self.target - self.speed) / 5.0, 5.0) - 0.002 * u[0] ** 2
        return self._observation(), float(reward), False, self.steps >= 200, {"cost": float(np.abs(self.x).max() > 2.0)}

    def _observation(self):
        return np.array([*self.filter.x, self.target - self.speed], dtype=np.float32)


PLAIN = "PlainTruckTrailer-v0"
_make: Any = PlainTruckTrailer
gym.register(PLAIN, entry_point=_make, max_episode_steps=200)


def many(env_id: str, count: int, *, shielded: bool = False) -> gym.vector.VectorEnv:
    """Returns environments side by side."""
    envs = gym.make_vec(env_id, num_envs=count, vectorization_mode="vector_entry_point")
    return VectorSafetyShield(envs) if shielded else envs


def copies(kind: Any, env_id: str, count: int) -> Any:
    """Returns scalar environments in a vector of a kind."""
    return kind([lambda: gym.make(env_id)] * count)


def environments(seconds: float = 1.0, brief: bool = False, ids: bool = False, ppo: bool = False) -> None:
    """Environment steps per second of processor time, ours against what a user would pick instead, in one run.

    --brief, which CI prints, leaves out all but one environment and 1024 of them; --ids prints 1024 of every registered
    id, after 200 steps, without those whose packages are missing; --ppo what share of PPO's time with the defaults of
    stable-baselines3 four scalar environments take. The processor time of all processes counts. In brackets stands the
    ratio to the first row, the median over rounds. A row takes --seconds.
    """
    if ids:
        return _every_id(seconds)
    if ppo:
        return _shares_of_ppo(seconds)
    _first_steps()
    one = {
        "gymnasium Pendulum": lambda: gym.make("Pendulum-v1"),
        "plain truck-trailer on filterpy": lambda: gym.make(PLAIN),
        "ours, case study": lambda: gym.make(CASE_STUDY),
        "ours, cruise": lambda: gym.make(CRUISE),
        "ours, case study, shielded": lambda: SafetyShield(gym.make(CASE_STUDY)),
        "ours, cruise, shielded": lambda: SafetyShield(gym.make(CRUISE)),
    }
    _rates("one environment, steps per CPU second (ratio to Pendulum)", one, seconds)
    for n in (1024,) if brief else (64, 1024, 16384):
        rows = {
            "gymnasium CartPole, vector": lambda n=n: many("CartPole-v1", n),
            "ours, case study": lambda n=n: many(CASE_STUDY, n),
            "ours, cruise": lambda n=n: many(CRUISE, n),
            "ours, case study, shielded": lambda n=n: many(CASE_STUDY, n, shielded=True),
            "ours, cruise, shielded": lambda n=n: many(CRUISE, n, shielded=True),
            "ours, cruise, SB3VecEnv": lambda n=n: SB3VecEnv(many(CRUISE, n)),
        }
        _rates(f"N = {n}, steps per CPU second (ratio to CartPole)", rows, seconds)
    for n in () if brief else (64, 1024):
        rows = {
            "plain truck-trailer, DummyVecEnv": lambda n=n: copies(DummyVecEnv, PLAIN, n),
            "gymnasium Pendulum, DummyVecEnv": lambda n=n: copies(DummyVecEnv, "Pendulum-v1", n),
            "ours, cruise": lambda n=n: many(CRUISE, n),
            "ours, cruise, shielded": lambda n=n: many(CRUISE, n, shielded=True),
        }
        _rates(f"N = {n}, steps per CPU second (ratio to the plain one under DummyVecEnv)", rows, seconds)
    rows = {
        "plain truck-trailer, DummyVecEnv": lambda: copies(DummyVecEnv, PLAIN, 8),
        "plain truck-trailer, SubprocVecEnv": lambda: copies(SubprocVecEnv, PLAIN, 8),
        "plain truck-trailer, AsyncVectorEnv": lambda: copies(gym.vector.AsyncVectorEnv, PLAIN, 8),
        "ours, cruise": lambda: many(CRUISE, 8),
        "ours, cruise, shielded": lambda: many(CRUISE, 8, shielded=True),
    }
    if not brief:
        _rates("N = 8, steps per CPU second of all processes (ratio to the plain one under DummyVecEnv)", rows, seconds)


def _rates(title: str, rows: dict[str, Callable[[], Any]], seconds: float) -> None:
    """Prints rates, and ratios to the first row."""
    steps = {name: Steps(make()) for name, make in rows.items()}
    found = in_rounds(steps, seconds)
    ratios = np.median(found[:, :1] / found, axis=0)
    print(f"\n{title}")
    for name, each, ratio in zip(steps, np.median(found, axis=0), ratios, strict=True):
        print(f"  {name:44s} {_rate(each):>9s}  ({ratio:.3g})")
    for each in steps.values():
        each.env.close()


def _rate(seconds: float) -> str:
    return f"{1e-6 / seconds:.2f}M" if seconds <= 1e-6 else f"{1e-3 / seconds:.1f}k"


def _first_steps() -> None:
    """Prints the processor time of the first step and of 200 steps of 1024 shielded environments, made and reset."""
    certificate = VectorSafetyShield(gym.make_vec(CRUISE, num_envs=1)).certificate
    start = time.process_time()
    steps = Steps(VectorSafetyShield(gym.make_vec(CRUISE, num_envs=1024), certificate))
    steps.step()
    first = time.process_time() - start
    for _ in range(199):
        steps.step()
    print(f"\nfirst step of 1024 shielded environments: {first:.2f} s of CPU, first 200 steps: ", end="")
    print(f"{time.process_time() - start:.2f} s\n  (made, reset and patterns of arrivals worked out)")


def _every_id(seconds: float) -> None:
    print("\nN = 1024, steps per CPU second after 200 steps")
    print(f"  {'':30s} {'bare':>9s} {'shielded':>9s}")
    for env_id in [each for each in registered_ids() if each.startswith("ncs_gym/")]:
        rates = []
        for shielded in (False, True):
            steps = Steps(many(env_id, 1024, shielded=shielded))
            for _ in range(200):
                steps.step()
            rates.append(_rate(steps.seconds(seconds)))
        print(f"  {env_id.removeprefix('ncs_gym/'):30s} {rates[0]:>9s} {rates[1]:>9s}", flush=True)


class TimedVecEnv(VecEnvWrapper):
    """Adds up the processor time of resets and steps."""

    seconds = 0.0

    def reset(self):
        return self._timed(self.venv.reset)

    def step_wait(self):
        return self._timed(self.venv.step_wait)

    def _timed(self, call):
        start = time.process_time()
        result = call()
        self.seconds += time.process_time() - start
        return result


def _shares_of_ppo(seconds: float) -> None:
    """Prints what share of the processor time of PPO is that of four scalar environments, after the first rollout."""
    torch.set_num_threads(1)
    modes = {"bare": None, "project": {}, "lookahead": {"mode": "lookahead"}}
    print("\nfour scalar environments in PPO's CPU time [%]")
    print(f"  {'':30s} " + " ".join(f"{mode:>9s}" for mode in modes))
    for name in ("CSTR", "TruckTrailerCruise", "CartPole"):
        shares = []
        for shield in modes.values():
            wrapper = None if shield is None else lambda env, given=shield: SafetyShield(env, **given)
            env = TimedVecEnv(make_vec_env(f"ncs_gym/{name}-v0", 4, seed=0, wrapper_class=wrapper))
            model = PPO("MlpPolicy", env, seed=0, device="cpu").learn(1)
            env.seconds, start = 0.0, time.process_time()
            model.learn(round(8192 * seconds), reset_num_timesteps=False)
            shares.append(100.0 * env.seconds / (time.process_time() - start))
        print(f"  {name:30s} " + " ".join(f"{share:9.0f}" for share in shares), flush=True)


class Images(gym.Env):
    """A new image at each step."""

    observation_space, action_space = Box(0, 255, (84, 84, 4), np.uint8), Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros((84, 84, 4), np.uint8), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return np.zeros((84, 84, 4), np.uint8), 0.0, False, False, {}


def networked(seconds: float = 2.0) -> None:
    """What `Networked` costs a step of CartPole-v1, of 1024, and of images, beside Gymnasium's DelayObservation.

    Times are processor time per step; the last column is the median over rounds of the difference to the bare
    environment, or of the ratio of its time to theirs. A row takes --seconds.
    """
    bursts = Channel(loss=GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.3))
    both = Channel(loss=0.2, delay=1)

    def pole() -> gym.Env:
        return gym.make("CartPole-v1")

    one = {
        "bare": pole(),
        "DelayObservation, 2 steps": DelayObservation(pole(), 2),
        "Networked, delay=2": Networked(pole(), Channel(delay=2)),
        "Networked, bursts": Networked(pole(), bursts),
        "Networked, losses both ways": Networked(pole(), both, both, neutral=0),
        "Networked, bursts, age and pending actions": Networked(pole(), bursts, observe=("age", "pending_actions")),
    }
    batches = {
        "bare": many("CartPole-v1", 1024),
        "VectorNetworked, delay=2": VectorNetworked(many("CartPole-v1", 1024), Channel(delay=2)),
        "VectorNetworked, bursts": VectorNetworked(many("CartPole-v1", 1024), bursts),
        "VectorNetworked, losses both ways": VectorNetworked(many("CartPole-v1", 1024), both, both, neutral=0),
    }
    images = {
        "bare": Images(),
        "DelayObservation, 2 steps": DelayObservation(Images(), 2),
        "Networked, bursts": Networked(Images(), bursts),
    }
    for title, envs in {"CartPole-v1": one, "1024 CartPole-v1": batches, "images of 84 x 84 x 4": images}.items():
        actions = None if envs is batches else [0, 1]  # episodes that are not over at once
        found = in_rounds({name: Steps(env, actions) for name, env in envs.items()}, seconds)
        found *= 1e6 * (1024 if envs is batches else 1)
        last = found[:, :1] / found if envs is batches else found - found[:, :1]
        show = table(title, "us per step", "bare / this" if envs is batches else "more [us]", first=44, width=14)
        for name, each, own in zip(envs, np.median(found, axis=0), np.median(last, axis=0), strict=True):
            show(f"  {name}", f"{each:.1f}", f"{own:.2f}")


def rendering() -> None:
    """How many pictures per second render mode "rgb_array" draws, steps included."""
    frames, repeats = 200, 5

    def measured(env: Any) -> tuple[float, float]:
        """Returns the mean times of a step and of a picture in an episode of small random actions [s]."""
        env.reset(seed=0)
        env.render()
        rng, step, picture = np.random.default_rng(0), 0.0, 0.0
        for _ in range(frames):
            action = rng.uniform(-0.2, 0.2, env.action_space.shape).astype(np.float32)
            started = time.perf_counter()
            env.step(action)
            between = time.perf_counter()
            env.render()
            step, picture = step + between - started, picture + time.perf_counter() - between
        return step / frames, picture / frames

    show = table("environment", "step [ms]", "picture [ms]", "pictures/s", first=38)
    for env_id in registered_ids():
        env = gym.make(env_id, render_mode="rgb_array", terminate_on_violation=False).unwrapped
        step, picture = (min(times) for times in zip(*(measured(env) for _ in range(repeats)), strict=True))
        show(env_id, f"{1e3 * step:.2f}", f"{1e3 * picture:.2f}", f"{1.0 / (step + picture):.0f}")


def examples(names: tyro.conf.Positional[tuple[str, ...]] = ()) -> None:
    """How long every example takes as it is, beside what it says; each in a process of its own, one after the other.

    Processor time and time on the clock differ where more threads compute than are needed, or where something waits.
    """
    stated = re.compile(r"[Tt]akes about (.*?) on one core")
    threads = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    environment = {name: value for name, value in os.environ.items() if name not in threads}
    environment |= {"PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
    show = table("example", "stated", "CPU [s]", "wall [s]", first=26, width=16)
    for name in names or sorted(path.name for path in (ROOT / "examples").iterdir() if path.is_file()):
        text, arguments = _about(ROOT / "examples" / name)
        with tempfile.TemporaryDirectory() as folder:
            given = environment | {"MINARI_DATASETS_PATH": folder}
            seconds, clock, ended = process_times([sys.executable, *arguments], cwd=folder, env=given)
        show(name, found[1] if (found := stated.search(text)) else "-", f"{seconds:.1f}", f"{clock:.1f}")
        if ended.returncode:
            print(f"  failed: {ended.stderr.strip().splitlines()[-1]}", flush=True)


def _about(path: Path) -> tuple[str, list[str]]:
    """Returns what an example says of itself, and what Python is called with to run it."""
    if path.suffix == ".ipynb":
        cells = json.loads(path.read_text())["cells"]
        said = "".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
        code = [cell for cell in cells if cell["cell_type"] == "code" and "%pip" not in "".join(cell["source"])]
        return said, ["-c", "\n\n".join("".join(cell["source"]) for cell in code)]
    return ast.get_docstring(ast.parse(path.read_text())) or "", [str(path)]


# Whether the environments of a training are scalar, whether our defaults hold, and what is given of its settings.
TRAININGS: dict[str, tuple[bool, bool, dict[str, Any]]] = {
    "stable-baselines3, scalar": (True, False, {}),
    "the same, n_steps 256": (True, False, {"n_steps": 256}),
    "ours, scalar, 16 environments": (True, True, {"n_envs": 16, "n_steps": 128, "batch_size": 1024}),
    "ours": (False, True, {}),
}


def ppo(steps: int = 150_000, seeds: int = 2) -> None:
    """PPO's default settings here against those of stable-baselines3: frames per second and return.

    All agents learn `ncs_gym/TruckTrailerCruise-v0` unshielded, with the same number of steps and the same
    normalization: with our settings in the vector environment, with those of stable-baselines3 in a DummyVecEnv of 8
    scalar environments. Frames per second are those of the whole training, environment included; ratios are to the
    first line.
    """
    loop = LoopConfig(env=CRUISE)

    def envs(scalar: bool, count: int) -> VecEnv:
        return DummyVecEnv([lambda: Monitor(gym.make(CRUISE))] * count) if scalar else SB3VecEnv(loop.vector(count))

    def trained(scalar: bool, ours: bool, given: dict[str, Any], steps: int, seed: int) -> tuple[Any, VecNormalize]:
        if ours:
            hyperparams = complete_hyperparams("PPO", given)
            env = normalized_env("PPO", envs(scalar, hyperparams["n_envs"]), hyperparams)
            return build_model("PPO", env, hyperparams, seed, steps).learn(steps), env
        env = VecNormalize(envs(scalar, 8), gamma=0.99)
        return PPO("MlpPolicy", env, seed=seed, device="cpu", **given).learn(steps), env

    def mean_return(model: BaseAlgorithm, env: VecNormalize) -> float:
        normalize = Normalization.of(env)
        result = evaluate(loop, lambda o, infos: model.predict(normalize(o), deterministic=True)[0], 100, 10**7)
        return float(np.mean([episode.episode_return for episode in result.episodes]))

    show = table("settings", "frames/s", "ratio", "return", "by seed", first=32)
    trained(False, True, {}, 1, 0)  # what only the first training of a process takes time for is not measured
    base = None
    for name, (scalar, ours, given) in TRAININGS.items():
        rates, returns = [], []
        for seed in range(seeds):
            start = time.perf_counter()
            model, env = trained(scalar, ours, given, steps, 1000 * seed)
            rates.append(model.num_timesteps / (time.perf_counter() - start))
            returns.append(mean_return(model, env))
        rate = float(np.median(rates))
        base = base or rate
        by_seed = "  " + ", ".join(f"{value:.2f}" for value in returns)
        show(name, f"{rate:.0f}", f"{rate / base:.1f}", f"{np.mean(returns):.2f}", by_seed)


COMMANDS = (imports, first_shield, environments, networked, rendering, examples, ppo)

if __name__ == "__main__":
    run(__doc__, COMMANDS)
