"""Settings of the command that draws an episode."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from experiments.settings.steps import StepCount, require_horizon


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """Draws an episode of a policy, as an animation or its last frame (docs/rendering.md).

    Attributes:
        env: Id of an environment with a plant of its own; module:id first imports the module, which registers one of
            your own (`ncs_gym.register_plant`).
        out: File to write: .gif, .mp4, or .png for the last frame alone.
        policy: "greedy" (toward the task's goal as hard as it can), "zero", "random", "pretrained" (the small agent
            that comes with the package), or the folder of a trained agent.
        shield: Mode of the shield; "none" for no shield.
        horizon: Longest plan of mode "lookahead" [steps]; 6 by default.
        side_by_side: Draw the same episode without a shield at the left, with it at the right.
        certificate: Certificate file to use instead of synthesizing one.
        seed: Seed of the episode (of both, side by side) and of the random policy.
        steps: Largest number of steps.
        fps: Frames per second; one frame per step.
        scale: Pixels of a frame per unit of its layout of 640 by 480; by default 2, sharp on dense screens, and
            1 for a .gif, whose file would be several times as large.
        width: Width of the animation [pixels]; by default as drawn.
        smoke: Draw a few steps only, to see that everything works; if `--out` is not given, into episode-smoke.gif.
    """

    env: str = "ncs_gym/TruckTrailerCruise-v0"
    out: Annotated[Path, tyro.conf.arg(aliases=["--gif"])] = Path("episode.gif")
    policy: str = "greedy"
    shield: Literal["project", "lookahead", "switch", "boundary", "monitor", "none"] = "project"
    horizon: int | None = None
    side_by_side: bool = False
    certificate: Path | None = None
    seed: int = 0
    steps: StepCount = 200
    fps: int = 10
    scale: int | None = None
    width: int | None = None
    smoke: bool = False

    def __post_init__(self) -> None:
        """Raises ValueError if the horizon is wrong."""
        require_horizon(self.horizon, self.shield)
