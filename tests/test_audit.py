"""`make audit` asks OSV alone, and says in one sentence when it could not."""

import http.server
import json
import socket
import subprocess
import sys
import threading
from contextlib import contextmanager
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


def audit(*first, **changes):
    """Runs what `make audit` runs."""
    command = [sys.executable, str(ROOT / ".ci" / "audit.py")]
    return subprocess.run(command, capture_output=True, text=True, env=environment(*first, **changes), timeout=120)


def test_make_audit_runs_it():
    recipe = (ROOT / "Makefile").read_text().partition("\naudit:")[2].partition("\n\n")[0]
    assert ".ci/audit.py" in recipe


@pytest.mark.parametrize(
    ("prints", "complains", "ends", "code", "words"),
    [
        ("", "No known vulnerabilities found", 0, 0, "No known vulnerabilities found"),
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
    run = audit(tmp_path, **given)
    assert run.returncode == code
    assert words in run.stdout + run.stderr
    if code == 2:
        assert run.stdout == ""
        assert len(run.stderr.splitlines()) == 1
    asked = json.loads((tmp_path / "asked").read_text())
    assert asked[asked.index("--vulnerability-service") + 1] == "osv"
    assert {"--strict", "--no-deps", "--disable-pip"} <= set(asked)  # the index of packages is not asked


@contextmanager
def osv(answer):
    """A server that answers as OSV does, and the packages that it was asked about."""
    asked = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_POST(self):
            query = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            asked.append((query["package"]["name"], query["version"]))
            body = answer(*asked[-1])
            self.send_response(200 if body is not None else 500)
            self.end_headers()
            self.wfile.write(body or b"")

        def log_message(self, *arguments):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/v1/query", asked
        server.shutdown()


def vulnerable(name, version):
    known = {"id": "PYSEC-0000-1", "affected": [], "summary": "of this test", "modified": "2020-01-01T00:00:00Z"}
    return json.dumps({"vulns": [known]} if name == "filterpy" else {}).encode()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("answer", "code", "words"),
    [
        (lambda name, version: b"{}", 0, "No known vulnerabilities found"),
        (vulnerable, 1, "PYSEC-0000-1"),
        (lambda name, version: None, 2, "nothing was audited"),
        (lambda name, version: b"no JSON", 2, "nothing was audited"),
    ],
)
def test_every_version_is_asked_for_and_what_is_known_is_printed(answer, code, words):
    pytest.importorskip("pip_audit", reason="the extra [audit] is not installed")
    with osv(answer) as (address, asked):
        run = audit(OSV_URL=address)
    assert run.returncode == code, run.stderr
    assert words in run.stdout + run.stderr
    if code < 2:
        lines = (ROOT / "constraints.txt").read_text().splitlines()
        pinned = [line for line in lines if "==" in line and not line.startswith("#")]
        assert len(set(asked)) == len(pinned)


@pytest.mark.slow
def test_without_a_network_it_says_so_in_one_sentence():
    pytest.importorskip("pip_audit", reason="the extra [audit] is not installed")
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        run = audit(OSV_URL=f"http://127.0.0.1:{unused.getsockname()[1]}/v1/query")
    assert run.returncode == 2
    assert run.stderr.startswith("audit: nothing was audited")
    assert len(run.stderr.splitlines()) == 1
