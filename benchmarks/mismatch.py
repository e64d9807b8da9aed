"""Where the proof ends and violations begin when the process has another mass than the model.

For every mass: the largest step outside the model in units of its bound over box x limits (the proof holds up to 1),
then shielded episodes with worst-case packets, sensor noise, starts and hostile agents. The table says how many
episodes left the safe set or the box, in how many the estimator's own monitor of innovations raised an alarm (it sees
packets only), in how many of those that left the box it did so before or at that step, and in how many the simulation,
which sees the true state, saw a step outside the model.

    python benchmarks/mismatch.py                                  # the pendulum, half a minute
    python benchmarks/mismatch.py --env ncs_gym/CartPoleNonlinear-v0 --field pole_mass --values 0.1 0.2 0.5 1 2

Takes about 30 seconds on one core.
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium as gym
import numpy as np

from experiments.attack.worst_case import HostileAgents, WorstCaseVectorEnv
from ncs_gym.envs.env import ncs_env
from ncs_gym.registration import EPISODE_STEPS
from shields import VectorSafetyShield, certificate_for

SAMPLES = 4_000
MASSES = (0.5, 0.8, 0.9, 0.95, 0.99, 1.0, 1.01, 1.05, 1.1, 1.2, 1.5, 2.0)


def largest_step_outside(plant: Any, process: Any, rng: np.random.Generator) -> float:
    """Largest gauge of x+ - A x - B u in E(D) over samples of box x limits, corners among them."""
    moving = process.opened(plant, None)
    widths = np.concatenate([plant.half_widths, plant.u_max])
    largest = 0.0
    for number in range(SAMPLES):
        point = widths * rng.uniform(-1.0, 1.0, len(widths))
        point = widths * np.sign(point) if number % 2 else point
        x, u = point[: plant.n], point[plant.n :]
        if moving.terminated or moving.truncated:
            moving.start(rng, x, None)
        x_next = moving.step(plant, moving.write(x), u)
        largest = max(largest, plant.disturbance.gauge(x_next - plant.A @ x - plant.B @ u))
    moving.close()
    return largest


def attacked(env: Any, process: Any, certificate: Any, episodes: int, seed: int) -> dict[str, np.ndarray]:
    """First steps, one per episode, of leaving S or the box and of both alarms; inf for never."""
    settings = {"plant": env.plant, "channel": env.channel, "contract": env.contract, "process": process}
    many = WorstCaseVectorEnv(episodes, certificate, **settings)
    shield, rng = VectorSafetyShield(many, certificate, on_unproved="ignore"), np.random.default_rng(seed)
    _, info = shield.reset(seed=seed)
    agents = HostileAgents(episodes, env.plant, certificate, rng)
    root = np.linalg.inv(np.linalg.cholesky(certificate.L))
    first = {name: np.full(episodes, np.inf) for name in ("set", "box", "alarm", "simulation")}
    for step in range(1, EPISODE_STEPS + 1):
        *_, info = shield.step(agents.act(info["estimate"]))
        now = {
            "set": ~(np.square(root @ info["state"].T).sum(axis=0) <= 1.0),
            "box": info["cost"] > 0.0,
            "alarm": many._estimator.alarm,
            "simulation": many._process.alarm,
        }
        for name, seen in now.items():
            first[name] = np.where(seen, np.minimum(first[name], step), first[name])
    shield.close()
    return first


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="ncs_gym/Pendulum-v0")
    parser.add_argument("--field", default="mass", help="field of the environment's process that is changed")
    parser.add_argument("--values", type=float, nargs="+", default=MASSES)
    parser.add_argument("--episodes", type=int, default=32)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    env = ncs_env(gym.make(options.env))
    certificate = certificate_for(env.plant, env.certificate_contract)
    print(f"{options.env}, {options.episodes} shielded episodes of {EPISODE_STEPS} steps for each {options.field}\n")
    columns = (options.field, "outside the model", "left S", "left box", "alarm", "before box", "simulation's alarm")
    print("  ".join(columns))
    for value in options.values:
        process = ncs_env(gym.make(options.env, process={options.field: value})).process
        outside = largest_step_outside(env.plant, process, np.random.default_rng(options.seed))
        first = attacked(env, process, certificate, options.episodes, options.seed)
        left, warned = np.isfinite(first["box"]), first["alarm"] <= first["box"]
        counts = {name: int(np.isfinite(steps).sum()) for name, steps in first.items()}
        before = f"{int((warned & left).sum())}/{int(left.sum())}" if left.any() else "-"
        numbers = (f"{value:g}", f"{outside:.2f}", *(counts[name] for name in ("set", "box", "alarm")), before)
        cells = zip(columns, (*numbers, counts["simulation"]), strict=True)
        print("  ".join(f"{cell!s:>{len(column)}}" for column, cell in cells), flush=True)


if __name__ == "__main__":
    main()
