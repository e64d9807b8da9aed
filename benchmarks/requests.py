"""Policies that decide when to ask for a sample while a controller acts behind the shield, and what comes of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import VectorWrapper
from gymnasium.vector.utils import batch_space

from agents.evaluation import Policy
from ncs_gym import Channel, ChannelContract, NCSVectorEnv, VectorRequestActions
from shields import VectorSafetyShield

# Margins are shown to agents within these limits.
MARGIN_RANGE = (-2.0, 1.0)


class Asking:
    """N control loops in which a controller proposes inputs behind a shield, and something else asks for samples.

    Args:
        env: Around a `VectorSafetyShield`, without a downlink, whose requests are about later samples.
        control: Proposes actions (N, m) from observations and infos.
        seed: Of policies that draw.

    Attributes:
        rng: Source of randomness.
        proposed: The actions proposed for the next step, shape (N, m).

    Raises:
        ValueError: If there is no shield right inside, or there is a downlink.
    """

    def __init__(self, env: VectorRequestActions, control: Policy, seed: int = 0) -> None:
        shield, inner = env.env, env.unwrapped
        if not isinstance(shield, VectorSafetyShield) or not isinstance(inner, NCSVectorEnv):
            raise ValueError("expected VectorRequestActions(VectorSafetyShield(...))")
        if inner.downlink is not None:
            raise ValueError("these policies are about the sample of the next step: leave out the downlink")
        self._shield, self._inner, self._control = shield, inner, control
        self._longest, self.rng = inner.channel.longest_delay, np.random.default_rng(seed)
        self._requested = np.full(inner.num_envs, -self._longest)
        self.proposed = np.zeros((inner.num_envs, inner.plant.m), np.float32)

    def see(self, observations: np.ndarray, infos: dict[str, Any]) -> Asking:
        """Takes in what the last step returned, observations (N, entries + 2), and proposes inputs; returns itself."""
        self._requested = np.where(infos["requested"], self.steps, self._requested)
        self._requested = np.where(self.steps == 0, -self._longest, self._requested)
        proposed = self._control(observations[:, :-2], infos)
        self.proposed = np.asarray(proposed, np.float32)
        self.__dict__.pop("margin", None)
        return self

    @property
    def steps(self) -> np.ndarray:
        """Steps taken in the episodes, shape (N,)."""
        return self._inner.steps

    @property
    def age(self) -> np.ndarray:
        """Steps since the newest sample used was taken, shape (N,)."""
        return self._inner.belief.age

    @property
    def waiting(self) -> np.ndarray:
        """Whether the last sample requested may still be on its way, shape (N,)."""
        return self.steps - self._requested < self._longest

    @cached_property
    def margin(self) -> np.ndarray:
        """How far inside S the proposed inputs keep the next state, shape (N,): `Decision.margin`."""
        known, given = self._inner.belief, self._shield.filter
        sets = given.test.reachable(np.array(known.estimate, order="C"), given.errors_of_many(known.error_shape))
        plant = self._inner.plant
        return sets.margins(plant.input_half[:, None] * self.proposed.T + plant.input_middle[:, None])[1]


# Says in which of N loops a sample is asked for, shape (N,).
RequestRule = Callable[[Asking], np.ndarray]


def every(period: int) -> RequestRule:
    """Asks for the samples of every so many steps, as a channel with that `send_period` sends them."""
    return lambda now: (now.steps + 1) % period == 0


def best_period(channel: Channel, contract: ChannelContract) -> int:
    """Returns the longest period whose samples keep a contract: h = (L+1) M + delta - 1, solved for M.

    Raises:
        ValueError: If the channel may lose any number of packets in a row.
    """
    if channel.most_consecutive_losses is None:
        raise ValueError("a channel that may lose any number of packets in a row keeps no contract")
    return max((contract.max_age + 1 - channel.longest_delay) // (channel.most_consecutive_losses + 1), 1)


def at_random(probability: float) -> RequestRule:
    """Asks with a probability, whatever happens."""
    return lambda now: now.rng.random(len(now.steps)) < probability


def acknowledged(age: int) -> RequestRule:
    """Asks when the newest sample is so old and the last one requested has arrived or is lost."""
    return lambda now: (now.age >= age) & ~now.waiting


def slack(threshold: float) -> RequestRule:
    """Asks when the proposed input keeps the next state less than so far inside S, and no sample is on its way."""
    return lambda now: (now.margin < threshold) & ~now.waiting


def with_rule(asking: Asking, rule: RequestRule) -> Policy:
    """Returns the policy of `VectorRequestActions` that proposes what a controller does and asks by a rule."""

    def act(observations: np.ndarray, infos: dict[str, Any]) -> np.ndarray:
        asked = rule(asking.see(observations, infos))
        return np.column_stack([asking.proposed, np.where(asked, 1.0, -1.0)]).astype(np.float32)

    return act


class RequestsOnly(VectorWrapper):
    """An environment whose actions, (N, 1), only ask for samples, while a controller proposes the inputs.

    Observations have one entry more, the margin of what is proposed.

    Args:
        asking: The control loops.
        env: Their environment.
    """

    def __init__(self, asking: Asking, env: VectorRequestActions) -> None:
        super().__init__(env)
        self._asking, space = asking, env.single_observation_space
        assert isinstance(space, Box)
        low, high = (
            np.append(bound, limit) for bound, limit in zip((space.low, space.high), MARGIN_RANGE, strict=True)
        )
        self.single_observation_space = Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
        self.single_action_space = Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Starts episodes."""
        # gymnasium's annotation leaves out the lists that its own vector environments take.
        observations, info = self.env.reset(seed=seed, options=options)  # pyright: ignore[reportArgumentType]
        return self.seen(observations, info), info

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Asks where the action is positive."""
        observations, rewards, terminated, truncated, info = self.env.step(self.complete(actions))
        return self.seen(observations, info), rewards, terminated, truncated, info

    def seen(self, observations: np.ndarray, info: dict[str, Any]) -> np.ndarray:
        """Returns the observations of an agent, shape (N, entries + 1)."""
        margin = np.clip(np.nan_to_num(self._asking.see(observations, info).margin, nan=-np.inf), *MARGIN_RANGE)
        return np.column_stack([observations, margin]).astype(np.float32)

    def complete(self, actions: Any) -> np.ndarray:
        """Returns the actions of the environment inside, (N, m+1)."""
        return np.column_stack([self._asking.proposed, np.asarray(actions)]).astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class RequestResult:
    """What a policy earned, and what it cost.

    Attributes:
        packets: Packets per step.
        forced: Share of steps in which the contract forced a request.
        returns: Return of each episode without the price of packets.
        overridden: Share of steps that the shield changed.
        violations: Number of steps outside the safe box.
        unproved: Number of steps that were not proved safe.
        oldest: The largest age of the newest sample [steps].
    """

    packets: float
    forced: float
    returns: np.ndarray
    overridden: float
    violations: int
    unproved: int
    oldest: int


def played(env: VectorRequestActions, policy: Policy, seed: int) -> RequestResult:
    """Plays one episode in each environment, to its end.

    Args:
        env: The environments.
        policy: Returns actions (N, m+1).
        seed: Of the episodes.
    """
    observations, info = env.reset(seed=seed)
    alive, returns = np.ones(env.num_envs, np.bool_), np.zeros(env.num_envs)
    sums: dict[str, Any] = dict.fromkeys(("packets", "forced", "overridden", "violations", "unproved"), 0)
    steps = oldest = 0
    while alive.any():
        before = info["packets"]
        observations, reward, terminated, truncated, info = env.step(policy(observations, info))
        sent = info["packets"] - before
        returns += alive * (reward + env.cost * sent)
        each = {"packets": sent, "forced": info["request_forced"], "overridden": info["shield_intervened"]}
        each |= {"violations": info["cost"], "unproved": ~info["shield_guaranteed"]}
        for name, values in each.items():
            sums[name] += values[alive].sum()
        steps += int(alive.sum())
        oldest = max(oldest, int(info["measurement_age"].max(initial=0, where=alive)))
        alive &= ~(terminated | truncated)
    shares = {name: float(sums[name] / steps) for name in ("packets", "forced", "overridden")}
    counts = {name: int(sums[name]) for name in ("violations", "unproved")}
    return RequestResult(**shares, **counts, returns=returns, oldest=oldest)
