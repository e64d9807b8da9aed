"""The main job: train and compare shielded and unshielded agents."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.analysis.parquet_tables import write_tables
from experiments.analysis.summary import paired_differences, summarize_arm, table_text, way_covered
from experiments.backends.execution import results_of
from experiments.plots.figures import figures_of
from experiments.report.comparison import html_report
from experiments.runs.arms import arm_of
from experiments.runs.experiment_setup import World, world_of
from experiments.runs.provenance import versions
from experiments.runs.training_run import Learner, Unit, UnitResult
from experiments.settings import backend as engine
from experiments.settings.learning import CompareSettings, LearningSettings
from experiments.settings.settings_file import save_settings, settings_json
from shields.atomic_write import write_atomically

# What `--smoke` shrinks the run to: enough to pass through every part.
SMOKE = {"steps": 4_096, "episodes": 10, "seeds": 2}
REFERENCES: dict[str, Learner] = {"zero input": "zero", "K x_hat": "gain", "untrained": "untrained"}
# Settings that results do not depend on.
INCIDENTAL = ("out", *engine.NAMES)


def compare(settings: CompareSettings) -> None:
    """Runs the comparison; prints the table and writes the files.

    Raises:
        ValueError: If a setting is out of range or a stored result is damaged.
        OSError: If the output folder cannot be written.
        CertificateError: If a given certificate does not verify.
        Infeasible: If no certificate is found.
        RunError: If a run fails.
        ClusterError: If a cluster cannot run them.
    """
    if settings.smoke:
        settings = replace(settings, **SMOKE)
    arms = [arm_of(name, settings.mode) for name in settings.arms]
    if len({arm.name for arm in arms}) != len(arms) or not arms:
        raise ValueError(f"--arms must be different ones, at least one, got {' '.join(settings.arms) or 'none'}")
    world = world_of(settings.env, settings.channel, settings.certificate)
    prepare(settings.out)
    save_settings(settings.out / "settings.json", "compare", settings)
    print(world.title, flush=True)
    units = [unit for index in range(settings.seeds) for unit in _units(settings, world, index)]
    units.sort(key=lambda unit: unit.learner != "agent")  # the longer ones first
    results = results_of(units, settings.out, settings)
    summary = _summary(settings, world, units, results)
    findings = _findings(summary)
    _write(settings.out, summary, results, world, findings)
    runs = "1 run" if settings.seeds == 1 else f"{settings.seeds} runs"
    print(f"\n{settings.env}: {runs} per arm, {settings.episodes} evaluation episodes per run\n")
    print(table_text(summary["arms"], summary["references"]), *findings, f"files: {settings.out}", sep="\n")


def unit_of(settings: LearningSettings, world: World, name: str, index: int) -> Unit:
    """Returns the unit of one arm and run.

    Raises:
        ValueError: If the arm is unknown.
    """
    arm = arm_of(name, settings.mode)
    return Unit(
        arm=name,
        learner="agent",
        env=settings.env,
        channel=world.channel,
        seed=settings.seed,
        index=index,
        steps=settings.steps,
        episodes=settings.episodes,
        certificate=world.certificate,
        mode=arm.mode,
        intervention_penalty=settings.intervention_penalty if arm.prices_interventions else 0.0,
        violation_penalty=settings.violation_penalty if arm.prices_violations else 0.0,
        algorithm=settings.algo,
        settings=settings.agent,
    )


def prepare(out: Path) -> None:
    """Creates the output folder and removes an earlier summary, tables, figures and report: they stand together."""
    (out / "figures").mkdir(parents=True, exist_ok=True)
    write_atomically(out / ".writable", "")
    (out / ".writable").unlink()
    for stale in (out / "summary.json", out / "report.html", *out.glob("*.parquet"), *out.glob("figures/*.png")):
        stale.unlink(missing_ok=True)


def provenance(command: str, settings: LearningSettings, world: World) -> dict[str, Any]:
    """Returns what a reader needs to know where results come from, JSON values."""
    content = settings_json(command, settings)["settings"]
    return {
        "settings": {name: value for name, value in content.items() if name not in INCIDENTAL},
        "plant": {"fingerprint": world.plant.fingerprint, "spectral_radius": world.plant.spectral_radius},
        "certificate": world.certificate.checksum,
        "certificate_file": world.certificate.document,
        "versions": versions(),
    }


def _units(settings: CompareSettings, world: World, index: int) -> list[Unit]:
    """Returns the units of one run: an agent per arm, and the reference policies."""
    units = [unit_of(settings, world, name, index) for name in settings.arms]
    bare = replace(units[0], mode=None, intervention_penalty=0.0, violation_penalty=0.0)
    return units + [replace(bare, arm=name, learner=learner) for name, learner in REFERENCES.items()]


def _summary(
    settings: CompareSettings, world: World, units: Sequence[Unit], results: Sequence[UnitResult]
) -> dict[str, Any]:
    by_arm = grouped(results)
    modes = {unit.arm: unit.mode for unit in units}

    def arm(name: str) -> dict[str, Any]:
        fixed = REFERENCES.get(name) in ("zero", "gain")
        return {"mode": modes[name], "shielded": modes[name] not in (None, "monitor")} | summarize_arm(
            by_arm[name], fixed_policy=fixed
        )

    baseline = "unshielded" if "unshielded" in settings.arms else settings.arms[0]
    return {
        "arms": {name: arm(name) for name in settings.arms},
        "references": {name: arm(name) for name in REFERENCES},
        "paired_differences": {
            "baseline": baseline,
            "arms": paired_differences({name: by_arm[name] for name in settings.arms}, baseline),
        },
        "units": {unit.name: unit.key for unit in units},
        "seeds": {unit.index: {"training": unit.training_seed, "evaluation": unit.evaluation_seed} for unit in units},
    } | provenance("compare", settings, world)


def grouped(results: Sequence[UnitResult]) -> dict[str, Sequence[UnitResult]]:
    """Returns the results of each arm in the order of their runs."""
    names = dict.fromkeys(result.arm for result in results)
    return {name: sorted((r for r in results if r.arm == name), key=lambda r: r.index) for name in names}


def _findings(summary: dict[str, Any]) -> list[str]:
    """Returns what to read from the table, in sentences computed from it."""
    findings = []
    for name, arm in summary["arms"].items():
        if not arm["shielded"]:
            continue
        upper = 100.0 * arm["eval_violation_rate_ci95"][1]
        findings += [
            f"{name}: the proof held in {arm['guaranteed_episodes']:,} of {arm['eval_episodes']:,} evaluation "
            f"episodes; the largest x'Mx was {arm['largest_level']:.3f} (the safe set ends at 1).",
            f"{name}: {arm['eval_violating_episodes']:,} of {arm['eval_episodes']:,} episodes violating; from these "
            f"episodes alone at most {upper:.2f} % with 95 % confidence.",
        ]
    paired = summary["paired_differences"]
    for name, difference in paired["arms"].items():
        interval = difference["return_ci95"]
        text = f" [{interval[0]:+.1f}, {interval[1]:+.1f}]" if interval else ""
        findings.append(f"{name}, paired with {paired['baseline']}: return {difference['return_mean']:+.1f}{text}.")
    if (covered := way_covered(summary)) is not None:
        findings.append(
            f"The shielded return covers {100 * covered:.0f} % of the way from the zero input to the unshielded agent."
        )
    if "monitor" in summary["arms"]:
        findings.append("In brackets: what the shield would have overridden.")
    return findings


def _write(
    out: Path, summary: dict[str, Any], results: Sequence[UnitResult], world: World, findings: list[str]
) -> None:
    """Writes every file; summary.json comes last, so that it stands for a complete run."""
    figures = figures_of(world.plant, world.certificate, summary, grouped(results))
    for name, (_, png) in figures.items():
        write_atomically(out / "figures" / f"{name}.png", png)
    world.certificate.save(out / "certificate.json")
    names = ("settings", "seeds", "plant", "certificate", "certificate_file", "versions")
    write_tables(out, results, {name: summary[name] for name in names})
    page = html_report(summary, world.verification, {caption: png for caption, png in figures.values()}, findings)
    write_atomically(out / "report.html", page)
    write_atomically(out / "summary.json", json.dumps(summary, indent=1, allow_nan=False) + "\n")
