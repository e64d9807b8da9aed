"""The network around any Gymnasium environment."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from ncs_gym.envs.env import NCSEnv
from ncs_gym.network.channel import Channel
from ncs_gym.network.packet_loss_and_delay import ChannelState
from ncs_gym.networked.network_settings import (
    NetworkSettings,
    Predictor,
    ReadNetwork,
    network_rng,
    require_action,
    require_no_network,
    require_no_restarts,
)
from ncs_gym.networked.observations import joined, quantized, snapshot, zero_of
from ncs_gym.validation import shown


class Networked(ReadNetwork, gym.Wrapper, RecordConstructorArgs):
    """Puts a network between an environment and its agent: observations and actions are late, lost, rare or rounded.

    It needs no model and proves nothing; where there is a linear model, `NCSEnv` has an estimator and a shield for it.
    Rewards, ends of episodes and infos are those of the true environment, at once.

    ## Observations
    At step 0 the agent sees the environment's first observation. At each step k >= 1 that is a multiple of
    `send_period` the observation is sampled, its floats are quantized, and it is lost or arrives later. What arrives is
    seen unless something newer was seen before; otherwise `fill` says what is seen.

    ## Actions
    Without `downlink` an action acts in its own step. Behind one every action is sent; until the first has arrived
    `neutral` acts.

    ## Info (added to the environment's, at reset too)
    | key | type | unit | meaning |
    |---|---|---|---|
    | `measurement_age` | int | steps | age of the newest sample that arrived; with several channels a dictionary |
    | `packet_arrived` | bool | - | whether one arrived that is newer than all before; with several channels likewise |
    | `action_age` | int | steps | how long ago the action of this step was decided; -1 for `neutral`, 0 at reset |
    | `action_applied` | of the actions | - | that action; at reset the neutral one, or zeros |
    | `packets` | int | packets | samples sent in this episode |
    | `channel_loss` | float | - | long-run share of samples that this episode's channel loses; with several likewise |
    | `channel_delay` | int | steps | longest delay of this episode's channel; with several likewise |
    | `downlink_loss` | float | - | of this episode's downlink; zero for an ideal one |
    | `downlink_delay` | int | steps | likewise |

    Args:
        env: Any environment but an `NCSEnv`, which has its own network.
        channel: The network of the observations, a `Channel` or its fields; for a `Dict` of observations also a
            dictionary of these, for a `Tuple` a tuple, so that each entry has a network of its own. Keys left out
            arrive at once. Ideal by default.
        downlink: The network of the actions (loss, delay, jitter and `max_consecutive_losses`); ideal by default.
        observe: Entries that are added to observations: "age" of the newest sample [steps, at most 1,000], "arrived",
            and "pending_actions", the last ones decided, within their limits, discrete ones as one-hot vectors; each is
            a `Box`. A flat observation of floats becomes longer, a `Dict` gets keys and a `Tuple` entries of these
            names; another one becomes a `Dict` with the key "observation".
        fill: What is seen where nothing new arrived: "last", the newest sample that did, or "zero". Or a function
            (last, age, actions) -> observation that predicts the present one wherever the newest sample is older: it
            is given that sample, its age and the last `pending` actions decided, oldest first (a list where actions are
            no arrays), of which those of the last `age` steps came after the sample. What it returns is passed on as it
            is, also out of the space.
        idle: What acts where no newer command arrived: "hold", the one before, or "neutral".
        neutral: The action before the first command arrives; the zero of the actions by default, and needed behind a
            downlink where they have none.
        pending: How many of the last actions are kept; by default as many as the contracts of both channels allow the
            newest sample to lack, or where there is no contract as it lacks in 95 % of the steps (of a downlink those
            of its delays).

    Attributes:
        channel: The channel of the observations; with several a dictionary of them.
        downlink: The channel of the actions; None for an ideal one.
        episode_channel: The channel of this episode; with several a dictionary of them. `reset` takes another one as
            its option "channel" (and "downlink"), or what draws one (`RandomChannel`).

    Raises:
        ValueError: If a setting is wrong, or does not fit the environment's spaces.
    """

    def __init__(
        self,
        env: gym.Env,
        channel: Channel | Mapping[str, Any] | tuple[Any, ...] | None = None,
        downlink: Channel | Mapping[str, Any] | None = None,
        observe: Sequence[str] = (),
        fill: str | Predictor = "last",
        idle: str = "hold",
        neutral: Any = None,
        pending: int | None = None,
    ) -> None:
        given = {"channel": channel, "downlink": downlink, "observe": observe, "fill": fill, "idle": idle}
        given |= {"neutral": neutral, "pending": pending}
        if not isinstance(env, gym.Env):
            raise ValueError(f"Networked takes an environment, as gym.make returns it, got {shown(env)}")
        if isinstance(env.unwrapped, NCSEnv):
            raise ValueError("an NCSEnv has its own network: give gym.make(id, channel=..., downlink=...)")
        require_no_restarts(env)
        self._settings = settings = NetworkSettings(env.observation_space, env.action_space, given)
        RecordConstructorArgs.__init__(self, **settings.recorded)
        gym.Wrapper.__init__(self, env)
        self.observation_space = settings.entries.space
        self._links = settings.links(1)
        *self._uplinks, self._downlinks = self._links.values()
        self._network: Any = None  # what infos say of it in this episode
        self._arrivals = [_Arrivals() for _ in settings.parts]
        self._sees_newest = settings.keys is None and settings.fill == "last" and not settings.entries.names
        self._observes_actions = "pending_actions" in settings.entries.names
        self._keeps_actions = self._observes_actions or callable(settings.fill)

    @property
    def episode_channel(self) -> Any:
        """See the class."""
        return self._settings.by_part([links.now[0] for links in self._uplinks])

    @property
    def episode_downlink(self) -> Channel | None:
        """The downlink of this episode; None for an ideal one."""
        return self._downlinks.now[0]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: Seeds the network and the environment, whose draws are independent.
            options: {"channel": c}, {"downlink": c} give this episode another channel, or a function (rng) -> Channel
                that draws one; with several channels a dictionary of these. The rest is the environment's.
        """
        own = dict(options or {})
        sources = self._settings.sources(own, self._links)
        if seed is not None:
            self._rng = network_rng(seed)
        rng = self.np_random
        drawn = [(links, links.drawn(each, rng)) for links, each in sources]
        observation, info = self.env.reset(seed=seed, options=own or None)
        require_no_network(info)  # before anything changes
        for links, given in drawn:
            links.give(given)
            links.begin(rng)
        self._network = self._settings.infos(self._links)
        self._step = self._packets = 0
        sample = snapshot(observation)
        for part, arrivals, links in zip(self._settings.parts, self._arrivals, self._uplinks, strict=True):
            arrivals.begin(ChannelState(links.now[0], rng), part.of(sample))
        settings, given = self._settings, self.episode_downlink
        self._actuator = None if given is None else _Actuator(settings, ChannelState(given, rng))
        idle = settings.neutral if settings.neutral is not None else nothing(self.action_space)
        self._decided: deque[Any] = deque([idle] * settings.pending, settings.pending)
        return self._seen(), self._with_network(info, idle, 0)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Sends the action, steps the environment with the one that acts now, and sees what arrives."""
        if self._network is None:
            raise gym.error.ResetNeeded("call reset before the first step")
        rng, settings, step = self.np_random, self._settings, self._step
        applied, action_age = action, 0
        if self._actuator is not None:
            require_action(self.action_space, action)
            applied, action_age = self._actuator.exchange(rng, step, snapshot(action))
        if self._keeps_actions:
            self._decided.append(snapshot(action))
        # A copy: environments may change their actions in place, and this one may act again.
        observation, reward, terminated, truncated, info = self.env.step(snapshot(applied))
        self._step = step = step + 1
        sample = None
        for part, arrivals in zip(settings.parts, self._arrivals, strict=True):
            link, packet = arrivals.link, None
            if link.sends_at(step):
                if sample is None:
                    sample = snapshot(observation)
                own = part.of(sample)
                if link.channel.quantization_step:
                    own = quantized(link.channel, part.space, own)
                packet = step, own
                self._packets += 1
            arrivals.take(link.carry(rng, step, packet))
        return self._seen(), reward, terminated, truncated, self._with_network(info, applied, action_age)

    def _seen(self) -> Any:
        """Returns what the agent sees now."""
        settings, step = self._settings, self._step
        if self._sees_newest:
            return snapshot(self._arrivals[0].sample)
        seen = [snapshot(arrivals.sample) for arrivals in self._arrivals]
        if settings.fill == "zero":
            pairs = zip(seen, settings.parts, self._arrivals, strict=True)
            seen = [each if arrivals.is_new(step) else zero_of(part.space) for each, part, arrivals in pairs]
        elif callable(settings.fill) and (age := step - self._arrivals[0].stamp):
            settings.warn_of_lacking_actions(age)
            actions = [snapshot(each) for each in self._decided]
            seen = [settings.fill(seen[0], age, actions if self.action_space.shape is None else np.array(actions))]
        observation = joined(settings.parts, seen)
        if not settings.entries.names:
            return observation
        ages = np.array([step - arrivals.stamp for arrivals in self._arrivals])
        arrived = np.array([arrivals.arrived for arrivals in self._arrivals])
        pending = np.array(self._decided) if self._observes_actions else None
        return settings.entries.added_to(observation, ages, arrived, pending)

    def _with_network(self, info: dict[str, Any], applied: Any, action_age: int) -> dict[str, Any]:
        """Returns the environment's infos with those of the network."""
        require_no_network(info)
        step, arrivals, by_part = self._step, self._arrivals, self._settings.by_part
        return {
            **info,
            "measurement_age": by_part([step - each.stamp for each in arrivals]),
            "packet_arrived": by_part([each.arrived for each in arrivals]),
            "action_age": action_age,
            "action_applied": snapshot(applied),
            "packets": self._packets,
            **deepcopy(self._network),
        }


