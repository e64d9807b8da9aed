"""`ncs compare`: trains and compares agents with and without the shield."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import pandas as pd

from agents.agent_file import has_pretrained
from agents.loop import LoopConfig
from agents.results import Trajectory
from experiments.analysis.episodes import (
    arm_summaries,
    covered_fraction,
    episodes_table,
    paired_differences,
    parquet,
    training_table,
)
from experiments.analysis.statistics import gaussian_sentences, gaussian_summary
from experiments.backends.execution import results_of
from experiments.baselines import why_aimless
from experiments.commands import short_version
from experiments.plots.comparison_figures import comparison_figures, most_overridden
from experiments.report.html import comparison_report
from experiments.report.text_tables import certificate_line, decimals_of, scenario_text, summary_text
from experiments.runs.arms import Arm, by_arm, full_names, is_any_trained, require_arms, run_of_arm
from experiments.runs.loops import certificate_of, loop_config, registered_env
from experiments.runs.output_folder import claim_folder, write_results
from experiments.runs.policies import PRETRAINED
from experiments.runs.provenance import experiment_provenance
from experiments.runs.training_run import RunResult, TrainingRun
from experiments.settings import CompareSettings
from experiments.settings.arguments import id_alone
from experiments.terminal import say, wrapped
from ncs_gym import bound_violation_probability
from ncs_gym.envs.env import ncs_env
from ncs_gym.validation import counted
from shields import Certificate, SafetyFilter, verify
from shields.runtime.starts import starts_known

# Budget of `--smoke`: enough to pass through every part.
_SMOKE = {"steps": 4_096, "episodes": 10, "seeds": 2}
# What it trains and evaluates where nothing else is asked for: agents that have hardly learned beside one that has.
_SMOKE_ARMS, _SMOKE_PAIR = ("unshielded", "shielded"), (PRETRAINED, f"{PRETRAINED}+shielded")
_SMOKE_BASELINES = ("zero input",)


class Comparison(NamedTuple):
    """What a comparison found.

    Attributes:
        episodes: A row per evaluation episode (`episodes_table`).
        summary: What summary.json holds.
        results: Results of the runs, with the agents that were trained.
    """

    episodes: pd.DataFrame
    summary: dict[str, Any]
    results: Sequence[RunResult]


def compare(settings: CompareSettings) -> Comparison:
    """Runs `ncs compare`: prints the table, writes the files, and returns what they are made of."""
    settings = _with_full_names(shortened(settings))
    noise = "gaussian" if settings.noise == "gaussian" else None
    loop = loop_config(settings.env, settings.channel, noise=noise, between_samples=settings.between_samples)
    names = settings.arms + settings.baselines
    require_arms(settings, loop, names)
    certificate = certificate_of(loop, settings.certificate, settings.safe_set)
    claim_folder("compare", settings.completed)
    plant = ncs_env(loop.single()).plant
    verification = verify(certificate, plant)
    print(wrapped(certificate_line(certificate, verification)), flush=True)
    if is_any_trained(settings, names):
        print(wrapped(settings.agent_line), flush=True)
    settings = settings.completed
    runs = _training_runs(settings, loop, certificate)
    results = results_of(runs, settings.out, settings)
    common = {"environment": id_alone(settings.env), "algorithm": settings.algo}
    episodes = episodes_table(results, **common)
    summary = _summary(settings, loop, certificate, runs, results, episodes)
    findings = findings_of(summary)
    if "gaussian_noise" in summary:
        findings += gaussian_sentences(summary["gaussian_noise"])
    by_name = {(run.arm, run.index): run for run in runs}

    def path_of(arm: str, index: int, scenario: str, episode: int) -> Trajectory:
        return by_name[arm, index].trajectory(settings.out / "models", scenario, episode)

    shown = most_overridden(episodes, settings.arms, path_of)
    figures = comparison_figures(plant, summary, by_arm(results), shown)
    certificate.save(settings.out / "certificate.json")
    files = {
        "episodes.parquet": parquet(episodes, summary),
        "training.parquet": parquet(training_table(results, **common), summary),
        "report.html": comparison_report(summary, verification, figures, findings),
    }
    write_results(settings.out, summary, files, figures)
    count = counted(settings.seeds, "run")
    trained = max(arm["train_steps"] for arm in summary["arms"].values())
    per_run = f"{trained:,} training steps per arm, {counted(settings.episodes, 'episode')} per run"
    print(f"\n{wrapped(f'{settings.env}: {count} and {per_run}')}\n")
    short = [_smoke_text(settings)] if settings.smoke else []
    print(_tables(summary), *map(wrapped, [*findings, *short]), f"files: {settings.out}", sep="\n")
    return Comparison(episodes, summary, results)


def shortened(settings: CompareSettings) -> CompareSettings:
    """Returns the settings of the short version if `--smoke` is given, otherwise the same settings."""
    chosen, default = {}, type(settings)
    pair = _SMOKE_PAIR if has_pretrained(id_alone(settings.env)) else ()
    if settings.arms == default.arms:
        chosen["arms"] = _SMOKE_ARMS + pair
    if settings.baselines == default.baselines and pair:
        chosen["baselines"] = _SMOKE_BASELINES
    return short_version(settings, **_SMOKE, **chosen)


def _with_full_names(settings: CompareSettings) -> CompareSettings:
    """Returns the settings with the full names of arms, each of which is listed once.

    Of the usual baselines those that do not know what the task asks for are left out.
    """
    arms, baselines = (full_names(names, settings.mode) for names in (settings.arms, settings.baselines))
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


def _smoke_text(settings: CompareSettings) -> str:
    """Returns what a short version shows."""
    text = "A smoke run shows that everything runs; the agents that it trains have hardly learned."
    if PRETRAINED in settings.arms:
        text += " What a shield does, the rows of the pretrained agent show."
    return text


def _tables(summary: dict[str, Any]) -> str:
    arms, baselines = summary["arms"], summary["references"]
    scenarios = next(iter(arms.values()))["conditions"]
    others = [scenario_text(scenario, arms, baselines) for scenario in scenarios]
    return "\n\n".join([summary_text(arms, baselines), *others])


def _training_runs(settings: CompareSettings, loop: LoopConfig, certificate: Certificate) -> list[TrainingRun]:
    """Returns the runs of every arm and of the baselines, first those that are evaluated only: they take a second."""
    names = settings.arms + settings.baselines
    runs = [run_of_arm(settings, loop, certificate, name, index) for index in range(settings.seeds) for name in names]
    return sorted(runs, key=lambda run: run.trains)


def _summary(
    settings: CompareSettings,
    loop: LoopConfig,
    certificate: Certificate,
    runs: Sequence[TrainingRun],
    results: Sequence[RunResult],
    episodes: pd.DataFrame,
) -> dict[str, Any]:
    arms = arm_summaries(results, settings.mode)
    gaussian = {}
    if settings.noise == "gaussian":
        gaussian["gaussian_noise"] = gaussian_noise_of(loop, certificate, arms)
    baseline = "unshielded" if "unshielded" in settings.arms else settings.arms[0]
    compared = episodes[episodes["arm"].isin(settings.arms)]
    return {
        "arms": {name: arms[name] for name in settings.arms},
        "references": {name: arms[name] for name in settings.baselines},
        "paired_differences": {"baseline": baseline, "arms": paired_differences(compared, baseline)},
    } | (gaussian | experiment_provenance(settings, loop, certificate, runs))


def gaussian_noise_of(loop: LoopConfig, certificate: Certificate, arms: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """Returns the bound on the probability that an episode leaves the safe set, and how often shielded arms did.

    The bound is about episodes that begin in the safe set, and behind a downlink stay there until the first decision
    takes effect; where not all do, it is 1. Mode "lookahead" may leave that
    set on purpose and is not listed.
    """
    env = ncs_env(loop.single())
    steps = loop.episode_steps or 1
    downlink = env.downlink_protocol
    known = starts_known(SafetyFilter(certificate, env.plant), env.initial_set, downlink.input_delay)
    begins_inside = downlink.contract is not None and all(each.in_safe_set for each in known)
    bound = bound_violation_probability(env.plant, env.channel, steps) if begins_inside else 1.0
    claimed = {name: arm for name, arm in arms.items() if arm["shielded"] and arm["mode"] != "lookahead"}
    return gaussian_summary(bound, steps, claimed)


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
        proof = "no broken assumption was seen" if "gaussian_noise" in summary else "the proof held"
        findings.append(
            f"{name}: {proof} in {arm['guaranteed_episodes']:,} of {arm['eval_episodes']:,} evaluation episodes; the "
            f"true state came to {arm['times_safe_set']:.3f} times the safe set{leaves}."
        )
    paired = summary["paired_differences"]
    for name, difference in paired["arms"].items():
        mean, interval = difference["return_mean"], difference["return_ci95"]
        decimals = decimals_of(mean, *(interval or ()))
        text = f" [{interval[0]:+z.{decimals}f}, {interval[1]:+z.{decimals}f}]" if interval else ""
        findings.append(f"{name}, paired with {paired['baseline']}: return {mean:+z.{decimals}f}{text}.")
    acted = any(arm["shielded"] and arm["train_intervention_rate"] for arm in summary["arms"].values())
    if acted and (covered := covered_fraction(summary)) is not None:
        findings.append(
            f"The shielded return covers {100 * covered:.0f} % of the way from the zero input to the unshielded agent."
        )
    if "monitor" in summary["arms"]:
        findings.append("In brackets: what the shield would have overridden.")
    return findings
