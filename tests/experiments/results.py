"""Results of units made by hand, for tests of figures and reports."""

from __future__ import annotations

from typing import Any

from agents.loop import LoopConfig, ShieldSettings
from agents.results import Episode, TrainingPoint
from experiments.analysis.episodes import arm_summaries, episodes_table, paired_differences
from experiments.runs.training_run import RunResult, TrainingRun
from shields import Certificate

ALL_ARMS = [
    "unshielded",
    "monitor",
    "penalized",
    *(f"shielded{mode}{penalty}" for mode in ("", ":project", ":switch", ":boundary") for penalty in ("", "+penalty")),
    *("penalized:10", "lagrangian", "lookahead", "trusting", "psf:tube", "psf", "shield at test"),
]


def history(*steps: int, scale: float = 1.0) -> list[TrainingPoint]:
    """A history with a finished episode from the second point on, or at once if it has one point."""
    return [
        TrainingPoint(at, float("nan") if at == steps[0] and len(steps) > 1 else -scale * at, int(scale * at), at // 10)
        for at in steps
    ]


def training_run(certificate: Certificate, shield: str | None = None, **change: Any) -> TrainingRun:
    """A run with the shield of a mode, in which an agent is trained, else one that applies no input."""
    settings = None if shield is None else ShieldSettings(certificate, shield)
    loop = LoopConfig(env="ncs_gym/TruckTrailerCruise-v0", shield=settings)
    small = dict(n_envs=2, n_steps=64, batch_size=64, n_epochs=1, policy_kwargs=dict(net_arch=[8, 8]))
    content = dict(arm="zero input", policy_kind="zero input", steps=64, episodes=1, index=0, settings={})
    if shield is not None:
        content |= dict(arm="shielded", policy_kind="trained", steps=256, episodes=2, settings=small)
    common = dict(training_loop=loop, loop=loop, seed=0, certificate=certificate, algorithm="PPO")
    return TrainingRun(**common | content | change)


def episode(index: int, total: float, violating: int, estimated: int, overridden: int) -> Episode:
    """An episode of 10 steps inside of the safe set, whose guarantee held."""
    counts = {"violation_steps": violating, "estimate_violation_steps": estimated, "interventions": overridden}
    return Episode(index=index, steps=10, episode_return=total, **counts, times_safe_set=0.9, guaranteed=True)


def run(arm: str, index: int = 0, violations=(0, 0), returns=(-1.0, -3.0), **change: Any) -> RunResult:
    """A run of an arm with an episode of 10 steps for each number of violating steps."""
    episodes = [
        episode(i, total - index, count, count, 1)
        for i, (count, total) in enumerate(zip(violations, returns, strict=True))
    ]
    content = {
        "train_steps": 100,
        "train_violation_steps": 7,
        "train_interventions": 20,
        "history": history(10, 20, 100, scale=1.0 + index),
        "episodes": episodes,
    }
    return RunResult(arm=arm, index=index, **(content | change))


def summary_of(results: dict[str, list[RunResult]], **settings: Any) -> dict[str, Any]:
    """The summary of a comparison without reference policies."""
    baseline = next(iter(results))
    everything = [run for runs in results.values() for run in runs]
    episodes = episodes_table(everything)
    return {
        "arms": arm_summaries(everything, "project"),
        "references": {},
        "paired_differences": {"baseline": baseline, "arms": paired_differences(episodes, baseline)},
    } | provenance(arms=list(results), **settings)


def provenance(**settings: Any) -> dict[str, Any]:
    """Settings, plant, certificate and versions as in a summary."""
    own = {"env": "ncs_gym/TruckTrailer-v0", "algorithms": ["PPO"], "mode": "project", "seed": 5, "seeds": 2}
    own |= {"steps": 100, "episodes": 2, "intervention_penalty": 0.25, "violation_penalty": 3.0}
    own |= {"hyperparams": {"n_envs": 64, "policy_kwargs": {"net_arch": [8, 8]}}, "certificate": None}
    return {
        "settings": own | settings,
        "plant": {"fingerprint": "f" * 64, "spectral_radius": 0.9},
        "described": {"plant": "linear plant    1 state", "channel": "A sample is taken and sent every step."},
        "certificate": "c" * 64,
        "versions": {"python": "3.11.9", "numpy": "2.1.0"},
    }
