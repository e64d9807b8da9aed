"""CPU time of what a user waits for first, in processes of their own, each after one that imports gymnasium alone.

The time is the best of seven, the ratio to the process before it is the median: what else the machine does slows both.

python benchmarks/import_time.py
"""

import os
import resource
import statistics
import subprocess
import sys

REFERENCE = ["-c", "import gymnasium"]
STARTS = {
    "import gymnasium": REFERENCE,
    "import ncs_gym": ["-c", "import ncs_gym"],
    "import shields": ["-c", "import shields"],
    "ncs --help": ["-m", "experiments", "--help"],
    "ncs compare --help": ["-m", "experiments", "compare", "--help"],
}
REPETITIONS = 7


def cpu_time(arguments: list[str]) -> float:
    """Returns the CPU time of a new Python process and its children [s], the interpreter's own start included."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    subprocess.run([sys.executable, *arguments], env=environment, stdout=subprocess.DEVNULL, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    for name, arguments in STARTS.items():
        pairs = [(cpu_time(REFERENCE), cpu_time(arguments)) for _ in range(REPETITIONS)]
        times, ratio = [time for _, time in pairs], statistics.median(time / reference for reference, time in pairs)
        print(f"{name:<20} {min(times):5.2f} s {ratio:6.1f} times gymnasium", flush=True)


if __name__ == "__main__":
    main()
