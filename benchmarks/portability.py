"""How often the certificate of a plant is the same file, whichever kernels of linear algebra searched for it (x86).

python benchmarks/portability.py [--plants 200] [--kernels Haswell Prescott]

Plants are sampled from random models in continuous time with 2 to 6 states and 1 or 2 inputs, stable or not. A process
per kernel of OpenBLAS synthesizes them all; then each certificate is verified by a process with the next one's kernels.
"""

import argparse
import functools
import os
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np

from ncs_gym import ChannelContract, LinearPlant
from shields import Certificate, Infeasible, synthesize, verify

ROOT = Path(__file__).resolve().parents[1]
KERNELS = ("Haswell", "SkylakeX", "Sandybridge", "Nehalem", "Prescott")


@functools.cache
def can_run(kernels: str) -> bool:
    """Whether a product of matrices with these kernels ends; without their instructions the processor stops it."""
    product = "import numpy as np; np.ones((64, 64)) @ np.ones((64, 64)); np.linalg.inv(np.eye(64))"
    environment = os.environ | {"OPENBLAS_CORETYPE": kernels}
    return subprocess.run([sys.executable, "-c", product], env=environment, capture_output=True).returncode == 0


def random_plant(index: int) -> tuple[LinearPlant, ChannelContract | None]:
    """Returns a plant, and a contract where it is unstable and for half of the others."""
    rng = np.random.default_rng([7, index])
    n, m = 2 + index % 5, 1 + index // 5 % 2
    A, B = rng.standard_normal((n, n)), rng.standard_normal((n, m))
    is_stable = index % 3 != 0
    if is_stable:
        A = A - 0.5 * float(np.abs(A).sum(axis=1).max()) * np.eye(n)
    bounds = {"disturbance_bound": 0.004 * np.ones(n), "sensor_bound": 0.003 * np.ones(n), "initial_bound": 0.003}
    model = (A, B, np.eye(n), np.zeros((n, m)))
    plant = LinearPlant.from_statespace(model, 0.1, box=np.ones(n), u_max=np.full(m, 2.0), **bounds)
    return plant, ChannelContract(1 + index % 3) if index % 2 or not is_stable else None


def make(folder: Path, count: int) -> None:
    for index in range(count):
        plant, contract = random_plant(index)
        try:
            synthesize(plant, contract=contract, safe_set="ellipsoid").save(folder / f"{index}.json")
        except Infeasible:
            continue


def judge(folder: Path) -> None:
    files = sorted(folder.glob("*.json"))
    print(sum(verify(Certificate.load(file), random_plant(int(file.stem))[0]).valid for file in files))


def started(kernels: str, *arguments: str) -> subprocess.Popen:
    environment = os.environ | {"OPENBLAS_CORETYPE": kernels, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, __file__, *arguments]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


def volume(file: Path) -> float:
    return Certificate.load(file).provenance["volume_of_box_ellipsoid"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--plants", type=int, default=200)
    parser.add_argument("--kernels", nargs="+", choices=KERNELS, help="default: all that run here")
    parser.add_argument("--make", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--judge", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    given.kernels = given.kernels or list(filter(can_run, KERNELS))
    warnings.simplefilter("ignore")
    if given.make:
        return make(given.make, given.plants)
    if given.judge:
        return judge(given.judge)
    with tempfile.TemporaryDirectory() as root:
        folders = {kernels: Path(root) / kernels for kernels in given.kernels}
        processes = []
        for kernels, folder in folders.items():
            folder.mkdir()
            processes.append(started(kernels, "--plants", str(given.plants), "--make", str(folder)))
        assert not any(process.wait() for process in processes)
        first, *others = folders.values()
        names = sorted(file.name for file in first.glob("*.json"))
        print(f"{len(names)} of {given.plants} random plants have a certificate")
        for folder in others:
            assert sorted(file.name for file in folder.glob("*.json")) == names
            same = sum((first / name).read_bytes() == (folder / name).read_bytes() for name in names)
            ratios = [abs(volume(first / name) / volume(folder / name) - 1.0) for name in names]
            print(
                f"{first.name} and {folder.name}: {same} files are equal, volumes differ by at most {max(ratios):.1e}"
            )
        for maker, judge_kernels in zip(given.kernels, [*given.kernels[1:], given.kernels[0]], strict=True):
            printed, _ = started(judge_kernels, "--judge", str(folders[maker])).communicate()
            print(f"made under {maker}, verified under {judge_kernels}: {int(printed)} of {len(names)} hold")


if __name__ == "__main__":
    main()
