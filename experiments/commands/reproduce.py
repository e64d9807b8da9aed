"""Section 5 of Liu et al., simulated: printed design, certified design, and OP's at the nearest feasible bounds."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import gymnasium as gym
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tqdm import tqdm

from experiments.paper.paper_example import PrintedCase
from experiments.plots.figure_style import STYLE, as_png
from experiments.settings.certificates import ReproduceSettings
from ncs_gym import BoxDisturbance, Ellipsoid, LinearPlant
from ncs_gym.registration import CASE_STUDY_BOX
from shields import synthesize
from shields.atomic_write import write_atomically
from shields.paper.feasibility import FeasibilityScan, largest_scale

ENV = "ncs_gym/TruckTrailer-v0"
# OP's design is asked for at this share of the largest feasible scale, away from the very edge, on a fine grid.
OP_SHARE = 0.9
OP_STEP = 0.01
COLOR = "#1f6f8b"
# The transient is over by then; the rest of the inputs is near zero.
SHOWN_STEPS = 40


@dataclass(frozen=True, eq=False)
class StateFeedback:
    """A design to simulate: u = K x_hat with the safe set E(L), on a plant with bounds.

    Attributes:
        name: For table and figures.
        plant: Its bounds are those simulated.
        box: Disturbance.
        L: Shape of the safe set, (2, 2).
        K: Gain, (1, 2).
        epsilon: Claimed bound on e'e, e = B K e_up; None if the design claims none.
    """

    name: str
    plant: LinearPlant
    box: BoxDisturbance
    L: np.ndarray
    K: np.ndarray
    epsilon: float | None


@dataclass(frozen=True)
class Outcome:
    """What the simulation of a design showed.

    Attributes:
        steps: Simulated steps, all starts together.
        outside_set: Of these, with the true state outside the safe set.
        outside_box: With the true state outside the safe box.
        input_asked_beyond: With |K x_hat| beyond the input limit (the plant applied the limit).
        largest_level: Largest x'Mx.
        largest_error: Largest e'e, e = B K e_up.
        largest_estimation_error: Largest e_up'e_up.
        largest_input: Largest |K x_hat| asked for.
        epsilon: The bound on e'e that the design claims; None if it claims none.
    """

    steps: int
    outside_set: int
    outside_box: int
    input_asked_beyond: int
    largest_level: float
    largest_error: float
    largest_estimation_error: float
    largest_input: float
    epsilon: float | None


def reproduce(settings: ReproduceSettings) -> None:
    """Runs `ncs reproduce`.

    Raises:
        ValueError: If a setting is out of range.
        OSError: If the output folder cannot be written.
    """
    for name in ("starts", "steps"):
        if getattr(settings, name) < 1:
            raise ValueError(f"--{name} must be at least 1, got {getattr(settings, name)}")
    if settings.seed < 0:
        raise ValueError(f"--seed must be >= 0, got {settings.seed}")
    (settings.out / "figures").mkdir(parents=True, exist_ok=True)
    runs = {}
    with tqdm(total=3 * settings.starts, unit="start", mininterval=1.0) as bar:
        for design in designs():
            runs[design.name] = (design, *simulate(design, settings, bar))
    write_atomically(settings.out / "figures" / "states.png", as_png(_figure(runs, _draw_states)))
    write_atomically(settings.out / "figures" / "inputs.png", as_png(_figure(runs, _draw_inputs)))
    summary = {name: asdict(outcome) for name, (_, outcome, _, _) in runs.items()}
    write_atomically(settings.out / "summary.json", json.dumps(summary, indent=1) + "\n")
    print(outcome_text({name: outcome for name, (_, outcome, _, _) in runs.items()}))
    print(f"files: {settings.out}")


def designs() -> list[StateFeedback]:
    """Returns the three designs."""
    case = PrintedCase()
    plant = case.plant
    ours = synthesize(plant)
    scale = OP_SHARE * largest_scale(FeasibilityScan(plant), plant)
    scaled = replace(
        plant,
        gamma=scale * plant.gamma,
        process_noise_cov=scale * plant.process_noise_cov,
        initial_cov=scale * plant.initial_cov,
    )
    op = synthesize(scaled, "paper", dkappa=OP_STEP, drho=OP_STEP)
    box = BoxDisturbance((1.0 - 1e-9) * scale**0.5 * np.asarray(CASE_STUDY_BOX.half_widths))
    return [
        StateFeedback("printed", plant, CASE_STUDY_BOX, case.L, case.K, case.epsilon),
        StateFeedback("certified", plant, CASE_STUDY_BOX, ours.L, ours.K, None),
        StateFeedback(f"OP at {scale:.3f} of the bounds", scaled, box, op.L, op.K, op.epsilon),
    ]


def simulate(design: StateFeedback, settings: ReproduceSettings, bar: tqdm) -> tuple[Outcome, np.ndarray, np.ndarray]:
    """Returns the outcome, the true states (starts, steps + 1, 2) and the inputs asked for (starts, steps)."""
    env = gym.make(
        ENV,
        plant=design.plant,
        disturbance=design.box,
        initial_set=Ellipsoid(design.L),
        max_episode_steps=settings.steps,
    )
    limit = design.plant.u_max[0]
    states, inputs, errors = [], [], []
    for start in range(settings.starts):
        _, info = env.reset(seed=settings.seed * 1_000_003 + start)
        path, asked, off = [info["state"]], [], []
        for _ in range(settings.steps):
            u = design.K @ info["estimate"]
            off.append(info["estimation_error"])
            *_, info = env.step(u / limit)
            asked.append(u[0])
            path.append(info["state"])
        states.append(path)
        inputs.append(asked)
        errors.append(off)
        bar.update()
    return _outcome(design, np.array(states), np.array(inputs), np.array(errors))


def _outcome(design: StateFeedback, states: np.ndarray, inputs: np.ndarray, errors: np.ndarray):
    M, limit = np.linalg.inv(design.L), design.plant.u_max[0]
    levels = np.einsum("ski,ij,skj->sk", states, M, states)
    boxes = np.abs(states @ design.plant.C.T).max(axis=2)
    gain = design.plant.B @ design.K
    outcome = Outcome(
        steps=inputs.size,
        outside_set=int((levels[:, 1:] > 1.0).sum()),
        outside_box=int((boxes[:, 1:] > 1.0).sum()),
        input_asked_beyond=int((np.abs(inputs) > limit).sum()),
        largest_level=float(levels.max()),
        largest_error=float(np.square(errors @ gain.T).sum(axis=2).max()),
        largest_estimation_error=float(np.square(errors).sum(axis=2).max()),
        largest_input=float(np.abs(inputs).max()),
        epsilon=design.epsilon,
    )
    return outcome, states, inputs


def outcome_text(outcomes: dict[str, Outcome]) -> str:
    """Returns the table for a terminal, a column per design."""
    rows = [
        ("steps outside the safe set", lambda o: f"{o.outside_set:,} of {o.steps:,}"),
        ("steps outside the safe box", lambda o: f"{o.outside_box:,} of {o.steps:,}"),
        ("inputs asked beyond the limit", lambda o: f"{o.input_asked_beyond:,} of {o.steps:,}"),
        ("largest x'Mx", lambda o: f"{o.largest_level:.4f}"),
        ("largest |K x_hat| [m/s^2]", lambda o: f"{o.largest_input:.3f}"),
        ("largest e'e", lambda o: f"{o.largest_error:.5f}"),
        ("claimed epsilon", lambda o: "-" if o.epsilon is None else f"{o.epsilon:.5f}"),
        ("largest e_up'e_up", lambda o: f"{o.largest_estimation_error:.5f}"),
    ]
    cells = [["", *outcomes]] + [[name, *map(show, outcomes.values())] for name, show in rows]
    widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))]
    lines = [
        "  ".join([row[0].ljust(widths[0])] + [cell.rjust(w) for cell, w in zip(row[1:], widths[1:], strict=True)])
        for row in cells
    ]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]])


def _figure(runs: dict, draw: Callable[[Axes, StateFeedback, np.ndarray, np.ndarray], None]) -> Figure:
    """Returns one panel per design, with one legend below."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(12, 4.6), layout="constrained")
        axes = figure.subplots(1, len(runs), sharey=True)
        for axis, (name, (design, _, states, inputs)) in zip(axes, runs.items(), strict=True):
            draw(axis, design, states, inputs)
            axis.set_title(name, fontsize=10.5)
            if axis is not axes[0]:
                axis.set_ylabel("")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
        return figure


