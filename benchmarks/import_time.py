"""CPU time of what a user waits for first, next to `import gymnasium`; each in a process of its own, the best of five.

python benchmarks/import_time.py
"""

import os
import resource
import subprocess
import sys

STARTS = {
    "import gymnasium": ["-c", "import gymnasium"],
    "import ncs_gym": ["-c", "import ncs_gym"],
    "import shields": ["-c", "import shields"],
    "ncs --help": ["-m", "experiments", "--help"],
    "ncs compare --help": ["-m", "experiments", "compare", "--help"],
}
REPETITIONS = 5


def cpu_time(arguments: list[str]) -> float:
    """Returns the CPU time of a new Python process and its children [s], the interpreter's own start included."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    subprocess.run([sys.executable, *arguments], env=environment, stdout=subprocess.DEVNULL, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    for name, arguments in STARTS.items():
        print(f"{name:<20} {min(cpu_time(arguments) for _ in range(REPETITIONS)):5.2f} s", flush=True)


if __name__ == "__main__":
    main()
