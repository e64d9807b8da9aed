"""How loops are compiled, and kept on disk without ever being older than their source."""

from __future__ import annotations

import zlib
from pathlib import Path

from numba import njit

# For a function that Python calls and whose file holds everything that it calls: numba looks for changes there alone.
entry = njit(cache=True, nogil=True, error_model="numpy")
# For what other compiled functions call: kept with these, never alone.
inner = njit(nogil=True, error_model="numpy", forceinline=True)


def version_of(file: str, *modules: str) -> int:
    """Returns a number that changes with the content of a source file and of modules next to it.

    A function that calls into other files is made inside another that has this number as a variable: then it is part of
    what numba finds the compiled code by.
    """
    files = [Path(file), *(Path(file).with_name(f"{module}.py") for module in modules)]
    return zlib.crc32(b"".join(each.read_bytes() for each in files))
