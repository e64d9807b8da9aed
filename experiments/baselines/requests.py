"""Policies that decide when to ask for a sample, and what comes of them behind the shield."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from agents.evaluation import Policy
from ncs_gym import Channel, ChannelContract, NCSVectorEnv
from shields import VectorSafetyShield


@dataclass(frozen=True, eq=False, kw_only=True)
class Moment:
    """What a policy of requests may look at before a step of N environments.

    Attributes:
        steps: Steps taken in the episodes, shape (N,).
        age: Steps since the newest sample used was taken, shape (N,).
        waiting: Whether the last sample requested may still be on its way, shape (N,).
        margin: How far inside S the proposed inputs keep the next state, shape (N,): `Decision.margin`.
        rng: Source of randomness.
    """

    steps: np.ndarray
    age: np.ndarray
    waiting: np.ndarray
    margin: np.ndarray
    rng: np.random.Generator


# Says in which of N environments a sample is asked for.
RequestPolicy = Callable[[Moment], np.ndarray]


def every(period: int) -> RequestPolicy:
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


def at_random(probability: float) -> RequestPolicy:
    """Asks with a probability, whatever happens."""
    return lambda now: now.rng.random(len(now.age)) < probability


def acknowledged(age: int) -> RequestPolicy:
    """Asks when the newest sample is so old and the last one requested has arrived or is lost."""
    return lambda now: (now.age >= age) & ~now.waiting


def slack(threshold: float) -> RequestPolicy:
    """Asks when the proposed input keeps the next state less than so far inside S, and none is on its way."""
    return lambda now: (now.margin < threshold) & ~now.waiting


class RequestLoop:
    """N control loops in which a controller proposes inputs behind a shield, and something else asks for samples.

    Args:
        shield: Around an `NCSVectorEnv` whose channel takes samples on request, without a downlink.
        control: Proposes actions (N, m) from observations and infos.
        seed: Of the episodes.

    Attributes:
        proposed: The actions proposed for the next step, shape (N, m).
        observations: The last ones, shape (N, entries).
        info: The last one.

    Raises:
        ValueError: If there is a downlink, whose requests are about later samples.
    """

    def __init__(self, shield: VectorSafetyShield, control: Policy, seed: int) -> None:
        env = shield.env.unwrapped
        assert isinstance(env, NCSVectorEnv)
        if env.downlink is not None:
            raise ValueError("these policies are about the sample of the next step: leave out the downlink")
        self._shield, self._env, self._control = shield, env, control
        self._longest, self._rng = env.channel.longest_delay, np.random.default_rng(seed)
        self.observations, self.info = shield.reset(seed=seed)
        self._prepare()

    def moment(self) -> Moment:
        """Returns what policies look at before the next step."""
        known, test = self._env.known, self._shield.filter.test
        errors = self._shield.filter.errors_of_many(known.error_shape)
        inputs = self._env.plant.u_max[:, None] * self.proposed.T
        margin = test.reachable(np.array(known.estimate, order="C"), errors).slack(inputs)[1]
        waiting = self._env.steps - self._requested < self._longest
        return Moment(steps=self._env.steps, age=known.age, waiting=waiting, margin=margin, rng=self._rng)

    def step(self, asked: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Asks for samples where a mask (N,) says so, applies what was proposed; returns rewards, ends and packets."""
        before = self.info["packets"]
        self._env.request(asked)
        self.observations, reward, terminated, truncated, self.info = self._shield.step(self.proposed)
        self._requested = np.where(self.info["requested"], self._env.steps, self._requested)
        self._prepare()
        sent = np.maximum(self.info["packets"] - before, 0)  # nothing in a step that only begins an episode
        return reward, terminated | truncated, sent

    def _prepare(self) -> None:
        begun = self._env.steps == 0
        never = np.full(len(begun), -self._longest)
        self._requested = np.where(begun, never, getattr(self, "_requested", never))
        self.proposed = np.asarray(self._control(self.observations, self.info), np.float32)


@dataclass(frozen=True, kw_only=True)
class RequestResult:
    """What a policy earned, and what it cost, as means over the steps of all first episodes.

    Attributes:
        packets: Packets per step.
        forced: Share of steps in which the contract forced a request.
        reward: Return per episode.
        overridden: Share of steps that the shield changed.
        violations: Number of steps outside the safe box.
        guaranteed: Share of steps that were proved safe.
        oldest: The largest age of the newest sample [steps].
    """

    packets: float
    forced: float
    reward: float
    overridden: float
    violations: int
    guaranteed: float
    oldest: int


def played(loop: RequestLoop, policy: Callable[[RequestLoop], np.ndarray], most: int) -> RequestResult:
    """Plays one episode in each environment, of at most so many steps.

    Args:
        loop: The control loops, at the start of their episodes.
        policy: Says where samples are asked for, shape (N,).
        most: Number of steps.
    """
    count = len(loop.observations)
    alive = np.ones(count, np.bool_)
    sums = dict.fromkeys(("packets", "forced", "reward", "overridden", "violations", "guaranteed"), 0.0)
    steps = oldest = 0
    for _ in range(most):
        reward, over, sent = loop.step(policy(loop))
        info: dict[str, Any] = loop.info
        each = {"packets": sent, "forced": info["request_forced"], "reward": reward, "violations": info["cost"]}
        each |= {"overridden": info["shield_intervened"], "guaranteed": info["shield_guaranteed"]}
        for name, values in each.items():
            sums[name] += float(values[alive].sum())
        steps += int(alive.sum())
        oldest = max(oldest, int(info["measurement_age"].max(initial=0, where=alive)))
        alive &= ~over
        if not alive.any():
            break
    shares = {name: sums[name] / steps for name in ("packets", "forced", "overridden", "guaranteed")}
    return RequestResult(**shares, reward=sums["reward"] / count, violations=int(sums["violations"]), oldest=oldest)
