"""Counts of finished batches in a file, so that an interrupted campaign continues where it stopped."""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from experiments.attack.monte_carlo_batch import MonteCarloBatch
from experiments.attack.safety_counts import SafetyCounts
from experiments.errors import ResultsError
from experiments.runs.run_store import count_of
from ncs_gym.registration import EPISODE_STEPS
from shields.atomic_write import write_atomically
from shields.json_documents import digest


class CountsStore:
    """Lines of JSON with a checksum, one per batch; only the last line may be incomplete.

    Args:
        path: The file; created if it is missing.
        keys: Key of each case by its name; lines with other keys are kept and not read.
        envs: Number of episodes in a batch.

    Attributes:
        counts: Counts of the finished batches.

    Raises:
        ResultsError: If the file is damaged, or holds what no batch can have counted.
        OSError: If the file cannot be read or written.
    """

    def __init__(self, path: Path, keys: dict[str, str], envs: int) -> None:
        self._path, self._keys, self._envs = path, keys, envs
        self.counts: dict[MonteCarloBatch, SafetyCounts] = {}
        content = path.read_bytes() if path.exists() else b""
        complete = content[: content.rfind(b"\n") + 1]
        for number, line in enumerate(complete.splitlines(), 1):
            self._read(number, line)
        # The process was killed while it was writing; or what is appended would go into another folder's file, too.
        if complete != content or (path.exists() and path.stat().st_nlink > 1):
            write_atomically(path, complete)

    def add(self, batch: MonteCarloBatch, counts: SafetyCounts) -> None:
        """Appends the counts of a batch.

        Raises:
            OSError: If the file cannot be written.
        """
        content = {"key": self._keys[batch.case], "case": batch.case, "index": batch.index, "tally": asdict(counts)}
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"sha256": digest(content), **content}) + "\n")
        self.counts[batch] = counts

    def _read(self, number: int, line: bytes) -> None:
        try:
            document = json.loads(line)
            if document.pop("sha256") != digest(document):
                raise ValueError("checksum")
            index = count_of(document["index"], "index")
            if document["case"] in self._keys and document["key"] == self._keys[document["case"]]:
                counts = _counts_of(document["tally"], self._envs)
                self.counts[MonteCarloBatch(document["case"], index)] = counts
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise ResultsError(f"line {number} of {self._path} was altered; delete it to repeat its batch") from error


def _counts_of(content: dict[str, Any], envs: int) -> SafetyCounts:
    """Returns the counts of a batch that stand in a file.

    Raises:
        ValueError: If a batch of so many episodes cannot have counted this.
        TypeError: If entries are missing or unknown.
    """
    counts = SafetyCounts(**content)
    steps, starts = envs * EPISODE_STEPS, ("episodes", "broken_episodes", "outside_starts")
    for each in fields(counts):
        if each.name != "level":
            most = envs if each.name in starts else steps + envs * (each.name == "unproved")  # which counts starts, too
            count_of(getattr(counts, each.name), each.name, high=most)
    whole = (counts.steps, counts.episodes) == (steps, envs) and counts.lapsed_violations <= counts.lapsed
    if not whole or type(counts.level) is not float or not counts.level >= 0.0:
        raise ValueError("counts")
    return counts
