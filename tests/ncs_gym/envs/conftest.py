"""What tests of environments share."""

from collections.abc import Callable

import gymnasium as gym
import pytest

from ncs_gym import register_plant


@pytest.fixture
def register(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Registers plants for the time of a test."""
    monkeypatch.setattr("gymnasium.envs.registration.registry", before := dict(gym.registry))
    monkeypatch.setattr("gymnasium.registry", before)
    return register_plant
