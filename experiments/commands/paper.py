"""`ncs paper`: checks the claims of Liu et al., or simulates their Section 5; docs/paper.md discusses both."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import matplotlib
import numpy as np

from experiments.figures import STYLE, CaptionedFigure
from experiments.paper.audit import Claim, Verdict, audited_claims, defects
from experiments.paper.paper_example import PaperExample
from experiments.runs.output_folder import claim_folder, write_json, write_results
from experiments.settings import require_limits
from experiments.terminal import text_table, wrapped
from ncs_gym import BoxDisturbance, Ellipsoid, LinearPlant
from ncs_gym.registration import CASE_STUDY_BOX
from shields import paper as published
from shields import synthesize
from shields.paper.bounds import with_noise
from shields.paper.feasibility import FeasibilityScan, largest_scale


@dataclass(frozen=True, kw_only=True)
class PaperSettings:
    """Checks the claims of the paper (Liu et al.) from its own printed numbers, or simulates its Section 5.

    Simulated are the printed design, a certified one, and that of the problem OP at the nearest feasible bounds, from
    random states in each safe set, under all four network impairments.

    Attributes:
        simulate: Simulate in place of checking claims.
        starts: Initial states per design.
        steps: Steps of each simulation.
        seed: Seed of initial states, disturbances and channel, the same for all designs.
        out: Output folder for claims.json, or for summary.json and a figure of the simulation.
        force: Replace results of other settings in the output folder.
    """

    simulate: bool = False
    starts: int = 100
    steps: int = 200
    seed: int = 0
    out: Path | None = None
    force: bool = False

    def __post_init__(self) -> None:
        require_limits(self, starts=1, steps=1, seed=0)


def paper(settings: PaperSettings) -> None:
    """Runs `ncs paper`."""
    if settings.out is not None:
        claim_folder("paper", settings)
    if not settings.simulate:
        claims = list(audited_claims(PaperExample()))
        print(text_of(claims))
        if settings.out is not None:
            write_json(settings.out / "claims.json", [asdict(claim) for claim in claims])
        return
    chosen = designs()
    played = [simulated(design, settings) for design in chosen]
    outcomes = {design.name: outcome(design, *found) for design, found in zip(chosen, played, strict=True)}
    cells = [[name, *(text.format(**each) for each in outcomes.values())] for name, text in _ROWS]
    claimed = ["claimed epsilon", *("-" if each.epsilon is None else f"{each.epsilon:.5f}" for each in chosen)]
    print(text_table([["", *outcomes], *cells, claimed]))
    if settings.out is not None:
        figure = states_figure(chosen, [states for states, *_ in played])
        write_results(settings.out, outcomes, figures={"states": (figure.caption, figure.png)})
        print(f"files: {settings.out}")


_RELATIONS = re.compile(r" (=|<=|>=|<|>) ")


def text_of(claims: Sequence[Claim]) -> str:
    """Returns the claims as a terminal shows them, and a summary."""
    blocks = []
    for number, claim in enumerate(claims, 1):
        lines = [_wrapped(f"{number:2d}.", f"{claim.verdict.upper()}: {claim.claim}", 4)]
        for label, text in (("printed", claim.printed), ("computed", claim.computed), ("charitably", claim.charitable)):
            lines += [_wrapped(f"    {label}", text, 16)] * bool(text)
        blocks.append("\n".join(lines))
    counts, found = Counter(claim.verdict for claim in claims), defects(claims)
    text = (
        f"Of {len(claims)} rows {counts[Verdict.HOLDS] + counts[Verdict.ROUNDED]} hold ({counts[Verdict.ROUNDED]} of "
        f"them but for rounding), {counts[Verdict.FAILS]} do not hold, {counts[Verdict.UNDECIDED]} are undecided, "
        f"{counts[Verdict.NOT_PRINTED]} is about what is not printed, {counts[Verdict.VACUOUS]} is vacuous. The rows "
        f"that do not hold show {len(found)} distinct defects:"
    )
    lines = [_wrapped("", text, 0)]
    for number, (defect, rows) in enumerate(found.items(), 1):
        named = f"row{'s' * (len(rows) > 1)} {', '.join(map(str, rows))}"
        lines.append(_wrapped(f"{number:2d}.", f"{defect} ({named})", 4))
    return "\n\n".join([*blocks, "\n".join(lines)])


def _wrapped(label: str, text: str, indent: int) -> str:
    """Returns a label and a text in lines of the terminal's width; a formula is not broken at its relation."""
    for product in ("K L K'", "x+'M x+"):
        text = text.replace(product, product.replace(" ", "\0"))
    return wrapped(_RELATIONS.sub("\0\\1\0", text), label=label, indent=indent).replace("\0", " ")


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


def designs() -> list[StateFeedback]:
    """Returns the three designs: printed, certified, and OP's."""
    example = PaperExample()
    plant = example.plant
    ours = synthesize(plant, safe_set="ellipsoid")
    assert isinstance(ours.safe_set, Ellipsoid)
    scale = _OP_SCALE * largest_scale(FeasibilityScan(plant), plant)
    Q, P0 = scale * plant.process_noise.covariance, scale * plant.initial_noise.covariance
    scaled = with_noise(plant, gamma=scale * plant.gamma, Q=Q, P0=P0)
    op = published.synthesize(scaled, dkappa=_OP_GRID_STEP, drho=_OP_GRID_STEP)
    box = BoxDisturbance((1.0 - 1e-9) * scale**0.5 * np.asarray(CASE_STUDY_BOX.half_widths))
    return [
        StateFeedback("printed", plant, CASE_STUDY_BOX, example.L, example.K, example.epsilon),
        StateFeedback("certified", plant, CASE_STUDY_BOX, ours.safe_set.shape_matrix, ours.K, None),
        StateFeedback(f"OP at {scale:.3f} of the bounds", scaled, box, op.L, op.K, op.epsilon),
    ]


def simulated(design: StateFeedback, settings: PaperSettings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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
        *_, info = envs.step(inputs[-1] / design.plant.largest_input)
        states.append(info["state"])
    return np.array(states), np.array(inputs), np.array(errors)


def outcome(
    design: StateFeedback, states: np.ndarray, inputs: np.ndarray, errors: np.ndarray
) -> dict[str, float | None]:
    """Returns counts of steps and largest values of what `simulated` returned, by name."""
    levels = np.einsum("ksi,ij,ksj->ks", states, np.linalg.inv(design.L), states)
    boxes = np.abs(states @ design.plant.box.T).max(axis=2)
    gain = design.plant.B @ design.K
    return {
        "steps": inputs.size,
        "outside_set": int((levels[1:] > 1.0).sum()),
        "outside_box": int((boxes[1:] > 1.0).sum()),
        "input_asked_beyond": int((np.abs(inputs) > design.plant.largest_input).sum()),
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
