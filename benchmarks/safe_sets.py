"""How much of its box each safe set fills, next to what no controller can exceed; a picture of the sets.

    python benchmarks/safe_sets.py [--ids CartPole BatchReactor] [--points 512] [--picture docs/images/safe-sets.png]

"bound" is the share of states from which some inputs within the limits keep the plant in the box for `STEPS` steps if
the state is known and nothing disturbs it: a linear program for each of `--points` states spread over the box. The
picture shows sections through the origin: states that are not on an axis are zero.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import matplotlib
import numpy as np
from scipy import sparse
from scipy.optimize import linprog
from scipy.stats import qmc

import ncs_gym  # noqa: F401  (registers the environments)
from experiments.plots.figure_style import STYLE, CaptionedFigure, label, legend_below, with_unit
from ncs_gym import LinearPlant
from shields import Certificate, synthesize

IDS = ("TruckTrailerCruise", "CartPole", "BatchReactor", "Pendulum")
# The two states that are shown where there are more: angle and rate of the pole; the reactor's first and third.
PLANES = {"CartPole": (2, 3), "BatchReactor": (0, 2)}
STEPS = 100
# Sets, and their colors, apart for color-blind readers (Okabe and Ito).
COLORS = {"upper bound": "#999999", "polytope": "#0072b2", "ellipsoid": "#d55e00"}


class Viability:
    """Which states some inputs within the limits keep in the box for `STEPS` steps, without disturbance."""

    def __init__(self, plant: LinearPlant) -> None:
        n, m = plant.n, plant.m
        scale, limits = plant.half_widths, plant.u_max
        A, B = plant.A * scale / scale[:, None], plant.B * limits / scale[:, None]
        # Variables: the size t of the start, states x_0 .. x_N and inputs u_0 .. u_{N-1}, in units of their limits.
        moves = sparse.hstack([
            sparse.kron(sparse.eye(STEPS, STEPS + 1), A) - sparse.kron(sparse.eye(STEPS, STEPS + 1, 1), np.eye(n)),
            sparse.kron(sparse.eye(STEPS), B),
        ])  # fmt: skip
        self._moves = sparse.hstack([sparse.csr_matrix((moves.shape[0], 1)), moves])
        rows = sparse.kron(sparse.eye(STEPS + 1), plant.box_rows * scale)
        rows = sparse.hstack(
            [sparse.csr_matrix((rows.shape[0], 1)), rows, sparse.csr_matrix((rows.shape[0], STEPS * m))]
        )
        self._box = sparse.vstack([rows, -rows]).tocsr()
        self._scale, self._n = scale, n
        self._bounds = [(0.0, None)] + [(None, None)] * ((STEPS + 1) * n) + [(-1.0, 1.0)] * (STEPS * m)

    def reach(self, direction: np.ndarray) -> float:
        """Returns the largest t such that the state t direction, shape (n,), can be kept in the box."""
        start = sparse.lil_matrix((self._n, self._moves.shape[1]))
        start[:, 0], start[:, 1 : self._n + 1] = -(direction / self._scale)[:, None], np.eye(self._n)
        equal = sparse.vstack([start.tocsr(), self._moves])
        cost = np.zeros(equal.shape[1])
        cost[0] = -1.0
        problem = {"A_ub": self._box, "b_ub": np.ones(self._box.shape[0]), "bounds": self._bounds}
        problem |= {"A_eq": equal, "b_eq": np.zeros(equal.shape[0])}
        for method in ("highs-ds", "highs-ipm"):  # either gives up now and then, on different problems
            found = linprog(cost, **problem, method=method)
            if found.status == 0:
                return float(found.x[0])
        raise RuntimeError(f"the solver does not say how far a direction reaches: {found.message}")


def reaches(certificate: Certificate, viability: Viability) -> dict[str, Callable[[np.ndarray], float]]:
    """Returns for each set the largest t such that t times a direction lies in it."""
    sets = {"upper bound": viability.reach, "ellipsoid": lambda v: 1.0 / certificate.ellipsoid.gauge(v)}
    return sets if certificate.polytope is None else sets | {"polytope": lambda v: 1.0 / certificate.polytope.gauge(v)}


def row(name: str, certificate: Certificate, viability: Viability, plant: LinearPlant, points: int) -> str:
    shares = [certificate.provenance.get(each) for each in ("share_of_box", "polytope_share_of_box")]
    drawn = (2.0 * qmc.Sobol(plant.n, seed=0).random(points) - 1.0) * plant.half_widths
    bound = np.mean([viability.reach(point) >= 1.0 for point in drawn])
    texts = [f"{share:9.1%}" if share is not None else f"{'-':>9s}" for share in shares]
    return f"{name:20}{texts[0]}{texts[1]}{bound:9.1%}"


def picture(cases: dict[str, tuple[LinearPlant, Certificate, Viability]]) -> CaptionedFigure:
    """Sections of the sets, a panel for each environment."""
    angles = np.linspace(0.0, np.pi, 120, endpoint=False)  # the corners of the box among them
    with matplotlib.rc_context(STYLE):
        figure, handles = CaptionedFigure((3.1 * len(cases), 3.3)), {}
        panels = np.atleast_1d(figure.subplots(1, len(cases)))
        for axes, (name, (plant, certificate, viability)) in zip(panels, cases.items(), strict=True):
            plane = PLANES.get(name, (0, 1))
            directions = np.zeros((len(angles), plant.n))
            directions[:, plane] = np.column_stack([np.cos(angles), np.sin(angles)]) * plant.half_widths[list(plane)]
            for each, reach in reaches(certificate, viability).items():
                half = directions[:, plane] * np.array([reach(v) for v in directions])[:, None]
                outline = np.concatenate([half, -half, half[:1]]).T
                if each != "ellipsoid":
                    axes.fill(*outline, color=COLORS[each], alpha=0.25, lw=0)
                (handles[each],) = axes.plot(*outline, color=COLORS[each], lw=1.5)
            box = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * plant.half_widths[list(plane)]
            (handles["safe box"],) = axes.plot(*box.T, color="#222222", lw=1.0, ls="--")
            names = [with_unit(plant.state_names[k], plant.state_units[k]) for k in plane]
            label(axes, *names, name)
        legend_below(figure, handles)
        return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ids", nargs="*", default=IDS)
    parser.add_argument("--points", type=int, default=512)
    parser.add_argument("--picture", type=Path, default=None, help="PNG file")
    options = parser.parse_args()
    cases = {}
    print("share of the box    ellipsoid polytope    bound")
    for name in options.ids:
        env = gym.make(f"ncs_gym/{name}-v0").unwrapped
        certificate = synthesize(env.plant, contract=env.certificate_contract)
        cases[name] = env.plant, certificate, Viability(env.plant)
        if options.points:
            print(row(name, certificate, cases[name][2], env.plant, options.points), flush=True)
    if options.picture is not None:
        options.picture.write_bytes(picture(cases).png)


if __name__ == "__main__":
    main()
