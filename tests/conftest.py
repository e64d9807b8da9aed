"""Plants that many tests share."""

from __future__ import annotations

import os

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
