"""How many episodes left the safe set under Gaussian noise, next to the bound on the probability that one does."""

from __future__ import annotations

from collections.abc import Mapping
from decimal import ROUND_CEILING, Context, Decimal
from typing import Any

from experiments.analysis.statistics import clopper_pearson


def rounded_up(bound: float) -> str:
    """Returns a bound in two significant digits, no smaller than it is."""
    return f"{float(Context(prec=2, rounding=ROUND_CEILING).create_decimal(Decimal(bound))):.2g}"


def gaussian_summary(bound: float, steps: int, arms: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """Returns JSON values: the bound for an episode, and what the evaluation episodes of each shielded arm did.

    Args:
        bound: `ncs_gym.escape_probability` of an episode.
        steps: Number of steps of an episode.
        arms: What `arm_summary` returns of each arm whose claim is the safe set, in which its episodes start.
    """
    counts = {name: (arm["eval_episodes"], arm["eval_episodes_outside_set"]) for name, arm in arms.items()}
    return {
        "escape_probability": bound,
        "steps": steps,
        "arms": {
            name: {
                "episodes": episodes,
                "episodes_outside_set": outside,
                "rate_ci95": clopper_pearson(outside, episodes),
            }
            for name, (episodes, outside) in counts.items()
        },
    }


def gaussian_sentences(summary: dict[str, Any]) -> list[str]:
    """Returns what `gaussian_summary` found in a sentence per arm."""
    bound, sentences = summary["escape_probability"], []
    for name, arm in summary["arms"].items():
        low, high = (100.0 * end for end in arm["rate_ci95"])
        sentences.append(
            f"{name}: the state left the safe set in {arm['episodes_outside_set']:,} of {arm['episodes']:,} evaluation "
            f"episodes [{low:.2f}, {high:.2f} %]; under Gaussian noise the probability of that is at most "
            f"{rounded_up(bound)} for an episode of {summary['steps']:,} steps."
        )
    if bound >= 1.0:
        sentences.append("A bound of 1 says nothing: it takes a plant with a smaller delta (docs/shield.md).")
    return sentences
