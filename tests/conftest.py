"""Plants that many tests share."""

from __future__ import annotations

import os

# One thread per process, as in `ncs`: tests run side by side, and on small matrices waiting threads only burn time.
# Read when numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest

from ncs_gym import LinearPlant, truck_trailer
from shields import Certificate, synthesize

# Gymnasium's checker tries every render mode: no windows while tests run.
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")


@pytest.fixture(scope="session")
def plant() -> LinearPlant:
    """The plant of the case study."""
    return truck_trailer()


@pytest.fixture(scope="session")
def loaded() -> LinearPlant:
    """The plant of the cruise."""
    return truck_trailer(mass=4000.0)


@pytest.fixture(scope="session")
def certificate(loaded: LinearPlant) -> Certificate:
    """A certificate for the cruise."""
    return synthesize(loaded)
