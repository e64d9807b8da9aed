"""The control loop an agent works in: an environment with its settings, its shield and the penalty of a violation."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import SyncVectorEnv, VectorEnv, VectorWrapper

from ncs_gym import Channel
from ncs_gym.envs.json_settings import from_json, read_plant, to_json
from ncs_gym.validation import AroundEnvironments, as_number, shown
from shields import Certificate, SafetyShield, VectorSafetyShield
from shields.runtime.guard import LostGuarantee
from shields.runtime.safety_filter import plan_horizon


@dataclass(frozen=True)
class ShieldSettings:
    """Settings of a `SafetyShield`, which verifies the certificate when it is built.

    Raises:
        ValueError: If a value is none that a shield takes.
    """

    certificate: Certificate
    mode: str = "project"
    penalty: float = 0.0
    horizon: int | None = None
    on_unproved: str = "warn"

    def __post_init__(self) -> None:
        if not isinstance(self.certificate, Certificate):
            raise ValueError(f"certificate must be a Certificate, got {type(self.certificate).__name__}")
        object.__setattr__(self, "penalty", as_number(self.penalty, "penalty", low=0.0))
        object.__setattr__(self, "horizon", plan_horizon(self.mode, self.horizon))
        LostGuarantee(self.on_unproved)


@dataclass(frozen=True, kw_only=True)
class LagrangianSettings:
    """Settings of PPO-Lagrangian: how the price of a violating step is adapted (Ray et al. 2019, docs/bibliography.md).

    Attributes:
        cost_limit: Largest cost of an episode of full length (violating steps) that the agent is trained for.
        learning_rate: Added to the multiplier per rollout and violating step of such an episode above the limit.
        multiplier: Price of a violating step at the start of the training.
    """

    cost_limit: float = 0.0
    learning_rate: float = 0.05
    multiplier: float = 0.0

    def __post_init__(self) -> None:
        for entry in fields(self):
            if not 0.0 <= (value := getattr(self, entry.name)) < math.inf:
                raise ValueError(f"{entry.name} must be >= 0, got {value!r}")


@dataclass(frozen=True, eq=False, kw_only=True)
class LoopConfig:
    """A registered environment, and everything that stands between it and an agent.

    Attributes:
        env: A registered environment id.
        kwargs: Keyword arguments of the environment (`gym.make(env, **kwargs)`), JSON values or the objects that they
            stand for: `{"channel": {"loss": 0.5}}` or `{"channel": Channel(loss=0.5)}`. None keeps the id's own.
        shield: Settings of the shield; None applies the agent's actions as they are.
        filter: Puts another safety filter around vector environments, in place of a shield. Evaluations leave out the
            `penalty` of a dataclass, and keep what any other function subtracts from rewards.
        observed: Puts what an agent sees in place of the observations of vector environments around them.
        violation_penalty: Subtracted from the reward of every step whose true state violates the safe box, in vector
            environments, which agents are trained in.
        lagrangian: How the violation penalty is adapted in training, instead of a fixed one.

    Raises:
        ValueError: If the shield is something else, a filter is given beside it, the id is not registered, a penalty is
            wrong, or `lagrangian` limits the cost of episodes without an end.
    """

    env: str
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    shield: ShieldSettings | None = None
    filter: Callable[[VectorEnv], VectorEnv] | None = None
    observed: Callable[[VectorEnv], VectorEnv] | None = None
    violation_penalty: float = 0.0
    lagrangian: LagrangianSettings | None = None

    def __post_init__(self) -> None:
        if self.shield is not None and not isinstance(self.shield, ShieldSettings):
            raise ValueError(f"shield must be ShieldSettings(certificate), got {type(self.shield).__name__}")
        if self.shield is not None and self.filter is not None:
            raise ValueError("give either a shield or a filter: two of them would override each other")
        try:
            gym.spec(self.env)
        except (gym.error.Error, ImportError, AttributeError) as error:
            raise ValueError(
                f"{shown(self.env)} is no registered environment: import the module that registers it, and give the "
                "id alone"
            ) from error
        penalty = as_number(self.violation_penalty, "violation_penalty", low=0.0)
        object.__setattr__(self, "violation_penalty", penalty)
        if penalty and self.lagrangian is not None:
            raise ValueError("give either violation_penalty or lagrangian, which adapts it from its own multiplier")
        given = {name: value for name, value in self.kwargs.items() if value is not None}
        object.__setattr__(self, "kwargs", given)
        if self.lagrangian is not None and self.episode_steps is None:
            raise ValueError(
                f"lagrangian limits the cost of an episode, and {self.env} has no max_episode_steps: register it with "
                'some, or give kwargs={"max_episode_steps": ...}'
            )

    def with_kwargs(self, **changes: Any) -> LoopConfig:
        """Returns the same loop with other keyword arguments of the environment; None goes back to the id's own."""
        return replace(self, kwargs={**self.kwargs, **changes})

    @property
    def channel(self) -> Channel | None:
        """Channel that replaces the one of the id; None where the id's own is kept."""
        return from_json(self.kwargs.get("channel"), (Channel,), "channel")

    @property
    def other_kwargs(self) -> dict[str, Any]:
        """Keyword arguments besides the channel, as files of agents keep them."""
        kwargs = {name: value for name, value in self.kwargs.items() if name != "channel"}
        if "plant" in kwargs:
            kwargs["plant"] = read_plant(kwargs["plant"])
        return {name: to_json(value) for name, value in kwargs.items()}

    @property
    def episode_steps(self) -> int | None:
        """Steps after which an episode is truncated; None for never."""
        steps = self.kwargs.get("max_episode_steps", gym.spec(self.env).max_episode_steps)
        return steps if steps is not None and steps > 0 else None  # -1 asks `gym.make` for no end

    @property
    def without_penalties(self) -> LoopConfig:
        """The same loop as it is evaluated: with the environment's own rewards."""
        shield, filtered = self.shield and replace(self.shield, penalty=0.0), self.filter
        if is_dataclass(filtered) and not isinstance(filtered, type) and hasattr(filtered, "penalty"):
            filtered = replace(filtered, penalty=0.0)
        return replace(self, shield=shield, filter=filtered, violation_penalty=0.0, lagrangian=None)

    def single(self, **settings: Any) -> gym.Env:
        """Returns one environment, with the shield; penalties of violations and filter are for vectors."""
        env = gym.make(self.env, **{**self.kwargs, **settings})
        return env if self.shield is None else SafetyShield(env, **vars(self.shield))

    def vector(self, count: int, **settings: Any) -> VectorEnv:
        """Returns `count` environments: the id's own vector environment, or gymnasium's of single environments."""
        if gym.spec(self.env).vector_entry_point is None:
            envs: Any = SyncVectorEnv([lambda: self.single(**settings)] * count)
        else:
            envs = gym.make_vec(self.env, num_envs=count, **{**self.kwargs, **settings})
            if self.shield is not None:
                envs = VectorSafetyShield(envs, **vars(self.shield))
        if self.filter is not None:
            envs = self.filter(envs)
        if self.observed is not None:
            envs = self.observed(envs)
        if self.lagrangian is not None:
            return CostPenalty(envs, self.lagrangian.multiplier)
        return CostPenalty(envs, self.violation_penalty) if self.violation_penalty else envs


class CostPenalty(AroundEnvironments, VectorWrapper):
    """Subtracts a penalty, which may be changed, from the reward of every step that violates the safe box."""

    def __init__(self, env: VectorEnv, penalty: float) -> None:
        self.penalty = penalty
        super().__init__(env)

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Steps the environments; raises ValueError if their infos have no cost."""
        observation, rewards, terminated, truncated, info = self.env.step(actions)
        if "cost" not in info:
            raise ValueError('a penalty of violations needs environments with "cost" in their infos, these have none')
        cost, done = info["cost"], terminated | truncated
        if "final_info" in info:
            cost = np.where(done, info["final_info"]["cost"], cost)
        return observation, rewards - self.penalty * cost, terminated, truncated, info
