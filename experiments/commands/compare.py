"""`ncs compare`: trains and compares agents with and without the shield."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro

from agents.agent import pretrained_folders
from experiments.analysis.episodes import (
    arm_summaries,
    episodes_table,
    paired_differences,
    parquet,
    training_table,
)
from experiments.backends.execution import results_of
from experiments.baselines.controllers import why_aimless
from experiments.figures import comparison_figures
from experiments.report import comparison_report, decimals_of, summary_text
from experiments.runs.arms import Arm, by_arm, full_names, is_any_trained, require_arms, run_of_arm
from experiments.runs.loops import certificate_of, loop_config, registered_env
from experiments.runs.output_folder import claim_folder, write_results
from experiments.runs.policies import PRETRAINED
from experiments.runs.provenance import experiment_provenance
from experiments.settings import LearningSettings, id_alone
from experiments.terminal import say, wrapped
from ncs_gym.envs.env import ncs_env
from ncs_gym.validation import counted
from shields import verify
from shields.certificate_text import size_of


@dataclass(frozen=True, kw_only=True)
class CompareSettings(LearningSettings):
    """Trains agents with and without the shield and compares violations, return and interventions.

    Synthesizes and exactly verifies a certificate, trains paired runs (equal seeds), evaluates each on the same
    episodes, prints a table and leaves summary.json, settings.json, episodes.parquet, training.parquet, report.html,
    figures, models, TensorBoard events and the certificate. Started again with the same folder, finished runs are kept.

    Attributes:
        out: Output folder.
        seeds: Number of paired training runs per arm.
        arms: unshielded, monitor (unshielded, counts what the shield would do), penalized (a penalty per violation),
            penalized:WEIGHT, lagrangian (adapts it), shielded, shielded:MODE, lookahead, trusting (no error set), psf
            (predictive filter), also with a margin in percent, psf:20, psf:tube; shield-at-test; also with +penalty.
            Untrained: lqr, mpc, mpc:20, random, K-x_hat, zero-input, untrained, pretrained, alone or behind a filter,
            lqr+shielded.
        baselines: Arms that are listed below the others and not drawn.
        scenarios: Other evaluations: worst-case-disturbance, worse-channel, ideal-channel, attacked,
            attacked-on-an-ideal-channel, gaussian (in the documentation under "Experiments").
        smoke: Run a short version to see that everything works, by default in a folder with -smoke in its name.
        tuned_arms: Whether arms are trained with what was tuned for each by itself (`benchmarks.learning`).
    """

    out: Path = Path("runs/compare")
    seeds: int = 3
    arms: tuple[str, ...] = ("unshielded", "penalized", "trusting", "shielded")
    baselines: tuple[str, ...] = ("zero input", "K x_hat", "untrained", "lqr", "lqr+trusting", "lqr+shielded")
    scenarios: tuple[str, ...] = ("as trained",)
    smoke: bool = False
    tuned_arms: tyro.conf.Suppress[bool] = False


# Budget of `--smoke`: enough to pass through every part.
_SMOKE = {"steps": 4_096, "episodes": 10, "seeds": 2}
# What it trains and evaluates where nothing else is asked for: agents that have hardly learned beside one that has.
_SMOKE_ARMS, _SMOKE_PAIR = ("unshielded", "shielded"), (PRETRAINED, f"{PRETRAINED}+shielded")
_SMOKE_BASELINES = ("zero input",)


def compare(settings: CompareSettings) -> None:
    """Runs `ncs compare`."""
    settings = _with_full_names(shortened(settings))
    loop = loop_config(settings.env, settings.channel, between_samples=settings.between_samples)
    names = settings.arms + settings.baselines
    require_arms(settings, loop, names)
    certificate = certificate_of(loop, settings.certificate, settings.safe_set)
    claim_folder("compare", settings.completed)
    verification = verify(certificate, ncs_env(loop.single()).plant)
    size = size_of(certificate.provenance)
    held = f"certificate: {len(verification.conditions)} conditions hold in exact arithmetic"
    print(wrapped(f"{held} ({size})" if size else held), flush=True)
    if is_any_trained(settings, names):
        print(*(wrapped(each.agent_line) for each in settings.by_algorithm), sep="\n", flush=True)
    settings = settings.completed

    runs = [run_of_arm(settings, loop, certificate, name, index) for index in range(settings.seeds) for name in names]
    runs.sort(key=lambda run: run.trains)  # first those that are evaluated only: they take a second
    results = results_of(runs, settings.out, settings)

    common = {"environment": id_alone(settings.env), "algorithm": settings.algorithm}
    episodes, arms = episodes_table(results, **common), arm_summaries(results, settings.mode)
    baseline = next((name for name in settings.arms if name.endswith("unshielded")), settings.arms[0])
    compared = episodes[episodes["arm"].isin(settings.arms)]
    summary = {
        "arms": {name: arms[name] for name in settings.arms},
        "references": {name: arms[name] for name in settings.baselines},
        "paired_differences": {"baseline": baseline, "arms": paired_differences(compared, baseline)},
    } | experiment_provenance(settings, loop, certificate, runs)
    findings = findings_of(summary)
    if settings.smoke:
        findings.append("A smoke run shows that everything runs; the agents that it trains have hardly learned.")
        if PRETRAINED in settings.arms:
            findings[-1] += " What a shield does, the rows of the pretrained agent show."

    figures = comparison_figures(summary, by_arm(results))
    certificate.save(settings.out / "certificate.json")
    files = {
        "episodes.parquet": parquet(episodes, summary),
        "training.parquet": parquet(training_table(results, **common), summary),
        "report.html": comparison_report(summary, verification, figures, findings),
    }
    write_results(settings.out, summary, files, figures)

    trained = max(arm["train_steps"] for arm in summary["arms"].values())
    per_run = f"{trained:,} training steps per arm, {counted(settings.episodes, 'episode')} per run"
    runs_per_arm = counted(settings.seeds, "run")
    print(f"\n{wrapped(f'{settings.env}: {runs_per_arm} and {per_run}')}\n")
    print(summary_text(summary["arms"], summary["references"]))
    print(*map(wrapped, findings), f"files: {settings.out}", sep="\n")


def shortened(settings: CompareSettings) -> CompareSettings:
    """Returns the settings of the short version if `--smoke` is given, else the same."""
    if not settings.smoke:
        return settings
    chosen: dict[str, Any] = dict(_SMOKE)
    default = type(settings)
    pair = _SMOKE_PAIR if id_alone(settings.env) in pretrained_folders() else ()
    if settings.arms == default.arms:
        chosen["arms"] = _SMOKE_ARMS + pair
    if settings.baselines == default.baselines and pair:
        chosen["baselines"] = _SMOKE_BASELINES
    if settings.out == default.out:  # what the whole version leaves there stays
        chosen["out"] = default.out.with_stem(f"{default.out.stem}-smoke")
    return replace(settings, **chosen)


def _with_full_names(settings: CompareSettings) -> CompareSettings:
    """Returns the settings with full names of arms, each once, without usual baselines that cannot do the task."""
    arms, baselines = (full_names(names, settings) for names in (settings.arms, settings.baselines))
    if settings.baselines == type(settings).baselines:
        task = registered_env(settings.env).task
        reasons = {name: why_aimless(Arm.of(name, settings.mode).policy, task) for name in baselines}
        baselines = tuple(name for name, reason in reasons.items() if not reason)
        if aimless := [name for name, reason in reasons.items() if reason]:
            say(f"without {', '.join(aimless)}: {reasons[aimless[0]]}")
    if len(set(arms)) != len(arms) or not arms:
        raise ValueError(f"--arms must be arms that differ, at least one, got {' '.join(settings.arms) or 'none'}")
    baselines = tuple(name for name in dict.fromkeys(baselines) if name not in arms)
    return replace(settings, arms=arms, baselines=baselines)


def findings_of(summary: dict[str, Any]) -> list[str]:
    """Returns what a comparison shows, in sentences."""
    findings = [
        f"{name} is not enough: {arm['train_violation_steps']:,} violating steps in training, "
        f"{arm['eval_violating_episodes']:,} of {counted(arm['eval_episodes'], 'episode')} in evaluation."
        for name, arm in summary["arms"].items()
        if Arm.of(name).penalizes_violations and arm["train_violation_steps"] + arm["eval_violating_episodes"]
    ]
    for name, arm in summary["arms"].items():
        if not arm["shielded"]:
            continue
        evaluated = [arm, *arm.get("conditions", {}).values()]
        if not arm["train_intervention_rate"] and not any(each["intervention_rate"] for each in evaluated):
            findings.append(f"{name}: all that was proposed was safe, so that this arm shows nothing of the shield.")
            continue
        leaves = ", which may be left in this mode; the box may not" if arm["mode"] == "lookahead" else ""
        findings.append(
            f"{name}: the proof held in {arm['guaranteed_episodes']:,} of {arm['eval_episodes']:,} evaluation "
            f"episodes; the true state came to {arm['times_safe_set']:.3f} times the safe set{leaves}."
        )
    paired = summary["paired_differences"]
    for name, difference in paired["arms"].items():
        mean, interval = difference["return_mean"], difference["return_ci95"]
        decimals = decimals_of(mean, *(interval or ()))
        text = f" [{interval[0]:+z.{decimals}f}, {interval[1]:+z.{decimals}f}]" if interval else ""
        findings.append(f"{name}, paired with {paired['baseline']}: return {mean:+z.{decimals}f}{text}.")
    if "monitor" in summary["arms"]:
        findings.append("In brackets: what the shield would have overridden.")
    return findings
