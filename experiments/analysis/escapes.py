"""How many episodes left the safe set under Gaussian noise, next to the bound on the probability that one does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from decimal import ROUND_CEILING, Context, Decimal
from typing import Any

from agents.results import Episode
from experiments.analysis.statistics import clopper_pearson


def rounded_up(bound: float) -> str:
    """Returns a bound in two significant digits, no smaller than it is."""
    return f"{float(Context(prec=2, rounding=ROUND_CEILING).create_decimal(Decimal(bound))):.2g}"


def escape_summary(bound: float, steps: int, episodes_by_arm: Mapping[str, Sequence[Episode]]) -> dict[str, Any]:
    """Returns JSON values: the bound for an episode, and what the evaluation episodes of each shielded arm did.

    Args:
        bound: `ncs_gym.escape_probability` of an episode.
        steps: Number of steps of an episode.
        episodes_by_arm: Evaluation episodes, whose starts lie in the safe set, by the name of their arm.
    """
    arms = {}
    for name, episodes in episodes_by_arm.items():
        outside = sum(not episode.largest_level <= 1.0 for episode in episodes)
        arms[name] = {
            "episodes": len(episodes),
            "episodes_outside_set": outside,
            "rate_ci95": list(clopper_pearson(outside, len(episodes))),
        }
    return {"escape_probability": bound, "steps": steps, "arms": arms}


def escape_sentences(summary: dict[str, Any]) -> list[str]:
    """Returns the content of an escape summary in a sentence per arm."""
    bound, sentences = summary["escape_probability"], []
    limit = rounded_up(bound)
    for name, arm in summary["arms"].items():
        low, high = (100.0 * end for end in arm["rate_ci95"])
        sentences.append(
            f"{name}: the state left the safe set in {arm['episodes_outside_set']:,} of {arm['episodes']:,} evaluation "
            f"episodes [{low:.2f}, {high:.2f} %]; under Gaussian noise the probability of that is at most {limit} "
            f"for an episode of {summary['steps']:,} steps."
        )
    if bound >= 1.0:
        sentences.append("A bound of 1 says nothing: it takes a plant with a smaller delta (docs/shield.md).")
    return sentences
