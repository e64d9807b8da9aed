"""What was tuned for each arm of the benchmark by itself, with the same budget for all (`benchmarks.learning`)."""

from __future__ import annotations

import json
from functools import cache
from importlib import resources
from typing import Any

from experiments.baselines.controllers import RegulatorWeights


def tuned_weights(env_id: str, arm: str) -> RegulatorWeights:
    """Returns the weights of an arm's regulator in a registered environment; the defaults where none were tuned."""
    return RegulatorWeights(**_tuned().get(env_id, {}).get(arm, {}))


def tuned_training(env_id: str, arm: str) -> dict[str, Any]:
    """Returns settings of an arm's training, in the place of those of the command; nothing where none were tuned.

    They are `hyperparams` (changes), `violation_penalty` and `lagrangian` (entries of `LagrangianSettings`).
    """
    return _tuned().get(env_id, {}).get(arm, {})


@cache
def _tuned() -> dict[str, dict[str, dict[str, Any]]]:
    return json.loads(resources.files("experiments.baselines").joinpath("tuned.json").read_text("utf-8"))
