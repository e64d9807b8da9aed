"""`ncs train`: trains and evaluates one agent."""

from __future__ import annotations

from dataclasses import replace
from shutil import rmtree

from experiments.analysis.episodes import arm_summary
from experiments.backends.execution import results_of
from experiments.commands import short_version
from experiments.report.text_tables import summary_text
from experiments.runs.arms import Arm, require_arms, require_used, run_of_arm
from experiments.runs.loops import certificate_of, loop_config
from experiments.runs.output_folder import claim_folder, write_results
from experiments.runs.provenance import experiment_provenance
from experiments.runs.training_run import CHECKPOINT, RunResult, history_of
from experiments.settings import TrainSettings
from experiments.terminal import wrapped
from ncs_gym.validation import counted

# Budget of `--smoke`.
_SMOKE = {"steps": 4_096, "episodes": 10}


def train(settings: TrainSettings) -> None:
    """Runs `ncs train`."""
    settings = short_version(settings, **_SMOKE)
    require_used(settings, [settings.arm])
    loop = loop_config(settings.env, settings.channel, between_samples=settings.between_samples)
    require_arms(settings, loop, [settings.arm])
    certificate = certificate_of(loop, settings.certificate, settings.safe_set)
    claim_folder("train", settings.completed)
    print(wrapped(settings.agent_line), flush=True)
    settings = settings.completed
    run = run_of_arm(settings, loop, certificate, settings.arm, 0)
    checkpoint = settings.out / "tensorboard" / run.name / CHECKPOINT
    if settings.force:
        rmtree(checkpoint, ignore_errors=True)
    history = history_of(checkpoint) if settings.engine == "local" else []  # what other machines leave stays there
    if history and history[-1].steps < run.steps:
        run = replace(run, went_on_after=history[-1].steps)
        print(f"the training in {settings.out} goes on after {counted(run.went_on_after, 'step')}", flush=True)
    results = results_of([run], settings.out, settings)
    rmtree(checkpoint, ignore_errors=True)
    mode = Arm.of(settings.arm, settings.mode).mode
    arms = {settings.arm: arm_summary(results, mode, fixed_policy=True)}
    certificate.save(settings.out / "certificate.json")
    summary = {"arms": arms, "went_on_after": results[0].went_on_after}
    summary |= experiment_provenance(settings, loop, certificate, [run])
    write_results(settings.out, summary)
    print(f"{counted(results[0].train_steps, 'training step')}, {counted(settings.episodes, 'episode')}\n")
    print(summary_text(arms, {}), *_hints(results[0], is_smoke=settings.smoke), sep="\n")
    print(f"agent: {settings.out / 'models' / run.name}")


def _hints(result: RunResult, *, is_smoke: bool) -> list[str]:
    """Returns what to do after a training in which a shield had nothing to do; nothing after another one."""
    if not result.train_steps or result.train_violation_steps or result.train_interventions:
        return []
    longer = "leave out --smoke" if is_smoke else "raise --steps"
    return [
        wrapped(
            "This training had no violation and no override, so it does not show what the shield is for: "
            f"{longer}, or run `ncs compare`, which trains with and without the shield."
        )
    ]
