"""Section 5 of Liu et al., simulated: printed design, certified design, and OP's at the nearest feasible bounds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gymnasium as gym
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from tqdm import tqdm

from experiments.paper.paper_example import PaperExample
from experiments.plots.figure_style import STYLE, CaptionedFigure, with_unit
from ncs_gym import BoxDisturbance, Ellipsoid, LinearPlant
from ncs_gym.registration import CASE_STUDY_BOX
from shields import paper, synthesize
from shields.paper.bounds import with_noise
from shields.paper.feasibility import FeasibilityScan, largest_scale

_ENV = "ncs_gym/TruckTrailer-v0"
# OP is solved at this fraction of the largest feasible scale of the bounds, on a fine grid of kappa and rho.
_OP_SCALE = 0.9
_OP_GRID_STEP = 0.01


@dataclass(frozen=True, eq=False)
class StateFeedback:
    """A design to simulate: u = K x_hat with the safe set E(L), on a plant with bounds.

    Attributes:
        name: Name of the design in the table and the figures.
        plant: The plant, with the bounds that are simulated.
        box: Distribution of the disturbance.
        L: Shape of the safe set, shape (2, 2).
        K: Feedback gain, shape (1, 2).
        epsilon: Claimed bound on e'e, e = B K e_up; None if the design claims none.
    """

    name: str
    plant: LinearPlant
    box: BoxDisturbance
    L: np.ndarray
    K: np.ndarray
    epsilon: float | None


@dataclass(frozen=True, eq=False)
class Simulation:
    """Simulated trajectories of a design.

    Attributes:
        design: The design.
        states: True states, shape (starts, steps + 1, 2).
        inputs: Inputs K x_hat before the limit, shape (starts, steps) [m/s^2].
        errors: Estimation errors e_up, shape (starts, steps, 2).
    """

    design: StateFeedback
    states: np.ndarray
    inputs: np.ndarray
    errors: np.ndarray

    @property
    def outcome(self) -> dict[str, float | None]:
        """Counts of steps and largest values, by name; e = B K e_up, and `epsilon` is the design's own claim."""
        design = self.design
        levels = np.einsum("ski,ij,skj->sk", self.states, np.linalg.inv(design.L), self.states)
        boxes = np.abs(self.states @ design.plant.box_rows.T).max(axis=2)
        gain = design.plant.B @ design.K
        return {
            "steps": self.inputs.size,
            "outside_set": int((levels[:, 1:] > 1.0).sum()),
            "outside_box": int((boxes[:, 1:] > 1.0).sum()),
            "input_asked_beyond": int((np.abs(self.inputs) > design.plant.u_max[0]).sum()),
            "largest_level": float(levels.max()),
            "largest_error": float(np.square(self.errors @ gain.T).sum(axis=2).max()),
            "largest_estimation_error": float(np.square(self.errors).sum(axis=2).max()),
            "largest_input": float(np.abs(self.inputs).max()),
            "epsilon": design.epsilon,
        }


def designs() -> list[StateFeedback]:
    """Returns the three designs: printed, certified, and OP's."""
    example = PaperExample()
    plant = example.plant
    ours = synthesize(plant, safe_set="ellipsoid")
    scale = _OP_SCALE * largest_scale(FeasibilityScan(plant), plant)
    Q, P0 = scale * plant.process_noise_cov, scale * plant.initial_cov
    scaled = with_noise(plant, gamma=scale * plant.gamma, Q=Q, P0=P0)
    op = paper.synthesize(scaled, dkappa=_OP_GRID_STEP, drho=_OP_GRID_STEP)
    box = BoxDisturbance((1.0 - 1e-9) * scale**0.5 * np.asarray(CASE_STUDY_BOX.half_widths))
    return [
        StateFeedback("printed", plant, CASE_STUDY_BOX, example.L, example.K, example.epsilon),
        StateFeedback("certified", plant, CASE_STUDY_BOX, ours.L, ours.K, None),
        StateFeedback(f"OP at {scale:.3f} of the bounds", scaled, box, op.L, op.K, op.epsilon),
    ]


