"""Comparisons of arrays at every step of long runs: numpy's own, asked only where a quick look does not settle it."""

from __future__ import annotations

from typing import Any

import numpy as np


def assert_equal(actual: Any, desired: Any, where: Any = "") -> None:
    """Passes if `np.testing.assert_array_equal` does."""
    if np.shape(actual) == np.shape(desired) and np.all(np.equal(actual, desired)):
        return
    np.testing.assert_array_equal(actual, desired, err_msg=str(where))


def assert_close(actual: Any, desired: Any, rtol: float = 1e-7, atol: float = 0.0, where: Any = "") -> None:
    """Passes if `np.testing.assert_allclose` does."""
    if np.shape(actual) == np.shape(desired):
        wanted = np.asarray(desired, np.float64)
        if np.all(np.abs(np.subtract(actual, wanted, dtype=np.float64)) <= atol + rtol * np.abs(wanted)):
            return
    np.testing.assert_allclose(actual, desired, rtol=rtol, atol=atol, err_msg=str(where))