class _Arrivals:
    """What has arrived of a part of the observations: the newest sample, its step, and whether it arrived now."""

    link: ChannelState

    def begin(self, link: ChannelState, sample: Any) -> None:
        """Starts an episode, whose first sample is there."""
        self.link, self.sample = link, sample
        self.stamp, self.arrived = 0, False

    def is_new(self, step: int) -> bool:
        """Returns whether the newest sample arrived at this step, as the first of an episode does."""
        return self.arrived or self.stamp == step

    def take(self, packets: list[Any]) -> None:
        """Takes the packets that arrive at this step."""
        self.arrived = False
        for stamp, sample in packets:
            if stamp > self.stamp:
                self.stamp, self.sample, self.arrived = stamp, sample, True


class _Actuator:
    """The commands on their way and the one that acts."""

    def __init__(self, settings: NetworkSettings, link: ChannelState) -> None:
        self._link, self._idle, self._neutral = link, settings.idle, settings.neutral
        self._action, self._stamp = settings.neutral, -1

    def exchange(self, rng: np.random.Generator, step: int, action: Any) -> tuple[Any, int]:
        """Sends an action; returns the one that acts at this step, and its age, -1 for `neutral` [steps]."""
        arrived = self._link.carry(rng, step, (step, action))
        newest = max(arrived, key=lambda each: each[0], default=None)
        if newest is not None and newest[0] > self._stamp:
            self._stamp, self._action = newest
        elif self._idle == "neutral" or self._stamp < 0:
            return self._neutral, -1
        return self._action, step - self._stamp


def nothing(actions: gym.Space) -> Any:
    """Returns zeros of the kind of an action, for what was decided before the first step."""
    if isinstance(actions, gym.spaces.Discrete):
        return actions.start
    if actions.shape is None:
        return None
    zeros = np.zeros(actions.shape, actions.dtype)
    if isinstance(actions, gym.spaces.MultiDiscrete):
        return zeros + actions.start
    return np.clip(zeros, actions.low, actions.high) if isinstance(actions, gym.spaces.Box) else zeros