def simulate(design: StateFeedback, starts: int, steps: int, seed: int, bar: tqdm) -> Simulation:
    """Returns the simulation of a design from random initial states."""
    env = gym.make(
        _ENV,
        plant=design.plant,
        disturbance=design.box,
        initial_set=Ellipsoid(design.L),
        max_episode_steps=steps,
    )
    limit = design.plant.u_max[0]
    states = np.empty((starts, steps + 1, 2))
    inputs = np.empty((starts, steps))
    errors = np.empty((starts, steps, 2))
    for start in range(starts):
        _, info = env.reset(seed=seed * 1_000_003 + start)
        states[start, 0] = info["state"]
        for step in range(steps):
            u = design.K @ info["estimate"]
            inputs[start, step], errors[start, step] = u[0], info["estimation_error"]
            *_, info = env.step(u / limit)
            states[start, step + 1] = info["state"]
        bar.update()
    return Simulation(design, states, inputs, errors)


_COLOR = "#1f6f8b"
# The transient is over after these steps; the other inputs are near zero.
_SHOWN_STEPS = 40


def reproduction_figures(simulations: Sequence[Simulation]) -> dict[str, tuple[str, bytes]]:
    """Returns caption (none) and PNG file of the states and of the inputs, by name."""
    figures = {"states": _panels(simulations, _draw_states), "inputs": _panels(simulations, _draw_inputs)}
    return {name: (figure.caption, figure.png) for name, figure in figures.items()}


def _panels(simulations: Sequence[Simulation], draw: Callable[[Axes, Simulation], None]) -> CaptionedFigure:
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure((12, 4.8))
        axes = figure.subplots(1, len(simulations), sharey=True)
        for axis, simulation in zip(axes, simulations, strict=True):
            draw(axis, simulation)
            axis.set_title(simulation.design.name, fontsize=10.5)
            if axis is not axes[0]:
                axis.set_ylabel("")
        handles, labels = axes[0].get_legend_handles_labels()
        legend = figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
        for handle in legend.get_lines():  # what is drawn thin and faint a hundred times is not seen once
            handle.set(lw=1.6, alpha=1.0)
        return figure


def _draw_states(axis: Axes, simulation: Simulation) -> None:
    design = simulation.design
    for i, path in enumerate(simulation.states):
        label = None if i else "true state"
        axis.plot(path[:, 0], path[:, 1], color=_COLOR, lw=0.6, alpha=0.5, label=label)
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    outline = np.linalg.cholesky(design.L) @ np.stack([np.cos(angle), np.sin(angle)])
    axis.plot(*outline, color="black", lw=1.4, label="safe set")
    (left, bottom), (right, top) = design.plant.own_limits
    box = [left, right, right, left, left], [bottom, bottom, top, top, bottom]
    axis.plot(*box, color="black", lw=1.0, ls="--", label="safe box")
    axis.set_xlabel("coupling stretch [m]")
    axis.set_ylabel("stretch rate [m/s]")
    axis.set_aspect("equal")


def _draw_inputs(axis: Axes, simulation: Simulation) -> None:
    """Draws the inputs asked for during the transient, the limits, and what was asked beyond them."""
    plant, shown = simulation.design.plant, simulation.inputs[:, :_SHOWN_STEPS]
    time, limit = plant.dt * np.arange(shown.shape[1]), plant.u_max[0]
    for i, path in enumerate(shown):
        axis.plot(time, path, color=_COLOR, lw=0.6, alpha=0.5, label=None if i else "K x_hat")
    for sign in (-1.0, 1.0):
        axis.axhline(sign * limit, color="black", ls="--", lw=1.0, label="input limit" if sign > 0 else None)
    starts, steps = np.nonzero(np.abs(shown) > limit)
    axis.plot(time[steps], shown[starts, steps], "x", color="#c8553d", ms=7, label="beyond the limit")
    axis.set_xlabel(f"time [s], first {_SHOWN_STEPS} steps")
    axis.set_ylabel(with_unit("input asked for", "m/s^2"))
