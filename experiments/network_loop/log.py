"""The log of a control loop over a network: one row per step in CSV files, which are rotated."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from ncs_gym.reading import LARGEST_LINE, open_file

# Rows of a file, 5.5 hours at 50 Hz.
ROWS_PER_FILE = 1_000_000


class StepLog:
    """Writes rows of one kind to FOLDER/NAME-000.csv, then to NAME-001.csv, and so on.

    Args:
        folder: Folder, which exists.
        name: What the rows are about.
        columns: Their names.
        rows_per_file: After how many rows the next file begins.
    """

    def __init__(self, folder: Path, name: str, columns: list[str], rows_per_file: int = ROWS_PER_FILE) -> None:
        self._folder, self._name, self._columns, self._most = folder, name, columns, rows_per_file
        self._number, self._rows = -1, rows_per_file
        self._file: Any = None

    def write(self, row: list[Any]) -> None:
        """Writes a row; numbers as Python prints them, so that floats are exact.

        Raises:
            OSError: If the file cannot be written.
        """
        if self._rows >= self._most:
            self.close()
            self._number, self._rows = self._number + 1, 0
            self._file = open(self._folder / f"{self._name}-{self._number:03d}.csv", "w", newline="")  # noqa: SIM115
            self._writer = csv.writer(self._file)
            self._writer.writerow(self._columns)
        self._writer.writerow(row)
        self._rows += 1

    def close(self) -> None:
        """Closes the file."""
        if self._file is not None:
            self._file.close()


def rows_of(folder: Path, name: str) -> Iterator[dict[str, str]]:
    """Yields the rows of a log, of all its files in order; a last line that was cut off is left out.

    Of a line that is longer than 64 KiB the pieces count as lines (`ncs_gym.reading`).

    Raises:
        OSError: If a file cannot be read, or is none.
    """
    for path in sorted(folder.glob(f"{name}-[0-9][0-9][0-9]*.csv")):
        with open_file(path) as file:
            lines = (line.decode("utf-8", "replace") for line in iter(partial(file.readline, LARGEST_LINE), b""))
            for row in csv.DictReader(lines):
                if None not in row.values() and None not in row:
                    yield row
