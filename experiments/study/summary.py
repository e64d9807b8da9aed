"""The summary of a study: every arm in every scenario with intervals that cover retraining, and few comparisons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from experiments.analysis.statistics import CONFIDENCE, hierarchical_interval
from experiments.baselines import MARGINS
from experiments.runs.loops import AS_TRAINED

IDEAL, ATTACKED, ATTACKED_IDEAL = "ideal channel", "attacked", "attacked on an ideal channel"
# Arms with a proof: no scenario leaves the assumptions of the certificate.
SOUND = "lookahead"


class Comparison(NamedTuple):
    """The difference first - second of a share of violating episodes, in one scenario.

    Attributes:
        first: Name of an arm.
        second: Name of the arm that is subtracted.
        scenario: Name of the scenario.
    """

    first: str
    second: str
    scenario: str


# Declared before the study was run, the same in every environment. The first is the primary one; the others are judged
# at a level that is divided by their number. Everything else on the page is exploratory.
PRIMARY = Comparison("unshielded", SOUND, ATTACKED)
SECONDARY = (
    Comparison("trusting:20", SOUND, ATTACKED),
    Comparison("penalized", SOUND, ATTACKED),
    Comparison("lqr+psf:20", f"lqr+{SOUND}", ATTACKED),
)
# Families of arms that differ by the margin alone, with the arm that has the proof in their place.
FAMILIES = {
    "governor": f"lqr+{SOUND}",
    "mpc": f"lqr+{SOUND}",
    "lqr+psf": f"lqr+{SOUND}",
    "lqr+trusting": "lqr+shielded",
    "lqr+trusting:lookahead": f"lqr+{SOUND}",
}


def study_summary(comparisons: Mapping[str, dict[str, Any]], episodes: Mapping[str, pd.DataFrame]) -> dict[str, Any]:
    """Returns JSON values: of every environment its arms in every scenario, the declared comparisons and prices."""
    return {"environments": {name: _environment(each, episodes[name]) for name, each in comparisons.items()}}


def difference(
    episodes: pd.DataFrame, compared: Comparison, column: str = "violating", confidence: float = CONFIDENCE
) -> dict[str, Any] | None:
    """Returns the mean difference of two arms and its interval over runs and episodes; None if an arm is missing.

    Runs with the same number have the same seeds and episodes with the same index the same random numbers, so that
    differences are taken episode by episode; runs are resampled, then episodes within each.

    Args:
        episodes: The table of an environment's episodes.
        compared: Arms and scenario.
        column: "violating" or "episode_return".
        confidence: Of the interval.
    """
    played = episodes[episodes["condition"] == compared.scenario]
    values = [_by_run(played[played["arm"] == name], column) for name in (compared.first, compared.second)]
    if not all(each.size for each in values):
        return None
    differences = values[0] - values[1]
    return {
        **compared._asdict(),
        "mean": float(differences.mean()),
        "interval": hierarchical_interval(differences, confidence),
        "confidence": confidence,
        "by_run": differences.mean(axis=1).tolist(),
    }


def _environment(comparison: dict[str, Any], episodes: pd.DataFrame) -> dict[str, Any]:
    settings, known = comparison["settings"], comparison["arms"] | comparison["references"]
    arms = {name: _arm(arm, episodes[episodes["arm"] == name]) for name, arm in known.items()}
    level = 1.0 - (1.0 - CONFIDENCE) / len(SECONDARY)
    declared = [difference(episodes, PRIMARY), *(difference(episodes, each, confidence=level) for each in SECONDARY)]
    return {
        "env": settings["env"],
        "seeds": settings["seeds"],
        "steps": settings["steps"],
        "episodes": settings["episodes"],
        "certificate": comparison["certificate"],
        "trained": list(comparison["arms"]),
        "arms": arms,
        "comparisons": [each for each in declared if each is not None],
        "prices": _prices(arms, episodes),
    }


def _arm(arm: dict[str, Any], episodes: pd.DataFrame) -> dict[str, Any]:
    kept = ("mode", "train_steps", "train_violation_steps", "train_violation_steps_by_run")
    scenarios = {
        scenario: _evaluated(numbers, episodes[episodes["condition"] == scenario])
        for scenario, numbers in ({AS_TRAINED: arm} | arm["conditions"]).items()
    }
    return {key: arm[key] for key in kept} | {"scenarios": scenarios}


def _evaluated(numbers: dict[str, Any], played: pd.DataFrame) -> dict[str, Any]:
    """Returns rate and return of an arm in a scenario, from a comparison, with intervals over runs and episodes.

    A fixed policy is the same in all runs, so that its episodes are as good as one run each. Of few violating episodes
    resampling says little and of none nothing: the interval of the rate reaches as far as the exact one of a single
    proportion, too.
    """
    violating, returns = _by_run(played, "violating"), _by_run(played, "episode_return")
    if numbers["eval_return_ci95_over"] == "episodes":
        violating, returns = violating.reshape(-1, 1), returns.reshape(-1, 1)
    rate, exact = numbers["eval_violation_rate"], numbers["eval_violation_rate_ci95"]
    return {
        "episodes": numbers["eval_episodes"],
        "violating": numbers["eval_violating_episodes"],
        "rate": rate,
        "rate_ci95": exact if rate in (0.0, 1.0) else outer_interval(hierarchical_interval(violating), exact),
        "rate_by_run": numbers["eval_violation_rate_by_run"],
        "return": numbers["eval_return_mean"],
        "return_ci95": hierarchical_interval(returns),
        "return_by_run": numbers["eval_return_by_run"],
        "overridden": numbers["intervention_rate"],
    }


def outer_interval(resampled: list[float] | None, exact: list[float]) -> list[float] | None:
    """Returns the smallest interval that contains both; None where resampling has none."""
    return None if resampled is None else [min(resampled[0], exact[0]), max(resampled[1], exact[1])]


def _by_run(played: pd.DataFrame, column: str) -> np.ndarray:
    """Returns a column by run and episode, shape (runs, episodes)."""
    return played.pivot(index="run", columns="index", values=column).to_numpy(np.float64)


def _prices(arms: Mapping[str, dict[str, Any]], episodes: pd.DataFrame) -> list[dict[str, Any]]:
    """Returns what the proof costs beside the best arm that violates anywhere, of trained arms and of regulators."""
    prices = []
    for sound in (SOUND, f"lqr+{SOUND}"):
        rivals = {
            name: arm["scenarios"][AS_TRAINED]["return"]
            for name, arm in arms.items()
            if any(each["violating"] for each in arm["scenarios"].values())
            and (arm["train_steps"] > 0) == (not sound.startswith("lqr"))
        }
        if sound in arms and rivals:
            best = max(rivals, key=lambda name: rivals[name])
            prices.append(difference(episodes, Comparison(sound, best, AS_TRAINED), "episode_return"))
    return prices


def margins_needed(env: Mapping[str, Any], family: str, scenario: str) -> str | None:
    """Returns the arm of a family that violates in no episode of a scenario with the smallest margin; None for none."""
    return next(
        (name for name in members(env, family) if env["arms"][name]["scenarios"][scenario]["violating"] == 0), None
    )


def members(env: Mapping[str, Any], family: str) -> Sequence[str]:
    """Returns the arms of a family that an environment has, the smallest margin first."""
    names = {0: family} | {margin: f"{family}:{margin}" for margin in MARGINS}
    return [names[margin] for margin in sorted(names) if names[margin] in env["arms"]]
