"""Reads what comes from outside: regular files of a bounded size, and JSON of a bounded number of values.

The limits of all readers of files stand here (SECURITY.md), and are checked before anything is read, unpacked or
expanded.
"""

from __future__ import annotations

import errno
import json
import os
import stat
from typing import Any, BinaryIO

# Bytes of a certificate, a plant, an `agent.json` or a page, and values of its JSON.
LARGEST_DOCUMENT, MOST_VALUES = 32 << 20, 2_000_000
# Bytes of a `model.zip`.
LARGEST_MODEL = 256 << 20
# Bytes of a file of recorded packets, packets of a log with those that were lost, and control steps that they span.
LARGEST_LOG, MOST_PACKETS, MOST_STEPS = 256 << 20, 2_000_000, 10_000_000


def read_file(path: str | os.PathLike[str], most: int = LARGEST_DOCUMENT) -> bytes:
    """Returns the bytes of a regular file; raises OSError if it is none, or has more than so many."""
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise OSError(errno.EFBIG, f"it has more than {most:,} bytes", os.fspath(path))
        return file.read(size)


def open_file(path: str | os.PathLike[str]) -> BinaryIO:
    """Returns a regular file, or one that a link leads to, open for reading; raises OSError if it is none."""
    file = open(os.fspath(path), "rb", opener=_opened)  # noqa: SIM115
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError(errno.EINVAL, "it is not a regular file", os.fspath(path))
    return file


def _opened(path: str, flags: int) -> int:
    """Opens a file without waiting for who writes into it if it is a pipe."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def read_text(path: str | os.PathLike[str]) -> str:
    """Returns the text of a file as `read_file` its bytes; raises UnicodeDecodeError if it is not UTF-8."""
    return read_file(path).decode("utf-8").replace("\r\n", "\n")


def json_values(text: str | bytes, **keywords: Any) -> Any:
    """Returns the values of a JSON text, as `json.loads` does; raises ValueError if it has more than `MOST_VALUES`."""
    marks: Any = (",", "[", "{") if isinstance(text, str) else (b",", b"[", b"{")
    if sum(text.count(mark) for mark in marks) > MOST_VALUES:
        raise ValueError(f"it has more than {MOST_VALUES:,} values")
    return json.loads(text, **keywords)


def require_packets(packets: int) -> None:
    """Raises ValueError if a record has too many packets."""
    if packets > MOST_PACKETS:
        raise ValueError(f"a log has at most {MOST_PACKETS:,} packets, with those that were lost; this one {packets:,}")