def _draw_states(axis: Axes, design: StateFeedback, states: np.ndarray, inputs: np.ndarray) -> None:
    """Draws the trajectories, the ellipse and the box."""
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    for i, path in enumerate(states):
        label = None if i else "true state"
        axis.plot(path[:, 0], path[:, 1], color=COLOR, lw=0.6, alpha=0.5, label=label)
    axis.plot(*(np.linalg.cholesky(design.L) @ circle), color="black", lw=1.4, label="safe set")
    corners = np.linalg.solve(design.plant.C, np.array([[1, 1, -1, -1, 1], [1, -1, -1, 1, 1]], dtype=float))
    axis.plot(*corners, color="black", lw=1.0, ls="--", label="safe box")
    axis.set_xlabel("coupling stretch [m]")
    axis.set_ylabel("stretch rate [m/s]")
    axis.set_aspect("equal")


def _draw_inputs(axis: Axes, design: StateFeedback, states: np.ndarray, inputs: np.ndarray) -> None:
    """Draws the inputs asked for during the transient, the limits, and what was asked beyond them."""
    shown = inputs[:, :SHOWN_STEPS]
    time = design.plant.dt * np.arange(shown.shape[1])
    limit = design.plant.u_max[0]
    for i, path in enumerate(shown):
        axis.plot(time, path, color=COLOR, lw=0.6, alpha=0.5, label=None if i else "K x_hat")
    for sign in (-1.0, 1.0):
        axis.axhline(sign * limit, color="black", ls="--", lw=1.0, label="input limit" if sign > 0 else None)
    starts, steps = np.nonzero(np.abs(shown) > limit)
    axis.plot(time[steps], shown[starts, steps], "x", color="#c8553d", ms=7, label="beyond the limit")
    axis.set_xlabel(f"time [s], first {SHOWN_STEPS} steps")
    axis.set_ylabel("input asked for [m/s^2]")
