"""The loop an agent learns in: an environment with its channel, its shield and the price of a violation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import SyncVectorEnv, VectorEnv, VectorWrapper

import ncs_gym  # noqa: F401  (registers the environments)
from ncs_gym import Channel
from shields import Certificate, SafetyShield, VectorSafetyShield


@dataclass(frozen=True)
class Shielding:
    """How an environment is shielded.

    Attributes:
        certificate: Verified when the shield is built.
        mode: Of `SafetyShield`.
        penalty: Subtracted from the reward per intervention.
    """

    certificate: Certificate
    mode: str = "project"
    penalty: float = 0.0


@dataclass(frozen=True, kw_only=True)
class ControlLoop:
    """An environment with what lies between it and the agent.

    Attributes:
        env: A registered id.
        channel: In place of the id's own.
        shielding: None leaves the agent's actions alone.
        violation_penalty: Subtracted from the reward of every step whose true state violates the safe box.
    """

    env: str
    channel: Channel | None = None
    shielding: Shielding | None = None
    violation_penalty: float = 0.0

    @property
    def unpriced(self) -> ControlLoop:
        """The same loop with the environment's own rewards."""
        shielding = self.shielding and replace(self.shielding, penalty=0.0)
        return replace(self, shielding=shielding, violation_penalty=0.0)

    def single(self, **settings: Any) -> gym.Env:
        """Returns one environment; `settings` go to `gym.make`. A violation is not priced."""
        env, shielding = gym.make(self.env, **self._settings(settings)), self.shielding
        if shielding is None:
            return env
        return SafetyShield(env, shielding.certificate, mode=shielding.mode, penalty=shielding.penalty)

    def vector(self, count: int, **settings: Any) -> VectorEnv:
        """Returns `count` environments: the id's vector environment, else gymnasium's of single ones."""
        if gym.spec(self.env).vector_entry_point is None:
            envs: Any = SyncVectorEnv([lambda: self.single(**settings)] * count)
        else:
            envs = gym.make_vec(self.env, num_envs=count, **self._settings(settings))
            if self.shielding is not None:
                mode, penalty = self.shielding.mode, self.shielding.penalty
                envs = VectorSafetyShield(envs, self.shielding.certificate, mode=mode, penalty=penalty)
        return PricedViolations(envs, self.violation_penalty) if self.violation_penalty else envs

    def _settings(self, settings: dict[str, Any]) -> dict[str, Any]:
        return settings if self.channel is None else {"channel": self.channel} | settings


class PricedViolations(VectorWrapper):
    """Subtracts a price from the reward of every step after which the true state violates the safe box.

    Args:
        env: With `cost` in its infos.
        price: Per violating step.
    """

    def __init__(self, env: VectorEnv, price: float) -> None:
        super().__init__(env)
        self.price = price

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Steps; the last step of an episode is priced by its own infos."""
        observation, rewards, terminated, truncated, info = self.env.step(actions)
        cost, done = info["cost"], terminated | truncated
        if "final_info" in info:
            cost = np.where(done, info["final_info"]["cost"], cost)
        return observation, rewards - self.price * cost, terminated, truncated, info
