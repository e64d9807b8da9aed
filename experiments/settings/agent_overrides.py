"""Settings of the learning algorithms as given on the command line: changes of those tuned for the environment."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from agents.settings import A2CSettings, AgentSettings, OffPolicySettings, PPOSettings, check_setting
from agents.tuned import tuned_settings, tuned_steps


class _Overrides:
    """Checks the ranges of the values that are given."""

    def __post_init__(self) -> None:
        """Raises ValueError if a value is out of range."""
        for name, value in given_values(self).items():
            check_setting(name, value)


@dataclass(frozen=True, kw_only=True)
class PPOOverrides(_Overrides):
    """Changes of the settings of PPO and TRPO; None keeps the value tuned for the environment, or else the default.

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
        entropy: Weight of the policy's entropy in PPO's loss; TRPO has no such term.
        normalize_rewards: Whether rewards are divided by the standard deviation of the discounted return.
    """

    envs: int | None = None
    rollout: int | None = None
    batch_size: int | None = None
    epochs: int | None = None
    learning_rate: float | None = None
    discount: float | None = None
    gae_lambda: float | None = None
    log_std: float | None = None
    width: int | None = None
    entropy: float | None = None
    normalize_rewards: bool | None = None


@dataclass(frozen=True, kw_only=True)
class A2COverrides(_Overrides):
    """Changes of the settings of A2C; None keeps the default.

    Attributes:
        envs: Number of environments stepped side by side.
        rollout: Steps of each environment between updates.
        learning_rate: Initial learning rate of RMSprop, which falls linearly to zero.
        discount: Discount factor per step.
        gae_lambda: Parameter lambda of generalized advantage estimation.
        log_std: Initial log standard deviation of the actions.
        width: Units in each of the two hidden layers of the policy and of the value function.
    """

    envs: int | None = None
    rollout: int | None = None
    learning_rate: float | None = None
    discount: float | None = None
    gae_lambda: float | None = None
    log_std: float | None = None
    width: int | None = None


@dataclass(frozen=True, kw_only=True)
class OffPolicyOverrides(_Overrides):
    """Changes of the settings of SAC, TD3, TQC and CrossQ; None keeps the default.

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

    envs: int | None = None
    gradient_steps: int | None = None
    batch_size: int | None = None
    buffer_size: int | None = None
    learning_starts: int | None = None
    learning_rate: float | None = None
    discount: float | None = None
    noise: float | None = None
    width: int | None = None


# The settings of each kind of algorithm, with the changes of them that the command line takes.
_KINDS: dict[type, type[AgentSettings]] = {
    PPOOverrides: PPOSettings,
    A2COverrides: A2CSettings,
    OffPolicyOverrides: OffPolicySettings,
}
# Training steps where none belong to tuned settings.
_DEFAULT_STEPS = 150_000
AgentOverrides = PPOOverrides | A2COverrides | OffPolicyOverrides


def given_values(overrides: Any) -> dict[str, Any]:
    """Returns the values that are given, by name."""
    return {name: value for name, value in asdict(overrides).items() if value is not None}


def complete_settings(env_id: str, algorithm: str, overrides: AgentOverrides) -> AgentSettings:
    """Returns all settings of an algorithm: the values given, those tuned for the environment, and the defaults.

    Args:
        env_id: Id of the environment, or "module:id".
        algorithm: Name of the algorithm.
        overrides: The values given.

    Raises:
        ValueError: If values that are given do not fit together with the others.
    """
    tuned = tuned_settings(_registered_id(env_id), algorithm)
    kept = {} if tuned is None else asdict(tuned)
    return _KINDS[type(overrides)](**kept | given_values(overrides))


def default_steps(env_id: str, algorithm: str) -> int:
    """Returns the training steps that belong to the settings tuned for an environment, or the default."""
    return tuned_steps(_registered_id(env_id), algorithm) or _DEFAULT_STEPS


def described_settings(env_id: str, algorithm: str, overrides: AgentOverrides) -> str:
    """Returns one line with all settings of an algorithm and where they come from."""
    settings, given = asdict(complete_settings(env_id, algorithm, overrides)), given_values(overrides)
    name = _registered_id(env_id)
    source = "default settings" if tuned_settings(name, algorithm) is None else f"settings tuned for {name}"
    if given:
        source = "settings as given" if len(given) == len(settings) else f"{source}, as given {', '.join(given)}"
    return f"{algorithm}, {source}: " + ", ".join(f"{name} {value}" for name, value in settings.items())


def _registered_id(env_id: str) -> str:
    """Returns the id of "module:id", by which the environment is registered."""
    return env_id.rpartition(":")[2]
