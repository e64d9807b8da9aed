"""Files that a reader sees completely or not at all, and JSON documents: format, checksum of the content, content."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import uuid
from contextlib import suppress
from pathlib import Path
from typing import Any

from ncs_gym.reading import json_values


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


def digest(content: Any) -> str:
    """Returns the SHA-256 of JSON values, whatever the order of their keys."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def with_literal_numbers(text: str) -> Any:
    """Returns the values of a JSON text with every number as the text of its digits, so that a digest counts each."""
    return json_values(text, parse_float=str, parse_int=str)


def document_of(kind: str, format_name: str, content: Any) -> dict[str, Any]:
    """Returns the document that holds JSON values under the key `kind`; its checksum counts every digit."""
    literal = with_literal_numbers(json.dumps(content))
    return {"format": format_name, "sha256": digest(literal), kind: content}


def write_document(path: str | os.PathLike[str], document: dict[str, Any]) -> None:
    """Writes a document; a reader never sees a part of it. Raises OSError if the file cannot be written."""
    write_atomically(Path(path), json.dumps(document, indent=1) + "\n")


def content_of(text: str, path: Any, kind: str, format_name: str) -> Any:
    """Returns the content of a document, which messages call `path`, after comparing its checksum.

    Raises:
        ValueError: If it is no JSON, of another kind or format, or altered.
    """
    try:
        document, literal = json_values(text), with_literal_numbers(text)
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"cannot read {kind} {path}: it is not valid JSON") from error
    if not isinstance(document, dict) or document.get("format") != format_name or kind not in document:
        raise ValueError(f"{path} is not a file of format {format_name!r}")
    if document.get("sha256") != digest(literal[kind]):
        raise ValueError(f"{kind} {path} was altered: its checksum does not match")
    return document[kind]
