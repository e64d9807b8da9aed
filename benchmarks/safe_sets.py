"""How large safe sets are, and what a larger one gives: `python -m benchmarks.safe_sets COMMAND`.

Commands: sections, between-samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib
import numpy as np
from scipy import sparse
from scipy.optimize import linprog

from benchmarks.commands import run, table
from benchmarks.timing import least_times, timed
from experiments.baselines.controllers import controller
from experiments.figures import STYLE, CaptionedFigure, label, legend_below
from ncs_gym import LinearPlant, NCSEnv
from ncs_gym.envs.env import ncs_env
from shields import Certificate, Infeasible, SafetyFilter, VectorSafetyShield, synthesize

IDS = ("TruckTrailerCruise", "CartPole", "BatchReactor", "Pendulum")
# The two states that are shown where there are more: angle and rate of the pole; the reactor's first and third.
PLANES = {"CartPole": (2, 3), "BatchReactor": (0, 2)}
# Sets, and their colors, apart for color-blind readers (Okabe and Ito).
COLORS = {"upper bound": "#999999", "polytope": "#0072b2", "ellipsoid": "#d55e00"}
# Points between two samples at which the box counts, where it does.
POINTS: dict[str, int] = {
    **dict.fromkeys(("TruckTrailer", "TruckTrailerCruise", "TruckTrailerCruiseTwoWay"), 8),
    **dict.fromkeys(("CartPole", "CartPoleTwoWay", "BatchReactor", "CSTR", "Convoy", "LaneKeeping"), 4),
}


def _env(name: str) -> NCSEnv:
    return ncs_env(gym.make(f"ncs_gym/{name}-v0"))


class Viability:
    """Which states some inputs within the limits keep in the box for so many steps, without disturbance."""

    def __init__(self, plant: LinearPlant, steps: int = 100) -> None:
        n, m = plant.n, plant.m
        scale, limits = plant.half_widths, plant.largest_input
        A, B = plant.A * scale / scale[:, None], plant.B * limits / scale[:, None]
        # Variables: the size t of the start, states x_0 .. x_N and inputs u_0 .. u_{N-1}, in units of their limits.
        columns, faces = 1 + (steps + 1) * n + steps * m, (steps + 1) * len(plant.box)
        moved = sparse.kron(sparse.eye(steps, steps + 1), A) - sparse.kron(sparse.eye(steps, steps + 1, 1), np.eye(n))
        moves = [sparse.csr_matrix((steps * n, 1)), moved, sparse.kron(sparse.eye(steps), B)]
        rows = sparse.kron(sparse.eye(steps + 1), plant.box * scale)
        rows = sparse.hstack([sparse.csr_matrix((faces, 1)), rows, sparse.csr_matrix((faces, steps * m))])
        self._moves, self._scale, self._start = sparse.hstack(moves), scale, sparse.lil_matrix((n, columns))
        bounds = [(0.0, None)] + [(None, None)] * ((steps + 1) * n) + [(-1.0, 1.0)] * (steps * m)
        self._problem: dict[str, Any] = {"c": -np.eye(1, columns)[0], "bounds": bounds}
        self._problem |= {"A_ub": sparse.vstack([rows, -rows]).tocsr(), "b_ub": np.ones(2 * faces)}
        self._problem |= {"b_eq": np.zeros((steps + 1) * n)}

    def reach(self, direction: np.ndarray) -> float:
        """Returns the largest t such that the state t direction, shape (n,), can be kept in the box."""
        start, n = self._start.copy(), len(direction)
        start[:, 0], start[:, 1 : n + 1] = -(direction / self._scale)[:, None], np.eye(n)
        equal = sparse.vstack([start.tocsr(), self._moves])
        for method in ("highs-ds", "highs-ipm"):  # either gives up now and then, on different problems
            found = linprog(**self._problem, A_eq=equal, method=method)
            if found.status == 0:
                return float(found.x[0])
        raise RuntimeError("the solver does not say how far a direction reaches")


def sections(out: Path = Path("safe-sets.png"), ids: Sequence[str] = IDS) -> None:
    """Draws sections through the origin of ellipsoid, polytope and what no controller can exceed.

    States that are not on an axis are zero. The upper bound are states from which some inputs within the limits keep
    the plant in the box for 100 steps if the state is known and nothing disturbs it.
    """
    angles = np.linspace(0.0, np.pi, 120, endpoint=False)  # the corners of the box among them
    with matplotlib.rc_context(STYLE):
        figure, handles = CaptionedFigure((3.1 * len(ids), 3.3)), {}
        panels = np.atleast_1d(figure.subplots(1, len(ids)))
        for axes, name in zip(panels, ids, strict=True):
            env = _env(name)
            plant, plane = env.plant, PLANES.get(name, (0, 1))
            reaches: dict[str, Callable[[np.ndarray], float]] = {"upper bound": Viability(plant).reach}
            for kind in ("ellipsoid", "polytope"):
                kept = synthesize(plant, contract=env.certificate_contract, safe_set=kind).safe_set
                reaches[kind] = lambda v, kept=kept: 1.0 / kept.gauge(v)
            directions = np.zeros((len(angles), plant.n))
            directions[:, plane] = np.column_stack([np.cos(angles), np.sin(angles)]) * plant.half_widths[list(plane)]
            for kind, reach in reaches.items():
                half = directions[:, plane] * np.array([reach(v) for v in directions])[:, None]
                outline = np.concatenate([half, -half, half[:1]]).T
                if kind != "ellipsoid":
                    axes.fill(*outline, color=COLORS[kind], alpha=0.25, lw=0)
                (handles[kind],) = axes.plot(*outline, color=COLORS[kind], lw=1.5)
            box = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * plant.half_widths[list(plane)]
            (handles["safe box"],) = axes.plot(*box.T, color="#222222", lw=1.0, ls="--")
            x, y = (f"{plant.state_names[k]} [{plant.state_units[k]}]" for k in plane)
            label(axes, x, y, name)
        legend_below(figure, handles)
        out.write_bytes(figure.png)


def between_samples(ids: Sequence[str] = tuple(POINTS), points: int = 0, steps: int = 8000) -> None:
    """What it costs that the box counts between samples, too, for environments with a model in continuous time.

    Each id has two lines: at sampling instants alone, and at all times. "share" is that of the safe box's volume which
    the polytope P fills, "rows" are those of P, "s" is the time of search and proof, "bears" how
    much larger all disturbances and errors could be for some set ("tolerated_scale"). "overridden" and "reward"
    (per step) are those of an LQR behind the shield with P in mode "project", in the same episodes. "left" is the
    largest |c x| between two samples inside the box, without a shield, under random inputs of full size. "decision",
    "step" and "x 64" (steps of 64 environments) are times, least of many in turns, next to those of the first line.
    Where nothing certifies, the line says why.
    """
    columns = ("N", "share", "rows", "s", "bears", "overridden", "reward", "left", "decision", "step", "x 64")
    show = table("id", *columns, first=26, width=7)
    for name in ids:
        env = _env(name)
        limits = replace(env.plant.limits, between_samples=points or POINTS.get(name, 8))
        plants = [env.plant, replace(env.plant, limits=limits)]
        found: list[tuple[Certificate, float]] = []
        for plant in plants:
            try:
                found.append(timed(synthesize, plant, contract=env.certificate_contract))
            except Infeasible as none:
                print(f"{name:<26}{plant.between_samples or 1:>3} {none}", flush=True)
                break
        if len(found) < len(plants):
            continue
        inside = found[1][0]
        works = [[_deciding(SafetyFilter(each, p), inside, 64) for p, (each, _) in zip(plants, found, strict=True)]]
        works += [[_stepping(name, plant, number) for plant in plants] for number in (1, 64)]
        times = np.array([least_times(pair, blocks=200, repeats=10) for pair in works])
        for k, (plant, (certificate, seconds)) in enumerate(zip(plants, found, strict=True)):
            recorded, rows = certificate.provenance, getattr(certificate.safe_set, "rows", ())
            overridden, reward = _behind(name, certificate, steps, plant=plant)
            cells = [f"{recorded['share_of_box']:.1%}", len(rows), f"{seconds:.1f}"]
            cells += [f"{recorded['tolerated_scale']:.2f}", f"{overridden:.1%}", f"{reward:.4f}"]
            cells += [f"{_left(name, plant, steps):.3f}", *(f"{ratio:.2f}" for ratio in times[:, k] / times[:, 0])]
            show(name, plant.between_samples or 1, *cells)


def _left(name: str, plant: LinearPlant, steps: int) -> float:
    """Returns the largest |c x| between two samples inside the box, under random inputs of full size."""
    settings: dict[str, Any] = {"plant": plant, "terminate_on_violation": True, "max_episode_steps": 200}
    envs, most = gym.make_vec(f"ncs_gym/{name}-v0", num_envs=100, **settings), 0.0
    rng, u = np.random.default_rng(0), np.ones((100, plant.m))
    _, info = envs.reset(seed=0)
    for _ in range(steps // 100):
        before, u = info["constraint_values"], np.where(rng.random(u.shape) < 0.2, -u, u)
        *_, info = envs.step(u.astype(np.float32))
        inside = np.maximum(before, info["constraint_values"]).max(axis=1) <= 0.0
        most = max(
            most, 1.0 + float(info.get("worst_constraint_values", info["constraint_values"])[inside].max(initial=-1.0))
        )
    return most


def _deciding(shield: SafetyFilter, inside: Certificate, count: int) -> Callable[[], object]:
    """Returns decisions about estimates in the safe set of a certificate, and random inputs."""
    rng, plant = np.random.default_rng(0), shield.plant
    estimates = (inside.safe_set.sample_boundary(rng, count) * rng.uniform(0.2, 0.9, (count, 1))).T.copy()
    proposals = rng.uniform(-1.0, 1.0, (plant.m, count)) * plant.largest_input[:, None]
    errors = shield.errors_of(0.5 * shield.certificate.error_shapes[0])
    if count == 1:
        return lambda: shield.decide(estimates[:, 0], errors, proposals[:, 0])
    batch = errors.batch().of(np.zeros(count, np.int64))
    return lambda: shield.decide_columns(estimates, batch, proposals)


def _behind(name: str, certificate: Certificate, steps: int, **settings: Any) -> tuple[float, float]:
    """Returns the share of overridden steps and the reward per step of an LQR behind a shield in mode "project"."""
    envs = VectorSafetyShield(gym.make_vec(f"ncs_gym/{name}-v0", num_envs=20, **settings), certificate)
    policy = controller("lqr", _env(name), certificate.fallback, 0)
    observations, info = envs.reset(seed=0)
    sums = np.zeros(2)
    for _ in range(steps // 20):
        observations, reward, *_, info = envs.step(policy(observations, info).astype(np.float32))
        sums += info["shield_intervened"].sum(), reward.sum()
    overridden, total = sums / (steps // 20 * 20)
    return overridden, total


def _stepping(name: str, plant: LinearPlant, number: int) -> Callable[[], object]:
    """Returns a step of an environment, or of many."""
    settings = {"plant": plant, "terminate_on_violation": False}
    path = f"ncs_gym/{name}-v0"
    env = gym.make(path, **settings).unwrapped if number == 1 else gym.make_vec(path, num_envs=number, **settings)
    action = 0.0 * env.action_space.sample()
    env.reset(seed=0)
    for _ in range(300):  # patterns of arrivals are worked out when they occur first
        env.step(action)
    return lambda: env.step(action)


COMMANDS = (sections, between_samples)

if __name__ == "__main__":
    run(__doc__, COMMANDS)
