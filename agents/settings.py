"""Settings of the learning algorithms."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any


class _Settings:
    """Checks the ranges of settings, which have the same names in all algorithms."""

    def __post_init__(self) -> None:
        """Raises ValueError if a value is out of range."""
        for entry in fields(self):  # type: ignore[arg-type]
            check_setting(entry.name, getattr(self, entry.name))


@dataclass(frozen=True, kw_only=True)
class PPOSettings(_Settings):
    """Settings of PPO and TRPO; the defaults learn the cruise task in 150,000 steps.

    Many environments, batches of 2048 and a higher learning rate than stable-baselines3's defaults train about eight
    times as fast at no loss of return on these small tasks (`python benchmarks/ppo_settings.py`).

    Attributes:
        envs: Number of environments stepped side by side.
        rollout: Steps of each environment between updates.
        batch_size: Samples per gradient step; rollout * envs should be a multiple of it.
        epochs: Passes over each rollout.
        learning_rate: Initial learning rate of Adam, which falls linearly to zero.
        discount: Discount factor per step.
        gae_lambda: Parameter lambda of generalized advantage estimation.
        log_std: Initial log standard deviation of the actions.
        width: Units in each of the two hidden layers of the policy and of the value function.
        entropy: Weight of the policy's entropy in PPO's loss, which keeps it exploring; TRPO has no such term.
        normalize_rewards: Whether rewards are divided by the standard deviation of the discounted return.
    """

    envs: int = 64
    rollout: int = 64
    batch_size: int = 2048
    epochs: int = 10
    learning_rate: float = 3e-3
    discount: float = 0.9
    gae_lambda: float = 0.9
    log_std: float = -0.7
    width: int = 64
    entropy: float = 0.0
    normalize_rewards: bool = True

    def __post_init__(self) -> None:
        """Raises ValueError if a value is out of range."""
        super().__post_init__()
        if self.rollout * self.envs < 2:
            raise ValueError("rollout * envs must be at least 2")


@dataclass(frozen=True, kw_only=True)
class A2CSettings(_Settings):
    """Settings of A2C.

    Attributes:
        envs: Number of environments stepped side by side.
        rollout: Steps of each environment between updates.
        learning_rate: Initial learning rate of RMSprop, which falls linearly to zero.
        discount: Discount factor per step.
        gae_lambda: Parameter lambda of generalized advantage estimation.
        log_std: Initial log standard deviation of the actions.
        width: Units in each of the two hidden layers of the policy and of the value function.
    """

    envs: int = 64
    rollout: int = 8
    learning_rate: float = 2e-3
    discount: float = 0.9
    gae_lambda: float = 0.9
    log_std: float = -0.7
    width: int = 64


@dataclass(frozen=True, kw_only=True)
class OffPolicySettings(_Settings):
    """Settings of SAC, TD3, TQC and CrossQ.

    Attributes:
        envs: Number of environments stepped side by side.
        gradient_steps: Updates after each step of all environments.
        batch_size: Transitions per update.
        buffer_size: Number of transitions in the replay buffer.
        learning_starts: Environment steps with random actions before the first update.
        learning_rate: Initial learning rate of Adam, which falls linearly to zero.
        discount: Discount factor per step.
        noise: Standard deviation of TD3's exploration noise, in units of the input limits.
        width: Units in each of the two hidden layers of the policy and of the value functions.
    """

    envs: int = 64
    gradient_steps: int = 16
    batch_size: int = 256
    buffer_size: int = 200_000
    learning_starts: int = 2_000
    learning_rate: float = 3e-3
    discount: float = 0.9
    noise: float = 0.2
    width: int = 64


@dataclass(frozen=True, kw_only=True)
class LagrangianSettings:
    """Settings of PPO-Lagrangian: how the price of a violating step is adapted (Ray et al. 2019).

    Attributes:
        cost_limit: Largest cost of an episode of full length (violating steps) that the agent is trained for.
        learning_rate: Added to the multiplier per rollout and violating step of such an episode above the limit.
        multiplier: Price of a violating step at the start of the training.
    """

    cost_limit: float = 0.0
    learning_rate: float = 0.05
    multiplier: float = 0.0

    def __post_init__(self) -> None:
        """Raises ValueError if a value is out of range."""
        for entry in fields(self):
            if not 0.0 <= (value := getattr(self, entry.name)) < math.inf:
                raise ValueError(f"{entry.name} must be >= 0, got {value!r}")


AgentSettings = PPOSettings | A2CSettings | OffPolicySettings


def check_setting(name: str, value: Any) -> None:
    """Raises ValueError if a setting is out of the range that belongs to its name."""
    if name in ("discount", "gae_lambda"):
        if not 0.0 <= value <= 1.0:
            raise ValueError(f"{name} must be in [0, 1], got {value!r}")
    elif name == "learning_rate":
        if not 0.0 < value < math.inf:
            raise ValueError(f"learning_rate must be positive, got {value!r}")
    elif name in ("noise", "entropy"):
        if not 0.0 <= value < math.inf:
            raise ValueError(f"{name} must be >= 0, got {value!r}")
    elif name == "log_std":
        if not math.isfinite(value):
            raise ValueError(f"log_std must be finite, got {value!r}")
    elif name == "normalize_rewards":
        if not isinstance(value, bool):
            raise ValueError(f"normalize_rewards must be True or False, got {value!r}")
    elif isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"{name} must be a whole number >= 1, got {value!r}")
