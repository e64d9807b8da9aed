"""Counts of finished batches in a file, so that an interrupted campaign continues where it stopped."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from pathlib import Path

from experiments.attack.monte_carlo_batch import MonteCarloBatch
from experiments.attack.safety_counts import SafetyCounts
from experiments.errors import ResultsError
from experiments.runs.provenance import json_digest


class CountsStore:
    """Lines of JSON with a checksum, one per batch; only the last line may be incomplete.

    Args:
        path: The file; created if it is missing.
        keys: Key of each case by its name; lines with other keys are kept and not read.

    Attributes:
        counts: Counts of the finished batches.

    Raises:
        ResultsError: If the file is damaged.
        OSError: If the file cannot be read or written.
    """

    def __init__(self, path: Path, keys: dict[str, str]) -> None:
        self._path, self._keys = path, keys
        self.counts: dict[MonteCarloBatch, SafetyCounts] = {}
        content = path.read_bytes() if path.exists() else b""
        complete = content[: content.rfind(b"\n") + 1]
        for number, line in enumerate(complete.splitlines(), 1):
            self._read(number, line)
        if complete != content:  # the process was killed while it was writing
            os.truncate(path, len(complete))

    def add(self, batch: MonteCarloBatch, counts: SafetyCounts) -> None:
        """Appends the counts of a batch.

        Raises:
            OSError: If the file cannot be written.
        """
        content = {"key": self._keys[batch.case], "case": batch.case, "index": batch.index, "tally": asdict(counts)}
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"sha256": json_digest(content), **content}) + "\n")
        self.counts[batch] = counts

    def _read(self, number: int, line: bytes) -> None:
        try:
            document = json.loads(line)
            if document.pop("sha256") != json_digest(document):
                raise ValueError("checksum")
            if document["key"] == self._keys.get(document["case"]):
                self.counts[MonteCarloBatch(document["case"], document["index"])] = SafetyCounts(**document["tally"])
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise ResultsError(f"line {number} of {self._path} was altered; delete it to repeat its batch") from error
