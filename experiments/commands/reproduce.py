"""`ncs reproduce`: simulates Section 5 of Liu et al. with the printed design, a certified one, and OP's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import matplotlib
import numpy as np

from experiments.paper.paper_example import PaperExample
from experiments.plots.figure_style import STYLE, CaptionedFigure
from experiments.runs.output_folder import claim_folder, write_results
from experiments.settings import require_limits
from experiments.terminal import text_table
from ncs_gym import BoxDisturbance, Ellipsoid, LinearPlant
from ncs_gym.registration import CASE_STUDY_BOX
from shields import paper, synthesize
from shields.paper.bounds import with_noise
from shields.paper.feasibility import FeasibilityScan, largest_scale


@dataclass(frozen=True, kw_only=True)
class ReproduceSettings:
    """Simulates Section 5 of Liu et al. with three designs: printed, certified, and OP's.

    OP's is at the nearest feasible bounds. Random initial states in each safe set meet all four network impairments.
    Prints a table and leaves a figure and summary.json.

    Attributes:
        out: Output folder.
        starts: Number of random initial states per design.
        steps: Steps of each simulation.
        force: Replace finished results of other settings in the output folder, which otherwise is refused.
        seed: Seed of initial states, disturbances and channel, the same for all designs.
    """

    out: Path = Path("runs/reproduce")
    starts: int = 100
    steps: int = 200
    force: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        require_limits(self, starts=1, steps=1, seed=0)


# OP is solved at this fraction of the largest feasible scale of the bounds, on a fine grid of kappa and rho.
_OP_SCALE, _OP_GRID_STEP = 0.9, 0.01
# Rows of the table.
_ROWS = (
    ("steps outside the safe set", "{outside_set:,} of {steps:,}"),
    ("steps outside the safe box", "{outside_box:,} of {steps:,}"),
    ("inputs asked beyond the limit", "{input_asked_beyond:,} of {steps:,}"),
    ("largest x'Mx", "{largest_level:.4f}"),
    ("largest |K x_hat| [m/s^2]", "{largest_input:.3f}"),
    ("largest e_up'e_up", "{largest_estimation_error:.5f}"),
    ("largest e'e", "{largest_error:.5f}"),
)


class StateFeedback(NamedTuple):
    """A design to simulate: its name, a plant with bounds and the distribution of disturbances, set, gain, claim."""

    name: str
    plant: LinearPlant
    box: BoxDisturbance
    L: np.ndarray  # shape of the safe set, (2, 2)
    K: np.ndarray  # gain of u = K x_hat, (1, 2)
    epsilon: float | None  # claimed bound on e'e, e = B K e_up


def reproduce(settings: ReproduceSettings) -> None:
    """Runs `ncs reproduce`."""
    claim_folder("reproduce", settings)
    outcomes, paths = {}, []
    for design in (chosen := designs()):
        states, inputs, errors = simulated(design, settings)
        outcomes[design.name] = outcome(design, states, inputs, errors)
        paths.append(states)
    figure = states_figure(chosen, paths)
    write_results(settings.out, outcomes, figures={"states": (figure.caption, figure.png)})
    cells = [[name, *(text.format(**each) for each in outcomes.values())] for name, text in _ROWS]
    claims = ["claimed epsilon", *("-" if each.epsilon is None else f"{each.epsilon:.5f}" for each in chosen)]
    print(text_table([["", *outcomes], *cells, claims]))
    print(f"files: {settings.out}")


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


def simulated(design: StateFeedback, settings: ReproduceSettings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns true states (steps + 1, starts, 2), inputs K x_hat and estimation errors, (steps, starts, 1 or 2)."""
    envs = gym.make_vec(
        "ncs_gym/TruckTrailer-v0",
        num_envs=settings.starts,
        plant=design.plant,
        disturbance=design.box,
        initial_set=Ellipsoid(design.L),
        max_episode_steps=settings.steps + 1,
    )
    _, info = envs.reset(seed=settings.seed)
    states, inputs, errors = [info["state"]], [], []
    for _ in range(settings.steps):
        inputs.append(info["estimate"] @ design.K.T)  # before the limit [m/s^2]
        errors.append(info["estimation_error"])
        *_, info = envs.step(inputs[-1] / design.plant.u_max)
        states.append(info["state"])
    return np.array(states), np.array(inputs), np.array(errors)


def outcome(
    design: StateFeedback, states: np.ndarray, inputs: np.ndarray, errors: np.ndarray
) -> dict[str, float | None]:
    """Returns counts of steps and largest values, by name; e = B K e_up, and `epsilon` is the design's own claim."""
    levels = np.einsum("ksi,ij,ksj->ks", states, np.linalg.inv(design.L), states)
    boxes = np.abs(states @ design.plant.box_rows.T).max(axis=2)
    gain = design.plant.B @ design.K
    return {
        "steps": inputs.size,
        "outside_set": int((levels[1:] > 1.0).sum()),
        "outside_box": int((boxes[1:] > 1.0).sum()),
        "input_asked_beyond": int((np.abs(inputs) > design.plant.u_max).sum()),
        "largest_level": float(levels.max()),
        "largest_error": float(np.square(errors @ gain.T).sum(axis=2).max()),
        "largest_estimation_error": float(np.square(errors).sum(axis=2).max()),
        "largest_input": float(np.abs(inputs).max()),
        "epsilon": design.epsilon,
    }


def states_figure(chosen: Sequence[StateFeedback], paths: Sequence[np.ndarray]) -> CaptionedFigure:
    """Returns the true states of every design (Figure 3 of the paper) with its safe set and the safe box."""
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure((12, 4.8))
        axes = figure.subplots(1, len(chosen), sharey=True)
        for axis, design, states in zip(axes, chosen, paths, strict=True):
            drawn = axis.plot(states[..., 0], states[..., 1], color="#1f6f8b", lw=0.6, alpha=0.5)
            drawn[0].set_label("true state")
            axis.plot(*np.linalg.cholesky(design.L) @ [np.cos(angle), np.sin(angle)], "k", lw=1.4, label="safe set")
            (left, bottom), (right, top) = design.plant.own_limits
            box = [left, right, right, left, left], [bottom, bottom, top, top, bottom]
            axis.plot(*box, "k--", lw=1.0, label="safe box")
            axis.set_title(design.name)
            axis.set_xlabel("coupling stretch [m]")
            axis.set_aspect("equal")
        axes[0].set_ylabel("stretch rate [m/s]")
        legend = figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        for handle in legend.get_lines():  # what is drawn thin and faint a hundred times is not seen once
            handle.set(lw=1.6, alpha=1.0)
        return figure
