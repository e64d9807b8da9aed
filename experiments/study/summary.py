"""The summary of a study: what its comparisons found, differences between all pairs of arms, and scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from experiments.analysis.statistics import all_pairs, bootstrap_interval, interquartile_mean, paired_difference

# Arms with a proof, which a page compares all others with.
SOUND_ARMS = ("shielded", "lookahead")
# The policies behind the shield that have a score of 0 and of 1.
SCORE_ZERO, SCORE_ONE = "random+shielded", "lqr+shielded"
# Measures in which pairs of arms differ, with the key of their numbers per run.
MEASURES = {"return": "eval_return_by_run", "violating episodes": "eval_violation_rate_by_run"}
# What a page shows of an arm, and of its evaluation under a condition.
_ARM = ("mode", "train_steps", "train_violation_steps", "train_violation_steps_by_run")
_EVALUATION = (
    "eval_episodes",
    "eval_violating_episodes",
    "eval_violation_rate",
    "eval_violation_rate_ci95",
    "eval_episodes_outside_set",
    "eval_return_mean",
    "eval_return_ci95",
    "intervention_rate",
)


def study_summary(comparisons: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """Returns JSON values: per environment its arms, pairs and prices of soundness, and scores over environments.

    Args:
        comparisons: Content of each comparison's summary.json by the environment's short name.
    """
    environments = {name: _environment(comparison) for name, comparison in comparisons.items()}
    arms = [each["arms"] for each in environments.values()]
    return {"environments": environments, "scores": _scores(arms)}


def page_summary(summary: dict[str, Any]) -> dict[str, Any]:
    """Returns the part of a study's summary that pages show: pairs with a sound arm, and no numbers of single runs."""
    environments = {}
    for name, env in summary["environments"].items():
        pairs = {
            measure: [pair for pair in found if {pair["first"], pair["second"]} & set(SOUND_ARMS)]
            for measure, found in env["pairs"].items()
        }
        environments[name] = env | {"arms": {arm: _shown(each) for arm, each in env["arms"].items()}, "pairs": pairs}
    return summary | {"environments": environments}


def sound_counterpart(name: str) -> str | None:
    """Returns the arm that differs from a trusting one only in that it has the error set; None for other arms."""
    if "trusting" not in name:
        return None
    named = name.replace("trusting:lookahead", "lookahead").replace("trusting", "shielded")
    return named.replace("shielded at test", "shield at test")


def _environment(comparison: dict[str, Any]) -> dict[str, Any]:
    """Returns what a study keeps of a comparison."""
    arms, settings = comparison["arms"] | comparison["references"], comparison["settings"]
    return {
        "env": settings["env"],
        "seeds": settings["seeds"],
        "steps": settings["steps"],
        "episodes": settings["episodes"],
        "certificate": comparison["certificate"],
        "trained": list(comparison["arms"]),
        "arms": arms,
        "pairs": {
            measure: all_pairs({name: arm[key] for name, arm in arms.items()}) for measure, key in MEASURES.items()
        },
        "prices": _prices(arms),
    }


def _prices(arms: Mapping[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns, for each arm without the error set beside the same one with it, how much more the latter overrides."""
    prices = []
    for name, arm in arms.items():
        sound = sound_counterpart(name)
        if sound is not None and sound in arms:
            measures = ("intervention_rate_by_run", MEASURES["return"])
            overridden, returns = (paired_difference(arms[sound][key], arm[key]) for key in measures)
            prices.append({"trusting": name, "sound": sound, "overridden": overridden, "return": returns})
    return prices


def _scores(environments: Sequence[Mapping[str, dict[str, Any]]]) -> dict[str, Any]:
    """Returns the interquartile mean over all runs of the score of each arm that every environment has.

    The score of a run is 0 for the mean return of random actions behind the shield and 1 for that of the
    linear-quadratic regulator behind it; its interval is from resampling the runs of each environment by themselves.
    """
    shared = [name for name in environments[0] if all(name in arms for arms in environments)]
    ends = [[arms[end]["eval_return_mean"] for end in (SCORE_ZERO, SCORE_ONE) if end in arms] for arms in environments]
    if any(len(each) < 2 or each[0] == each[1] for each in ends):
        return {}
    scores = {}
    for name in shared:
        strata = [
            [(value - zero) / (one - zero) for value in arms[name][MEASURES["return"]]]
            for arms, (zero, one) in zip(environments, ends, strict=True)
        ]
        scores[name] = {
            "iqm": float(interquartile_mean([score for stratum in strata for score in stratum])),
            "ci95": bootstrap_interval(*strata, statistic=interquartile_mean),
        }
    return scores


def _shown(arm: dict[str, Any]) -> dict[str, Any]:
    """Returns what pages show of an arm."""
    conditions = {name: {key: each[key] for key in _EVALUATION} for name, each in arm["conditions"].items()}
    return {key: arm[key] for key in (*_ARM, *_EVALUATION)} | {"conditions": conditions}
