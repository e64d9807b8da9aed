"""Formats of files with recorded packets: tables, ping, fping, logs of `ncs loop`, lists of round trips, irtt.

Every reader returns the times that stand in the file and says how it took them. What is ambiguous is refused.
"""

from __future__ import annotations

import codecs
import csv
import os
from collections.abc import Sequence

from ncs_gym.network.log_formats.irtt import of_json
from ncs_gym.network.log_formats.ping import is_ping, of_ping
from ncs_gym.network.log_formats.record import Record
from ncs_gym.network.log_formats.table import of_table
from ncs_gym.reading import LARGEST_LOG, MOST_LINES, read_file
from ncs_gym.validation import reason_of, shown

# Longer rows are not those of a table [characters].
_LONGEST_ROW = 4096


def read_record(path: str | os.PathLike[str], period: float | None, step: float, ignore: Sequence[str] = ()) -> Record:
    """Returns the record in a file.

    Args:
        path: The file.
        period: Time between packets where the file does not say it; None if that is not known [s].
        step: Duration of the steps of `ncs loop` [s].
        ignore: Names of columns of a table that are not looked at.

    Raises:
        ValueError: If the file cannot be read, or is none of the formats, or ambiguous.
    """
    try:
        text = _decoded(read_file(path, LARGEST_LOG))
    except UnicodeDecodeError as error:
        raise ValueError(
            f"cannot read packets from {shown(path)}: it is no text; export a capture as CSV, a row for each packet"
        ) from error
    except OSError as error:
        raise ValueError(f"cannot read packets from {shown(path)}: {error.strerror or error}") from error
    if text.count("\n") > MOST_LINES:
        raise ValueError(f"{shown(path)} has more than {MOST_LINES:,} lines, a log of packets has at most so many")
    try:
        if is_ping(text):
            return of_ping(text, period)
        if text.lstrip()[:1] in ("{", "["):
            return of_json(text)
        rows = text.splitlines()
        if any(len(row) > _LONGEST_ROW for row in rows):
            raise ValueError(f"a row of a table has at most {_LONGEST_ROW:,} characters, a longer one is no record")
        return of_table(rows, period, step, ignore)
    except csv.Error as error:
        raise ValueError(f"{shown(path)} is no CSV file: {reason_of(error)}") from error
    except ValueError as error:
        raise ValueError(f"{shown(path)}: {error}") from None


def _decoded(content: bytes) -> str:
    """Returns the text of a file in UTF-8 or UTF-16, as PowerShell writes it, with or without a byte-order mark."""
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.decode("utf-16")
    if content[1:2] == b"\0":
        return content.decode("utf-16-le")
    if content[:1] == b"\0":
        return content.decode("utf-16-be")
    return content.decode("utf-8-sig")
