"""How often recorded ages of the newest sample would have broken a contract, with intervals that allow for bursts."""

from __future__ import annotations

from typing import Any

import numpy as np

# A block is this many times as long as the largest age: what happens in one hardly depends on the one before.
_AGES_PER_BLOCK = 10
_RESAMPLES = 2000


def broken_contracts(ages: np.ndarray, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Returns, for every largest age up to the recorded one, in what fraction of steps it was exceeded.

    The interval is that of a circular block bootstrap of the steps (95 %), blocks being ten times as long as the
    largest age. Where an age was never exceeded it ends at 3 / (number of blocks), what is excluded at that level if
    blocks are independent. `halves` are the two halves of the record.

    Args:
        ages: Age of the newest sample at every step, shape (k,).
        rng: Draws the blocks.

    Returns:
        Rows of JSON values, from the age that was kept down to 0.
    """
    largest, steps = int(ages.max()), len(ages)
    block = min(_AGES_PER_BLOCK * (largest + 1), steps)
    blocks = -(-steps // block)
    starts = rng.integers(steps, size=(_RESAMPLES, blocks))
    halves = np.array_split(ages, 2)
    rows = []
    for age in range(largest, -1, -1):
        broken = ages > age
        sums = np.concatenate([[0], np.cumsum(np.concatenate([broken, broken[:block]]))])
        resampled = (sums[starts + block] - sums[starts]).sum(axis=1) / (blocks * block)
        low, high = np.quantile(resampled, [0.025, 0.975])
        if not broken.any():
            low, high = 0.0, min(3.0 / blocks, 1.0)
        edges = np.diff(np.concatenate([[0], broken.astype(int)]))
        rows.append(
            {
                "max_age": age,
                "broken": float(broken.mean()),
                "broken_ci95": [float(low), float(high)],
                "times": int((edges > 0).sum()),
                "halves": [float((half > age).mean()) for half in halves],
            }
        )
    return rows
