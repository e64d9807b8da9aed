"""Asks OSV (https://osv.dev) about every version in constraints.txt; OSV does not depend on the index of packages.

Ends with 0 if no vulnerability is known, with 1 after a table of those that are, and with 2 and one sentence if
something could not be looked up: then nothing is known of any package.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

_ROOT = Path(__file__).resolve().parent.parent
_OSV = "https://api.osv.dev/v1/query"
_FOUND, _NOT_LOOKED_UP = 1, 2
_LONGEST_REASON = 160


def main() -> int:
    """Returns the exit code; `OSV_URL` in the environment replaces the address of the service."""
    address = os.environ.get("OSV_URL", _OSV)
    command = [sys.executable, "-m", "pip_audit", "--vulnerability-service", "osv", "--osv-url", address, "--strict"]
    command += [
        "--no-deps",
        "--disable-pip",
        "--progress-spinner",
        "off",
        "--requirement",
        str(_ROOT / "constraints.txt"),
    ]
    run = subprocess.run(command, capture_output=True, text=True)
    if run.returncode == 0 or (run.returncode == _FOUND and run.stdout.strip()):
        print(run.stdout + run.stderr, end="")
        return run.returncode
    reason = (run.stderr.strip().splitlines() or [f"pip-audit ended with exit code {run.returncode}"])[-1][
        :_LONGEST_REASON
    ]
    print(f"audit: nothing was audited, because {address} did not answer as OSV does ({reason})", file=sys.stderr)
    return _NOT_LOOKED_UP


if __name__ == "__main__":
    sys.exit(main())
