"""Random plants with bad units and slow beside fast modes: is what is found for them also verified, in any units?

    python benchmarks/badly_scaled.py [--plants 100]

Time constants are spread over four powers of ten, and every state and input has a unit of its own, spread over six. A
plant is synthesized as it is and once more with all units 1: the outcome should be the same, and "lost", found but not
verified in exact arithmetic, should be none. Disturbances and errors are a share of the limits, drawn from .1 to 3 %.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter

import numpy as np
from scipy.stats import ortho_group
from tqdm import tqdm

from ncs_gym import LinearPlant
from shields import Infeasible, synthesize

STEP = 0.1
TIME_CONSTANTS, UNITS = (0.03, 300.0), (1e-3, 1e3)


def random_plant(seed: int, *, in_own_units: bool) -> LinearPlant:
    """A stable plant of two to four states; modes are mixed, limits have two different ends."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(2, 5)), int(rng.integers(1, 3))
    spread = np.log(TIME_CONSTANTS)
    modes = -1.0 / np.exp(rng.uniform(*spread, n))
    mixed = np.eye(n) + 0.5 * ortho_group.rvs(n, random_state=rng)
    A = mixed @ np.diag(modes) @ np.linalg.inv(mixed)
    B = mixed @ (modes[:, None] * rng.standard_normal((n, m)))
    low, high = -rng.uniform(0.5, 1.0, n), rng.uniform(0.5, 1.0, n)
    ends = -rng.uniform(0.5, 1.0, m), rng.uniform(0.5, 1.0, m)
    share = np.exp(rng.uniform(np.log(0.001), np.log(0.03)))
    units = np.exp(rng.uniform(*np.log(UNITS), n + m)) if in_own_units else np.ones(n + m)
    x, u = units[:n], units[n:]
    return LinearPlant.from_statespace(
        ((x[:, None] * A) / x, (x[:, None] * B) / u, np.eye(n), 0),
        STEP,
        state_limits=(x * low, x * high),
        input_limits=(u * ends[0], u * ends[1]),
        disturbance_bound=share * x * np.minimum(1.0, STEP * np.abs(modes).min() * 10.0),
        sensor_bound=share * x,
        initial_bound=share * x,
    )


def outcome(plant: LinearPlant) -> tuple[str, float]:
    """What the synthesis says, and how long it takes [s of processor time]."""
    start = time.process_time()
    try:
        synthesize(plant)
    except Infeasible as infeasible:
        return ("lost" if "in exact arithmetic" in str(infeasible) else "refused"), time.process_time() - start
    return "certified", time.process_time() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plants", type=int, default=100)
    options = parser.parse_args()
    counts: Counter[tuple[str, str]] = Counter()
    seconds: dict[str, list[float]] = {"certified": [], "refused": [], "lost": []}
    for seed in tqdm(range(options.plants), unit="plant", leave=False, disable=None):
        (own, taken), (plain, _) = (outcome(random_plant(seed, in_own_units=each)) for each in (True, False))
        counts[own, plain] += 1
        seconds[own].append(taken)
        if own != plain or "lost" in (own, plain):
            tqdm.write(f"plant {seed}: {own} in its own units, {plain} with units 1")
    print(f"{'in its own units':18s}{'with units 1':14s}{'plants':>6s}")
    for (own, plain), count in sorted(counts.items()):
        print(f"{own:18s}{plain:14s}{count:6d}")
    for own, times in seconds.items():
        if times:
            print(f"{own} in own units: median {np.median(times):.1f} s, longest {max(times):.1f} s of processor time")


if __name__ == "__main__":
    main()
