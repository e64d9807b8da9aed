"""What a user sees of runs under way."""

from __future__ import annotations

import sys

from tqdm import tqdm

from experiments.runs.training_run import Unit, UnitResult

# How often the progress bar looks for news [s].
REFRESH = 0.5
# Where nobody watches (output to a file), a line this often is enough [s].
QUIET_REFRESH = 20.0


def progress_bar(total_steps: int) -> tqdm:
    """Returns a bar of training and evaluation steps on stderr."""
    interval = REFRESH if sys.stderr.isatty() else QUIET_REFRESH
    return tqdm(total=total_steps, unit="step", unit_scale=True, mininterval=interval, miniters=0, file=sys.stderr)


def show_result(bar: tqdm, unit: Unit, result: UnitResult) -> None:
    """Writes a line about a finished unit above the bar."""
    violating = sum(episode.violation_steps > 0 for episode in result.episodes)
    mean = sum(episode.episode_return for episode in result.episodes) / len(result.episodes)
    training = f"{result.train_violation_steps:,} violating training steps, " if result.train_steps else ""
    text = f"{training}{violating} of {len(result.episodes)} episodes violating, return {mean:.2f}"
    bar.write(f"{unit.name}: {text}", file=sys.stderr)
