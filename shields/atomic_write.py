"""File writes that a reader sees either completely or not at all."""

from __future__ import annotations

import errno
import os
import uuid
from contextlib import suppress
from pathlib import Path


def write_atomically(path: Path, content: str | bytes) -> None:
    """Writes a temporary file in the same directory, then renames it to `path`.

    Args:
        path: Destination; an existing file is replaced.
        content: Text is encoded as UTF-8.

    Raises:
        OSError: If the file cannot be written; the temporary file is removed.
    """
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        with temporary.open("xb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        if error.filename:
            error.filename = str(path)
        raise
    finally:
        with suppress(OSError):
            temporary.unlink()
