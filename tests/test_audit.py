"""`make audit` asks OSV alone, and says in one sentence when it could not."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.command import environment

ROOT = Path(__file__).resolve().parent.parent
# Stands in for pip-audit: ends as it did when it was tried without a network, with and without vulnerabilities.
STANDS_IN = """
import json, os, sys
print(json.dumps(sys.argv[1:]), file=open(os.environ["ASKED"], "w"))
print(os.environ["PRINTS"], end="")
print(os.environ["COMPLAINS"], file=sys.stderr)
sys.exit(int(os.environ["ENDS_WITH"]))
"""


@pytest.mark.cases(2)
@pytest.mark.parametrize(
    ("prints", "complains", "ends", "code", "words"),
    [
        ("Name Version ID\n", "Found 1 known vulnerability in 1 package", 1, 1, "Name Version ID\nFound 1 known"),
        ("", "Traceback (most recent call last):\nOSError: no network", 1, 2, "nothing was audited"),
        ("", "", 3, 2, "exit code 3"),
    ],
)
def test_what_cannot_be_looked_up_is_no_result(prints, complains, ends, code, words, tmp_path):
    (tmp_path / "pip_audit").mkdir()
    (tmp_path / "pip_audit" / "__init__.py").touch()
    (tmp_path / "pip_audit" / "__main__.py").write_text(STANDS_IN)
    given = {"PRINTS": prints, "COMPLAINS": complains, "ENDS_WITH": str(ends), "ASKED": str(tmp_path / "asked")}
    command = [sys.executable, str(ROOT / ".ci" / "audit.py")]
    run = subprocess.run(command, capture_output=True, text=True, env=environment(tmp_path, **given), timeout=120)
    assert run.returncode == code
    assert words in run.stdout + run.stderr
    if code == 2:
        assert run.stdout == ""
        assert len(run.stderr.splitlines()) == 1
    asked = json.loads((tmp_path / "asked").read_text())
    assert asked[asked.index("--vulnerability-service") + 1] == "osv"
    assert {"--strict", "--no-deps", "--disable-pip"} <= set(asked)  # the index of packages is not asked
