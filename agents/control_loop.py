"""The control loop an agent works in: an environment with its channel, its shield and the penalty of a violation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import SyncVectorEnv, VectorEnv

import ncs_gym  # noqa: F401  (registers the environments)
from agents.loop_wrappers import CostPenalty, ResidualActions
from agents.settings import LagrangianSettings
from ncs_gym import Channel
from ncs_gym.validation import shown
from shields import Certificate, SafetyShield, VectorSafetyShield
from shields.runtime.safety_filter import DEFAULT_HORIZON, MODES


@dataclass(frozen=True)
class ShieldSettings:
    """Settings of the shield around an environment.

    Attributes:
        certificate: Certificate of the safe set; it is verified when the shield is built.
        mode: Mode of `SafetyShield`: "project", "lookahead", "switch", "boundary" or "monitor".
        penalty: Subtracted from the reward for every intervention.
        horizon: Longest plan of mode "lookahead" [steps]; None becomes the shield's default there.
    """

    certificate: Certificate
    mode: str = "project"
    penalty: float = 0.0
    horizon: int | None = None

    def __post_init__(self) -> None:
        """Checks the mode, and gives a horizon that is not given its default, so that whoever keeps it keeps a number.

        Raises:
            ValueError: If the mode is unknown.
        """
        if self.mode not in MODES:
            raise ValueError(f"mode must be one of {list(MODES)}, got {shown(self.mode)}")
        if self.mode == "lookahead" and self.horizon is None:
            object.__setattr__(self, "horizon", DEFAULT_HORIZON)

    @property
    def arguments(self) -> dict[str, Any]:
        """Arguments of `SafetyShield` and `VectorSafetyShield` after the environment."""
        return {name: getattr(self, name) for name in ("certificate", "mode", "penalty", "horizon")}


@dataclass(frozen=True, eq=False, kw_only=True)
class ControlLoop:
    """An environment together with everything between it and the agent.

    Attributes:
        env: A registered environment id.
        channel: Replaces the channel of the id; None keeps it.
        downlink: Replaces the channel between controller and actuator; None keeps it.
        shield: Settings of the shield; None applies the agent's actions as they are.
        violation_penalty: Subtracted from the reward of every step whose true state violates the safe box, in vector
            environments, which agents are trained in.
        noise: "truncated", or "gaussian" for noise without a bound, which environments of this package can have.
        disturbance: Replaces the disturbance of the id; None keeps it.
        process: Fields of the id's process that replace its own, a JSON value; None keeps it.
        filter: Puts another safety filter around vector environments, in place of a shield.
        lagrangian: How the violation penalty is adapted in training, instead of a fixed one.
        residual_gain: Normalized gain, shape (m, n), to whose action an agent in training adds its own.

    Raises:
        ValueError: If the shield is something else than its settings, or another filter is given beside it.
    """

    env: str
    channel: Channel | None = None
    downlink: Channel | None = None
    shield: ShieldSettings | None = None
    violation_penalty: float = 0.0
    noise: str = "truncated"
    disturbance: Any = None
    process: dict[str, Any] | None = None
    filter: Callable[[VectorEnv], VectorEnv] | None = None
    lagrangian: LagrangianSettings | None = None
    residual_gain: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Refuses what is not the settings of a shield, a bare certificate say, before anything is trained with it."""
        if self.shield is not None and not isinstance(self.shield, ShieldSettings):
            raise ValueError(f"shield must be ShieldSettings(certificate), got {type(self.shield).__name__}")
        if self.shield is not None and self.filter is not None:
            raise ValueError("give either a shield or a filter: two of them would override each other")

    @property
    def without_penalties(self) -> ControlLoop:
        """The same loop as it is evaluated: with the environment's own rewards, the policy's actions being complete."""
        shield = self.shield and replace(self.shield, penalty=0.0)
        return replace(self, shield=shield, violation_penalty=0.0, lagrangian=None, residual_gain=None)

    def single(self, **settings: Any) -> gym.Env:
        """Returns one environment, without the penalty of a violation; `settings` are passed to `gym.make`."""
        env = gym.make(self.env, **self._settings(settings))
        return env if self.shield is None else SafetyShield(env, **self.shield.arguments)

    def vector(self, count: int, **settings: Any) -> VectorEnv:
        """Returns `count` environments: the id's own vector environment, or gymnasium's of single environments."""
        if gym.spec(self.env).vector_entry_point is None:
            envs: Any = SyncVectorEnv([lambda: self.single(**settings)] * count)
        else:
            envs = gym.make_vec(self.env, num_envs=count, **self._settings(settings))
            if self.shield is not None:
                envs = VectorSafetyShield(envs, **self.shield.arguments)
        if self.filter is not None:
            envs = self.filter(envs)
        if self.residual_gain is not None:
            envs = ResidualActions(envs, self.residual_gain)
        if self.lagrangian is not None:
            return CostPenalty(envs, self.lagrangian.multiplier)
        return CostPenalty(envs, self.violation_penalty) if self.violation_penalty else envs

    def _settings(self, settings: dict[str, Any]) -> dict[str, Any]:
        own: dict[str, Any] = {} if self.channel is None else {"channel": self.channel}
        if self.downlink is not None:
            own["downlink"] = self.downlink
        if self.noise != "truncated":
            own["noise"] = self.noise
        if self.disturbance is not None:
            own["disturbance"] = self.disturbance
        if self.process is not None:
            own["process"] = self.process
        return own | settings
