"""Exported filters, compiled into a shared library: N of them side by side, moved by one call each."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from experiments.runs.loops import registered_env
from shields import certificate_for
from tests.shields.polytope import limits

# Of registered environments; with limits that have two ends, also open ones.
NAMES = ("CartPole", "BatchReactor", "CSTR", "LaneKeeping")
TWO_ENDS = ("angle", "tanks", "hill")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror")
SHIM = r"""
#include "ncs_filter.h"
int size(void) { return (int)sizeof(ncs_filter); }
int start(ncs_filter *f, int count, uint32_t episode, const double *x)
{
    int i, all = 1;
    for (i = 0; i < count; i++) all &= ncs_start(f + i, episode, x + i * NCS_N);
    return all;
}
void receive(ncs_filter *f, int count, const uint8_t *some, uint32_t episode, const uint32_t *stamp, const double *y)
{
    int i;
    for (i = 0; i < count; i++) if (some[i]) ncs_receive(f + i, episode, stamp[i], y + i * NCS_P);
}
void decide(ncs_filter *f, int count, const double *proposed, double *u, int *decision, int *reason)
{
    int i;
    for (i = 0; i < count; i++) {
        decision[i] = ncs_decide(f + i, proposed + i * NCS_M, u + i * NCS_M);
        reason[i] = f[i].reason;
    }
}
void applied(ncs_filter *f, int count, const uint8_t *some, const double *u)
{
    int i;
    for (i = 0; i < count; i++) if (some[i]) ncs_applied(f + i, u + i * NCS_M);
}
void look(const ncs_filter *f, int count, double *x, uint32_t *age)
{
    int i, k;
    for (i = 0; i < count; i++) {
        for (k = 0; k < NCS_N; k++) x[i * NCS_N + k] = f[i].estimate[k];
        age[i] = f[i].age;
    }
}
"""


@cache
def example(name: str):
    """Plant and certificate of a registered environment, or of a plant with limits of two ends."""
    if name in limits.PLANTS:
        return limits.PLANTS[name], limits.certificate(name)
    env = registered_env(f"ncs_gym/{name}-v0")
    return env.plant, certificate_for(env.plant, env.certificate_contract)


def compiler() -> str:
    """The C compiler; the test is skipped where there is none."""
    found = shutil.which("cc")
    if found is None:
        pytest.skip("there is no C compiler (cc)")
    return found


def compiled(folder: Path, *sources: str, out: str, flags: tuple[str, ...] = ()) -> Path:
    """Compiles sources of a folder with the filter and returns the file it made."""
    command = [compiler(), *STRICT, "-O1", *flags, *sources, "ncs_filter.c", "-o", out]
    subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True, timeout=300)
    return folder / out


def altered(folder: Path, pattern: str, change, which: int) -> None:
    """Changes one match of a pattern in the filter's source."""
    source = folder / "ncs_filter.c"
    text = source.read_text()
    match = list(re.finditer(pattern, text))[which]
    source.write_text(text[: match.start()] + change(match[0]) + text[match.end() :])


class Boards:
    """N filters of a folder; arrays have the filter as the first axis."""

    def __init__(self, folder: Path, count: int, n: int, m: int) -> None:
        if not (library := folder / "shim.so").exists():
            (folder / "shim.c").write_text(SHIM)
            compiled(folder, "shim.c", out="shim.so", flags=("-shared", "-fPIC"))
        self._c = ctypes.CDLL(str(library))
        self._memory = ctypes.create_string_buffer(self._c.size() * count)
        self.count, self._n, self._m = count, n, m

    def start(self, episode: int, estimates: np.ndarray) -> bool:
        return bool(self._c.start(self._memory, self.count, ctypes.c_uint32(episode), _pointer(estimates, np.float64)))

    def receive(self, some: np.ndarray, episode: int, stamps: np.ndarray, y: np.ndarray) -> None:
        given = _pointer(stamps, np.uint32), _pointer(y, np.float64)
        self._c.receive(self._memory, self.count, _pointer(some, np.uint8), ctypes.c_uint32(episode), *given)

    def decide(self, proposed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        u, codes = np.empty((self.count, self._m)), np.empty((2, self.count), np.int32)
        out = [ctypes.c_void_p(each.ctypes.data) for each in (u, codes[0], codes[1])]
        self._c.decide(self._memory, self.count, _pointer(proposed, np.float64), *out)
        return u, *codes

    def applied(self, some: np.ndarray, u: np.ndarray) -> None:
        self._c.applied(self._memory, self.count, _pointer(some, np.uint8), _pointer(u, np.float64))

    def look(self) -> tuple[np.ndarray, np.ndarray]:
        x, age = np.empty((self.count, self._n)), np.empty(self.count, np.uint32)
        self._c.look(self._memory, self.count, *(ctypes.c_void_p(each.ctypes.data) for each in (x, age)))
        return x, age


_kept: list[np.ndarray] = []


def _pointer(array: np.ndarray, kind: type) -> ctypes.c_void_p:
    """Address of a contiguous copy, which lives until some later calls."""
    _kept.append(np.ascontiguousarray(array, kind))
    del _kept[:-8]
    return ctypes.c_void_p(_kept[-1].ctypes.data)
