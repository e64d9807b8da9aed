"""The main job: train and compare shielded and unshielded PPO."""

from __future__ import annotations

import io
import json
import platform
import shutil
from collections.abc import Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import pyarrow as pa
import pyarrow.parquet as pq

from experiments.certificates import contract_of_env, plant_of
from experiments.figures import episode_figure, phase_figure, training_figure
from experiments.plotting import as_png
from experiments.pool import run_all
from experiments.report import html_report
from experiments.settings import CompareSettings
from experiments.summary import summarize_arm, table_text, way_covered
from experiments.unit import Unit, UnitResult
from ncs_gym import LinearPlant
from shields import Certificate, Report, verify
from shields.storage import write_atomically
from shields.synthesis import synthesize
from shields.verification import require_valid

# What `--smoke` shrinks the run to: enough to pass through every part.
SMOKE_STEPS, SMOKE_EPISODES, SMOKE_RUNS = 4_096, 10, 2


def compare(settings: CompareSettings) -> None:
    """Runs the comparison; prints the table and writes the files.

    Raises:
        ValueError: If a setting is out of range.
        OSError: If the output folder cannot be written.
        CertificateError: If a given certificate does not verify.
        Infeasible: If no certificate is found.
    """
    if settings.smoke:
        settings = replace(settings, steps=SMOKE_STEPS, episodes=SMOKE_EPISODES, runs=SMOKE_RUNS)
    _check(settings)
    plant = plant_of(settings.env)
    certificate = _certificate(settings, plant)
    verification = verify(certificate, plant)
    _prepare(settings.out)
    volume = certificate.provenance.get("volume_of_box_ellipsoid")
    size = f" ({volume:.2%} of the largest ellipsoid in the safe box)" if isinstance(volume, float) else ""
    print(f"certificate: {len(verification.conditions)} conditions hold in exact arithmetic{size}", flush=True)
    units = _units(settings, certificate)
    length = gym.spec(settings.env).max_episode_steps or 1
    rollout = settings.ppo.rollout * settings.ppo.envs
    training = -(-settings.steps // rollout) * rollout  # whole rollouts
    total = sum((training if unit.learner == "ppo" else 0) + unit.episodes * length for unit in units)
    results = run_all(units, settings.jobs, total)
    summary = _summary(settings, plant, units, results)
    findings = _findings(summary)
    _write(settings.out, summary, results, plant, certificate, verification, findings)
    print(f"\n{settings.env}: {settings.runs} runs per arm, {settings.episodes} evaluation episodes per run\n")
    print(table_text(summary), *findings, f"files: {settings.out}", sep="\n")


def _check(settings: CompareSettings) -> None:
    for name in ("runs", "steps", "episodes", "jobs"):
        if getattr(settings, name) < 1:
            raise ValueError(f"--{name} must be at least 1, got {getattr(settings, name)}")
    if settings.seed < 0:
        raise ValueError(f"--seed must be >= 0, got {settings.seed}")
    if not 0.0 <= settings.penalty < float("inf"):
        raise ValueError(f"--penalty must be >= 0, got {settings.penalty}")


def _certificate(settings: CompareSettings, plant: LinearPlant) -> Certificate:
    if settings.certificate is None:
        return synthesize(plant, contract=contract_of_env(settings.env))
    certificate = Certificate.load(settings.certificate)
    require_valid(certificate, plant)
    return certificate


def _prepare(out: Path) -> None:
    """Creates the output folder and removes an earlier run's summary, models and events: a summary fits its files."""
    (out / "figures").mkdir(parents=True, exist_ok=True)
    write_atomically(out / ".writable", "")
    (out / ".writable").unlink()
    (out / "summary.json").unlink(missing_ok=True)
    for folder in ("models", "tensorboard"):
        for stale in [*out.glob(f"{folder}/shielded-*"), *out.glob(f"{folder}/unshielded-*")]:
            shutil.rmtree(stale, ignore_errors=True)


def _units(settings: CompareSettings, certificate: Certificate) -> list[Unit]:
    """Returns the runs of both arms, the longer ones first, then the reference policies."""
    base = Unit(
        arm="shielded",
        learner="ppo",
        env=settings.env,
        seed=settings.seed,
        index=0,
        steps=settings.steps,
        episodes=settings.episodes,
        certificate=certificate,
        mode=settings.mode,
        penalty=settings.penalty,
        ppo=settings.ppo,
        folder=settings.out,
    )
    arms = [replace(base, index=index) for index in range(settings.runs)]
    arms += [replace(base, arm="unshielded", mode=None, index=index) for index in range(settings.runs)]
    for name, learner in (("zero input", "zero"), ("K x_hat", "gain"), ("untrained", "untrained")):
        arms += [replace(base, arm=name, learner=learner, mode=None, index=index) for index in range(settings.runs)]
    return arms


def _summary(
    settings: CompareSettings, plant: LinearPlant, units: Sequence[Unit], results: Sequence[UnitResult]
) -> dict[str, Any]:
    def arm(name: str) -> dict[str, Any]:
        chosen = [(unit, result) for unit, result in zip(units, results, strict=True) if unit.arm == name]
        unit = chosen[0][0]
        fixed = unit.learner in ("zero", "gain")
        return {"shielded": unit.mode is not None} | summarize_arm([result for _, result in chosen], fixed_policy=fixed)

    packages = ("ncs-gym", "gymnasium", "stable-baselines3", "torch", "cvxpy", "clarabel", "numpy", "filterpy")
    content = asdict(settings) | {
        "out": str(settings.out),
        "certificate": None if settings.certificate is None else str(settings.certificate),
    }
    return {
        "arms": {name: arm(name) for name in ("unshielded", "shielded")},
        "references": {name: arm(name) for name in ("zero input", "K x_hat", "untrained")},
        "settings": content,
        "plant": {"fingerprint": plant.fingerprint, "spectral_radius": plant.spectral_radius},
        "versions": {"python": platform.python_version()} | {name: version(name) for name in packages},
    }


def _findings(summary: dict[str, Any]) -> list[str]:
    """Returns what to read from the table, in sentences computed from it."""
    shielded = summary["arms"]["shielded"]
    upper = 100.0 * shielded["eval_violation_rate_ci95"][1]
    return [
        f"The proof held in {shielded['guaranteed_episodes']:,} of {shielded['eval_episodes']:,} shielded evaluation "
        f"episodes; the largest x'Mx was {shielded['largest_level']:.3f} (the safe set ends at 1).",
        f"Shielded violating episodes: {shielded['eval_violating_episodes']:,} of {shielded['eval_episodes']:,}; "
        f"from these episodes alone at most {upper:.2f} % with 95 % confidence.",
        f"The shielded return covers {100 * way_covered(summary):.0f} % of the way from the zero input to the "
        "unshielded agent.",
    ]


def _write(
    out: Path,
    summary: dict[str, Any],
    results: Sequence[UnitResult],
    plant: LinearPlant,
    certificate: Certificate,
    verification: Report,
    findings: list[str],
) -> None:
    """Writes every file; summary.json comes last, so that it stands for a complete run."""
    arms = {name: [result for result in results if result.arm == name] for name in summary["arms"]}
    figures = {
        "training": ("Training: thin lines are single runs, thick ones their mean.", as_png(training_figure(arms))),
        "phase": (
            "True states of the first evaluation episode of each run.",
            as_png(phase_figure(plant, certificate, arms)),
        ),
        "episode": (
            "One evaluation episode of the first runs, same draws of nature.",
            as_png(episode_figure(plant, arms)),
        ),
    }
    for name, (_, png) in figures.items():
        write_atomically(out / "figures" / f"{name}.png", png)
    certificate.save(out / "certificate.json")
    write_atomically(out / "episodes.parquet", _parquet(results))
    write_atomically(out / "report.html", html_report(summary, verification, dict(figures.values()), findings))
    write_atomically(out / "summary.json", json.dumps(summary, indent=1, allow_nan=False) + "\n")


def _parquet(results: Sequence[UnitResult]) -> bytes:
    """Returns one row per evaluation episode."""
    rows = [
        {"arm": result.arm, "run": result.index, **asdict(episode)} for result in results for episode in result.episodes
    ]
    buffer = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(rows), buffer)
    return buffer.getvalue()
