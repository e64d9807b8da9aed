"""Tallies of finished blocks in a file, a line each, so that an interrupted campaign goes on where it was."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from experiments.attack.monte_carlo_batch import Block
from experiments.attack.safety_counts import Tally
from experiments.errors import ResultsError


class TallyStore:
    """Lines of JSON with a checksum; the last may be torn, no other.

    Args:
        path: File; made if it is missing.
        keys: Of the cases by name; lines with others are left alone and not read.

    Raises:
        ResultsError: If the file is damaged.
        OSError: If it cannot be read or written.
    """

    def __init__(self, path: Path, keys: dict[str, str]) -> None:
        self._path, self._keys = path, keys
        self.tallies: dict[Block, Tally] = {}
        content = path.read_bytes() if path.exists() else b""
        whole = content[: content.rfind(b"\n") + 1]
        for number, line in enumerate(whole.splitlines(), 1):
            self._take(number, line)
        if whole != content:  # killed while it was writing
            os.truncate(path, len(whole))

    def add(self, block: Block, tally: Tally) -> None:
        """Appends a tally.

        Raises:
            OSError: If the file cannot be written.
        """
        content = {"key": self._keys[block.case], "case": block.case, "index": block.index, "tally": tally.counts()}
        line = json.dumps({"sha256": _digest(content), **content}) + "\n"
        with self._path.open("ab") as file:
            file.write(line.encode())
        self.tallies[block] = tally

    def _take(self, number: int, line: bytes) -> None:
        try:
            document = json.loads(line)
            if document.pop("sha256") != _digest(document):
                raise ValueError("checksum")
            if document["key"] == self._keys.get(document["case"]):
                self.tallies[Block(document["case"], document["index"])] = Tally(**document["tally"])
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise ResultsError(
                f"line {number} of {self._path} was altered; delete it to run its block again"
            ) from error


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
