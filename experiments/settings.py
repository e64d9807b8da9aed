"""What each command can be told; importing this is cheap."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from agents.settings import PPOSettings


@dataclass(frozen=True, kw_only=True)
class CompareSettings:
    """Trains PPO with and without the shield and compares violations, return and interventions.

    Synthesizes and exactly verifies a certificate, trains paired runs (equal seeds meet the same draws of nature),
    evaluates each on the same episodes, prints a table and leaves summary.json, episodes.parquet, report.html, figures,
    models, TensorBoard events and the certificate in the output folder.

    Attributes:
        env: Id of a registered environment.
        out: Output folder; created if it does not exist, results in it are replaced.
        seed: Of the experiment, >= 0; all runs derive theirs from it.
        runs: Paired runs (training seeds) per arm.
        steps: Training steps per run.
        episodes: Evaluation episodes per run.
        mode: What the shield does with an unsafe action: the closest safe input ("project"), or the certified K x_hat
            ("switch"; "boundary" applies it unless every action would be safe).
        penalty: Subtracted from the training reward per intervention.
        certificate: File to use instead of synthesizing one.
        jobs: Worker processes.
        smoke: Shrink the run to a minute, to see that everything works.
        ppo: Settings of PPO.
    """

    env: str = "ncs_gym/TruckTrailerCruise-v0"
    out: Path = Path("runs/compare")
    seed: int = 0
    runs: int = 3
    steps: int = 150_000
    episodes: int = 200
    mode: Literal["project", "switch", "boundary"] = "project"
    penalty: float = 0.0
    certificate: Path | None = None
    jobs: int = 2
    smoke: bool = False
    ppo: PPOSettings = field(default_factory=PPOSettings)


@dataclass(frozen=True, kw_only=True)
class SynthesizeSettings:
    """Synthesizes a certificate for an environment's plant, verifies it exactly and saves it.

    Attributes:
        env: Id of a registered environment.
        method: The certified method, or the published one as printed.
        out: File for the certificate (JSON).
        max_age: Channel contract to rest on, in steps; by default the environment's own, if it needs one.
        seed: Accepted by every command; the synthesis is deterministic and does not use it.
    """

    env: str = "ncs_gym/TruckTrailerCruise-v0"
    method: Literal["certified", "paper"] = "certified"
    out: Path = Path("certificate.json")
    max_age: int | None = None
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class VerifySettings:
    """Verifies a certificate in exact rational arithmetic against the plant it was made for.

    Attributes:
        file: The certificate (JSON).
        env: Id of a registered environment; without it, the one whose plant has the certificate's fingerprint.
        out: File for the verdicts (JSON).
        seed: Accepted by every command; the verification is deterministic and does not use it.
    """

    file: tyro.conf.Positional[Path]
    env: str | None = None
    out: Path | None = None
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class AuditSettings:
    """Checks the printed numbers of the paper (Liu et al. Section 5) claim by claim, from its own data.

    Attributes:
        json: Print JSON instead of the table.
        out: File for the rows (JSON).
        seed: Accepted by every command; the audit is deterministic and does not use it.
    """

    json: bool = False
    out: Path | None = None
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class ReproduceSettings:
    """Simulates Section 5 of Liu et al.: printed (K, M), certified (K, M), and OP's at the nearest feasible bounds.

    Random starts in each safe set, all four impairments; prints a table and leaves figures and summary.json.

    Attributes:
        out: Output folder.
        starts: Random initial states per design.
        steps: Steps of each simulation.
        seed: Of starts, disturbances and channel, alike for all designs.
    """

    out: Path = Path("runs/reproduce")
    starts: int = 100
    steps: int = 200
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """Plays an episode with a policy and draws it, as an animation or its last picture (docs/rendering.md).

    Attributes:
        env: Id of a registered environment.
        out: File to write: .gif, .mp4, or .png for the last picture alone.
        policy: "greedy" (toward the task's goal as hard as it can), "zero", "random", or the path of a model.zip that
            training left.
        shield: What the shield does with an unsafe action; "none" for no shield.
        side_by_side: Draw the same episode without a shield at the left, with it at the right.
        certificate: File to use instead of synthesizing one.
        seed: Of the episode (both, side by side) and of the random policy.
        steps: Most steps to play.
        fps: Pictures per second; one per step.
        width: Of the animation [pixels]; by default as drawn.
    """

    env: str = "ncs_gym/TruckTrailerCruise-v0"
    out: Annotated[Path, tyro.conf.arg(aliases=["--gif"])] = Path("episode.gif")
    policy: str = "greedy"
    shield: Literal["project", "switch", "boundary", "monitor", "none"] = "project"
    side_by_side: bool = False
    certificate: Path | None = None
    seed: int = 0
    steps: int = 200
    fps: int = 10
    width: int | None = None
