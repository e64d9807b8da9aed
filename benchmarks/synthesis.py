"""How long the certified synthesis takes and how large its sets are, over plants of growing size.

    python benchmarks/synthesis.py [--seeds 3] [--largest 12]

Random plants are stable and their error set reaches 0.6 of the box's half-width, which leaves little room.
Volumes are relative to the largest ellipsoid in the box, which no disturbance at all would allow. Import time is
excluded; every certificate is verified exactly.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
from tqdm import tqdm

from ncs_gym import LinearPlant, certified_error_set, truck_trailer
from shields import Infeasible, synthesize, verify

SIZES = ((2, 1), (4, 1), (4, 2), (6, 2), (8, 3), (12, 3))
ERROR_RADIUS = 0.6


def random_plant(seed: int, n: int, m: int) -> LinearPlant:
    """A stable plant in the unit box whose error set has a largest half-width of ERROR_RADIUS."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A *= rng.uniform(0.4, 0.9) / np.abs(np.linalg.eigvals(A)).max()
    plant = LinearPlant(A=A, B=rng.standard_normal((n, m)), box=np.eye(n), u_max=1.0, dt=0.1, gamma=1e-3)
    radius = np.sqrt(np.diag(certified_error_set(plant).Sigma).max())
    return replace(plant, gamma=1e-3 * (ERROR_RADIUS / radius) ** 2)


def measure(name: str, plants: list[LinearPlant]) -> None:
    seconds, volumes, missing = [], [], 0
    line = tqdm(bar_format="  {desc} [{elapsed}]", leave=False, disable=None)
    for plant in plants:
        start = time.perf_counter()
        try:
            certificate = synthesize(plant, safe_set="ellipsoid", progress=line.set_description_str)
        except Infeasible:
            missing += 1
        else:
            volumes.append(certificate.provenance["volume_of_box_ellipsoid"])
            assert verify(certificate, plant).valid
        seconds.append(time.perf_counter() - start)
    line.close()
    span = f"{min(volumes):.4f} .. {max(volumes):.4f}" if volumes else "-"
    print(f"{name:42s}{np.median(seconds):9.2f}{max(seconds):9.2f}{span:>20s}{missing:>12d}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--largest", type=int, default=12)
    options = parser.parse_args()
    print(f"{'':42s}{'seconds':>18s}{'volume / ellipsoid':>20s}")
    print(f"{'plant':42s}{'median':>9s}{'longest':>9s}{'least .. most':>20s}{'infeasible':>12s}", flush=True)
    for mass in (1000.0, 4000.0):
        for gamma, what in ((5e-4, ""), (2e-3, ", D radius doubled")):
            Q = 4e-4 if what else 1e-4
            plant = truck_trailer(mass=mass, gamma=gamma, process_noise_cov=Q * np.eye(2))
            measure(f"truck-trailer, {mass:.0f} kg{what}", [plant])
    for n, m in SIZES:
        if n <= options.largest:
            plants = [random_plant(100 * n + seed, n, m) for seed in range(options.seeds)]
            measure(f"random, n = {n}, m = {m}, {options.seeds} seeds", plants)


if __name__ == "__main__":
    main()
