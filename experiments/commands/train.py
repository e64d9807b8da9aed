"""`ncs train`: trains and evaluates one agent."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from experiments.analysis.episodes import arm_summary
from experiments.backends.execution import results_of
from experiments.report import summary_text
from experiments.runs.arms import Arm, require_arms, run_of_arm
from experiments.runs.loops import certificate_of, loop_config
from experiments.runs.output_folder import claim_folder, write_results
from experiments.runs.provenance import experiment_provenance
from experiments.settings import LearningSettings
from experiments.terminal import wrapped
from ncs_gym.validation import counted


@dataclass(frozen=True, kw_only=True)
class TrainSettings(LearningSettings):
    """Trains one agent, evaluates it, and saves it with everything needed to use it.

    Attributes:
        out: Output folder.
        arm: Arm that the agent is trained in; see the arms of `ncs compare`.
    """

    out: Path = Path("runs/train")
    arm: str = "shielded"


def train(settings: TrainSettings) -> None:
    """Runs `ncs train`."""
    if len(settings.algorithms) > 1:
        raise ValueError("--algorithms must be one for `ncs train`: `ncs compare` takes several")
    arm = Arm.of(settings.arm, settings.mode)
    loop = loop_config(settings.env, settings.channel, between_samples=settings.between_samples)
    require_arms(settings, loop, [settings.arm])
    certificate = certificate_of(loop, settings.certificate, settings.safe_set)
    claim_folder("train", settings.completed)
    print(wrapped(settings.agent_line), flush=True)
    settings = settings.completed
    run = run_of_arm(settings, loop, certificate, settings.arm, 0)
    (result,) = results_of([run], settings.out, settings)
    arms = {settings.arm: arm_summary([result], arm.mode, fixed_policy=True)}
    certificate.save(settings.out / "certificate.json")
    write_results(settings.out, {"arms": arms} | experiment_provenance(settings, loop, certificate, [run]))
    print(f"{counted(result.train_steps, 'training step')}, {counted(settings.episodes, 'episode')}\n")
    print(summary_text(arms, {}))
    if result.train_steps and not result.train_violation_steps and not result.train_interventions:
        print(
            wrapped(
                "This training had no violation and no override, so it does not show what the shield is for: "
                "raise --steps, or run `ncs compare`, which trains with and without the shield."
            )
        )
    print(f"agent: {settings.out / 'models' / run.name}")
