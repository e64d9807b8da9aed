"""Numbers of plants, before and after a rearrangement: `python -m benchmarks.plant_numbers`.

Commands: record, compare.

Of the registered and the published plants and of 400 random ones: matrices, rows, ends and inputs have to be equal to
the bit, sets to a part in 1e12.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from operator import attrgetter
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import tyro

from benchmarks.commands import run
from benchmarks.hashes import registered
from benchmarks.published import plant_of, published
from benchmarks.random_plants import badly_scaled_plant, random_plant, slow_and_fast_plant
from ncs_gym import Ball, Bounds, Box, Limits, LinearPlant, Model, Through

RANDOM, SAME_SET = 100, 1e-12
EXACT = (
    *("A", "B", "H", "dt", "box", "box_ends", "input_ends", "mixed_rows", "mixed_ends", "gamma"),
    *("operating_state", "operating_input", "step_offset", "own_limits"),
    *("input_middle", "input_half", "reach", "between_samples", "kept_ends", "step_rows", "within_step"),
    *("process_noise.covariance", "sensor_noise.covariance", "initial_noise.covariance"),
)
SETS = (
    *("disturbance", "allowed_disturbance", "nominal_disturbance", "sensor_error", "nominal_sensor_error"),
    *("initial_error", "nominal_initial_error"),
)
File = tyro.conf.Positional[Path]


def record(file: File) -> None:
    """Writes the numbers of all plants to a file."""
    arrays: dict[str, Any] = {key: each for plant in numbers() for key, each in plant.items()}
    np.savez_compressed(file, **arrays)


def compare(file: File) -> None:
    """Prints which numbers are others than those of a file; exits with 1 if any is."""
    before, others, count = np.load(file), 0, 0
    for plant in numbers():
        for key, value in plant.items():
            count, kept = count + 1, before[key]
            if not _is_same(kept, value, SAME_SET if key.split()[-1] in SETS else 0.0):
                others += 1
                print(f"{key}: {value.tolist()}, before {kept.tolist()}")
    print(f"{others} of {count} numbers differ, {len(before.files)} before")
    raise SystemExit(bool(others) or count != len(before.files))


def _is_same(one: np.ndarray, other: np.ndarray, tolerance: float) -> bool:
    if one.shape != other.shape or not tolerance:
        return one.shape == other.shape and one.tobytes() == other.tobytes()
    widths = np.sqrt(np.diag(one))
    return bool((np.abs(one - other) <= tolerance * np.outer(widths, widths)).all())


def numbers() -> Iterator[dict[str, np.ndarray]]:
    """Yields the numbers of each plant, by its name and theirs."""
    for name, plant in plants():
        found = {key: np.array(attrgetter(key)(plant), dtype=None) for key in EXACT}
        found = {key: np.array(str(each)) if each.dtype == object else each for key, each in found.items()}
        found |= {key: getattr(plant, key).shape_matrix for key in SETS}
        found["file"] = np.array(json.dumps(plant.document, sort_keys=True))
        found["text"] = np.array(str(plant))
        yield {f"{name} {key}": each for key, each in found.items()}


def plants() -> Iterator[tuple[str, LinearPlant]]:
    """Yields registered, published and random plants with their names."""
    warnings.simplefilter("ignore", UserWarning)
    for name in registered():
        env: Any = gym.make(name).unwrapped
        yield name, env.plant
    yield from ((name, plant_of(name)) for name in published())
    for seed in range(RANDOM):
        n, m, p = 1 + seed % 5, 1 + seed % 2, None if seed % 3 else 1
        yield f"random {seed}", random_plant(seed, n, m, p)
        yield f"scaled {seed}", badly_scaled_plant(seed, max(n, 2), m, 4.0, 0.9)
        yield f"slow {seed}", slow_and_fast_plant(seed, in_own_units=bool(seed % 2))
        yield f"limited {seed}", limited(seed)


def limited(seed: int) -> LinearPlant:
    """Returns a plant of two ends everywhere: outputs, coupled inputs, disturbances; with delays, rates, offsets."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 5)), int(rng.integers(1, 3))
    A, B = rng.standard_normal((n, n)), rng.standard_normal((n, m))
    A *= rng.uniform(0.4, 0.9) / max(np.abs(np.linalg.eigvals(A)).max(), 0.1)
    x, u = rng.uniform(-3.0, 3.0, n), rng.uniform(-3.0, 3.0, m)
    of_x, of_u = rng.standard_normal(n), rng.standard_normal(m)
    E, widths = rng.standard_normal((n, 2)), rng.uniform(1e-3, 5e-3, 2)
    state = x - rng.uniform(0.5, 2.0, n), np.where(rng.random(n) < 0.2, np.inf, x + 1.0)
    applied = u - rng.uniform(0.5, 2.0, m), u + rng.uniform(0.5, 2.0, m)
    rows: list[Any] = [(of_x, None, of_x @ x - 1.0, of_x @ x + rng.uniform(1.0, 2.0))][: seed % 2]
    rows += [(of_x, of_u, of_x @ x + of_u @ u - 1.5, of_x @ x + of_u @ u + 1.0)][: seed // 2 % 2]
    disturbances = Through(E, Box(-widths, 1.5 * widths)), Through(E, widths), Ball(widths[0]), np.full(n, widths[1])
    model = Model(A, B, np.eye(n), 0.1, (x, u), x - A @ x - B @ u if seed % 5 == 0 else None)
    return LinearPlant(
        model.with_delays(seed // 4 % 3),
        Limits(state, applied, rows, 0.2 if seed // 7 % 3 == 1 else None),
        Bounds(disturbances[seed // 3 % 4], Ball(1e-3), np.full(n, 2e-3)),
    )


if __name__ == "__main__":
    run(__doc__, (record, compare))
