"""The network around any Gymnasium environment, one or many."""

from __future__ import annotations

from collections import deque
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from ncs_gym.envs.env import NCSEnv
from ncs_gym.envs.vector_env import NCSVectorEnv
from ncs_gym.network.channel import Channel
from ncs_gym.network.packet_loss_and_delay import ChannelState, VectorChannelState
from ncs_gym.networked.network_settings import (
    NetworkSettings,
    ReadNetwork,
    joined,
    network_rng,
    quantized,
    require_action,
    require_no_network,
    snapshot,
    zero_of,
)
from ncs_gym.validation import AroundEnvironments, require_batched_infos, shown


class Networked(ReadNetwork, gym.Wrapper):
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

    def _wrap(self, env: gym.Env, given: dict[str, Any]) -> None:
        if not isinstance(env, gym.Env):
            raise ValueError(f"Networked takes an environment, as gym.make returns it, got {shown(env)}")
        if isinstance(env.unwrapped, NCSEnv):
            raise ValueError("an NCSEnv has its own network: give gym.make(id, channel=..., downlink=...)")
        self._settings = settings = NetworkSettings(env.observation_space, env.action_space, given)
        gym.Wrapper.__init__(self, env)
        self.observation_space = settings.entries.space
        self._links = settings.links(1)
        *self._uplinks, self._downlinks = self._links.values()
        self._network: Any = None  # what infos say of it in this episode
        self._arrivals = [_Arrivals() for _ in settings.parts]
        self._sees_newest = settings.keys is None and settings.fill == "last" and not settings.entries.names
        self._keeps_actions = "pending_actions" in settings.entries.names or callable(settings.fill)

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
        chosen = [(links, links.choose(each, rng, [0])) for links, each in sources]
        observation, info = self.env.reset(seed=seed, options=own or None)
        require_no_network(info)  # before anything changes
        for links, channels in chosen:
            links.begin(channels)
        self._network = self._settings.infos(self._links)
        self._step = self._packets = 0
        sample = snapshot(observation)
        for part, arrivals, links in zip(self._settings.parts, self._arrivals, self._uplinks, strict=True):
            arrivals.begin(ChannelState(links.now[0], rng), part.of(sample))
        settings, self._commands = self._settings, None
        if self.episode_downlink is not None:
            self._commands = _Arrivals()
            self._commands.begin(ChannelState(self.episode_downlink, rng), settings.neutral, stamp=-1)
        idle = settings.neutral if settings.neutral is not None else nothing(self.action_space)
        self._decided: deque[Any] = deque([idle] * settings.pending, settings.pending)
        return self._seen(), self._with_network(info, idle, 0)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Sends the action, steps the environment with the one that acts now, and sees what arrives."""
        if self._network is None:
            raise gym.error.ResetNeeded("call reset before the first step")
        rng, settings, step = self.np_random, self._settings, self._step
        applied, action_age = action, 0
        if (commands := self._commands) is not None:
            require_action(self.action_space, action)
            commands.take(commands.link.carry(rng, step, (step, snapshot(action))))
            acts = commands.arrived or (settings.idle == "hold" and commands.stamp >= 0)
            applied, action_age = (commands.sample, step - commands.stamp) if acts else (settings.neutral, -1)
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
        ages = [step - arrivals.stamp for arrivals in self._arrivals]
        arrived = [arrivals.arrived for arrivals in self._arrivals]
        return settings.entries.added_to(observation, ages, arrived, self._decided)

    def _with_network(self, info: dict[str, Any], applied: Any, action_age: int) -> dict[str, Any]:
        require_no_network(info)
        step, arrivals, by_part = self._step, self._arrivals, self._settings.by_part
        return {
            **info,
            "measurement_age": by_part([step - each.stamp for each in arrivals]),
            "packet_arrived": by_part([each.arrived for each in arrivals]),
            "action_age": action_age,
            "action_applied": snapshot(applied),
            "packets": self._packets,
            **(self._network if self._settings.keys is None else snapshot(self._network)),
        }


class _Arrivals:
    """What has arrived of a part of observations, or of commands: the newest, its step, and whether it arrived now."""

    link: ChannelState

    def begin(self, link: ChannelState, sample: Any, stamp: int = 0) -> None:
        """Starts an episode, with what is there."""
        self.link, self.sample = link, sample
        self.stamp, self.arrived = stamp, False

    def is_new(self, step: int) -> bool:
        """Returns whether the newest sample arrived at this step, as the first of an episode does."""
        return self.arrived or self.stamp == step

    def take(self, packets: list[Any]) -> None:
        """Takes the packets that arrive at this step."""
        self.arrived = False
        for stamp, sample in packets:
            if stamp > self.stamp:
                self.stamp, self.sample, self.arrived = stamp, sample, True


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


# Spaces of what is one array, with a first axis more in vector environments.
_ARRAYS = spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary


class VectorNetworked(ReadNetwork, AroundEnvironments, VectorWrapper):
    """Puts a network between N environments and their agent; see `Networked`, also for the arguments.

    Observations and actions are one array each. Every environment has a network of its own; all draw from one
    generator, so that N = 1 is what `Networked` does (with NEXT_STEP until the first episode ends: the step that resets
    draws, too). It works in all modes of autoreset. Infos are arrays for all environments at each step, without masks.
    A function for `fill` is given batches: (last, age, actions) have the shapes (N, ...), (N,) and (N, pending, ...).
    With SAME_STEP `info["final_obs"]` holds what the agent sees last, an array for all environments.

    Args:
        env: Any vector environment but an `NCSVectorEnv`, which has its own network.
        channel: See `Networked`.
        downlink: See `Networked`.
        observe: See `Networked`; for observations that are a vector of floats.
        fill: See `Networked`.
        idle: See `Networked`.
        neutral: See `Networked`; an action of one environment.
        pending: See `Networked`.

    Attributes:
        episode_channels: The channels of the present episodes, N of them.
        episode_downlinks: The downlinks, likewise; None for an ideal one.

    Raises:
        ValueError: If a setting is wrong, or does not fit the environments' spaces.
    """

    def _wrap(self, env: VectorEnv, given: dict[str, Any]) -> None:
        if not isinstance(env, VectorEnv):
            raise ValueError(f"VectorNetworked takes vector environments, as gym.make_vec returns, got {shown(env)}")
        if isinstance(env.unwrapped, NCSVectorEnv):
            raise ValueError("expected a vector environment without a network of its own: an NCSVectorEnv has one")
        self._settings = settings = NetworkSettings(env.single_observation_space, env.single_action_space, given)
        for name, space in (("observations", settings.entries.space), ("actions", env.single_action_space)):
            if not isinstance(space, _ARRAYS):
                raise ValueError(
                    f"VectorNetworked takes {name} that are one array, not {shown(space)}: put Networked around each "
                    "environment"
                )
        VectorWrapper.__init__(self, env)
        self.single_observation_space = settings.entries.space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._mode = env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)
        self._links = settings.links(self.num_envs)
        self._uplinks, self._downlinks = self._links.values()
        self._nothing = settings.neutral if settings.neutral is not None else nothing(env.single_action_space)
        self._keeps_actions = "pending_actions" in settings.entries.names or callable(settings.fill)
        self._started = False

    @property
    def episode_channels(self) -> tuple[Channel, ...]:
        """See the class."""
        return tuple(self._uplinks.now)

    @property
    def episode_downlinks(self) -> tuple[Channel | None, ...]:
        """See the class."""
        return tuple(self._downlinks.now)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Starts episodes.

        Args:
            seed: Seeds the networks (a list by its first entry, a number then) and the environments.
            options: "channel" and "downlink" as for `Networked`, also lists with one for each environment; episodes
                that begin by autoreset have the environments' own again. "reset_mask", bool (N,), starts some. The
                rest is the environments'.
        """
        first = seed[0] if isinstance(seed, list) else seed
        if first is None and seed is not None:
            raise ValueError(f"the first of the seeds seeds the networks, and must be a number, got {shown(seed)}")
        own, count = dict(options or {}), self.num_envs
        mask = np.asarray(own.get("reset_mask", np.ones(count, np.bool_)))
        own |= {"reset_mask": mask} if "reset_mask" in own else {}
        if not self._started:
            mask = np.ones(count, np.bool_)
        sources, rows = self._settings.sources(own, self._links), np.flatnonzero(mask)
        if first is not None:
            self._rng = network_rng(first)
        chosen = [links.choose(each, self.np_random, rows.tolist()) for links, each in sources]
        observations, info = self.env.reset(seed=seed, options=own or None)  # pyright: ignore[reportArgumentType]
        require_batched_infos(info, "VectorNetworked")
        require_no_network(info)
        if mask.all():
            self._make(chosen)
            self._begin(rows, observations)
        else:
            self._over = self._over & ~mask  # what is reset now begins no episode in the next step
            self._restart(rows, observations, chosen)
        return self._seen(), self._with_network(info)

    def _make(self, chosen: list[dict[int, Any]]) -> None:
        """Makes the memory of all networks, for episodes that begin in all environments over the channels chosen."""
        rng, settings, count = self.np_random, self._settings, self.num_envs
        self._started = True
        self._uplinks.begin(chosen[0])
        self._downlinks.begin(chosen[1])
        self._samples = _ManyArrivals(VectorChannelState(self._uplinks.now, rng, count), count, 0)
        self._commands = None
        if settings.downlink is not None:
            self._commands = _ManyArrivals(VectorChannelState(self._downlinks.now, rng, count), count, -1)
        self._network = settings.infos(self._links, many=True)
        idle = np.repeat(np.asarray(self._nothing)[None], count, axis=0)
        self._decided = np.repeat(idle[:, None], settings.pending, axis=1)
        self._applied, self._action_age = idle, np.zeros(count, np.int64)
        self._steps, self._packets = np.zeros(count, np.int64), np.zeros(count, np.int64)
        self._over = np.zeros(count, np.bool_)

    def _restart(self, rows: np.ndarray, observations: np.ndarray, chosen: Any = None) -> None:
        """Starts episodes where others ran before, whose packets are on their way; see `_begin` and `_make`."""
        rng, links = self.np_random, self._links.values()
        chosen = [each.choose(None, rng, rows.tolist()) for each in links] if chosen is None else chosen
        up, down = (each.begin(own) for each, own in zip(links, chosen, strict=True))
        self._samples.link.begin(rng, rows, up)
        if self._commands is not None:
            self._commands.link.begin(rng, rows, down)
        if up or down:
            self._network = self._settings.infos(self._links, many=True)
        self._begin(rows, observations)

    def _begin(self, rows: np.ndarray, observations: np.ndarray) -> None:
        """Starts episodes in some environments, given by their indices, with the first observations of all."""
        commands = self._commands
        self._samples.begin(rows, np.array(observations))
        if commands is not None:
            commands.begin(rows, np.repeat(np.asarray(self._settings.neutral)[None], self.num_envs, axis=0))
        self._steps[rows] = self._packets[rows] = self._action_age[rows] = 0
        self._applied[rows] = self._nothing
        if self._keeps_actions:
            self._decided[rows] = self._nothing

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Sends the actions, steps the environments with those that act now, and sees what arrives."""
        if not self._started:
            raise ResetNeeded("call reset before the first step")
        rng = self.np_random
        actions = np.array(actions)
        restarted = self._over if self._mode is AutoresetMode.NEXT_STEP else np.zeros(self.num_envs, np.bool_)
        self._applied = actions
        if (commands := self._commands) is not None:
            require_action(self.action_space, actions)
            commands.exchange(rng, self._steps, actions.copy())
            acts = commands.arrived if self._settings.idle == "neutral" else commands.stamp >= 0
            self._applied = _where(acts, commands.sample, self._settings.neutral)
            self._action_age = np.where(acts, self._steps - commands.stamp, -1)
        if self._keeps_actions:
            self._decided = np.concatenate([self._decided[:, 1:], actions[:, None]], axis=1)
        # A copy: environments may change their actions in place, and these may act again.
        observations, rewards, terminated, truncated, info = self.env.step(self._applied.copy())
        self._steps += 1
        done = terminated | truncated
        ends_now = self._mode is AutoresetMode.SAME_STEP and done.any()
        sample = np.array(observations)
        for e in np.flatnonzero(done).tolist() if ends_now else ():
            sample[e] = info["final_obs"][e]
        self._packets += self._samples.exchange(rng, self._steps, sample, self._settings.parts[0].space)
        if len(rows := restarted.nonzero()[0]):
            self._restart(rows, sample)
        if ends_now:
            ended = info.get("final_info")
            final = self._with_network(ended if isinstance(ended, dict) else {})
            info = info | {"final_obs": self._seen(), "final_info": final}
            info.setdefault("_final_info", done)
            self._restart(np.flatnonzero(done), observations)
        self._over = done
        return self._seen(), rewards, terminated, truncated, self._with_network(info)

    def _seen(self) -> np.ndarray:
        samples, settings = self._samples, self._settings
        seen, ages = samples.sample.copy(), self._steps - samples.stamp
        if settings.fill == "zero":  # the first sample of an episode is no arrival
            seen = _where(samples.arrived | (ages == 0), seen, zero_of(settings.parts[0].space))
        elif callable(settings.fill):
            settings.warn_of_lacking_actions(int(ages.max()))
            predicted: Any = settings.fill(seen.copy(), ages, self._decided.copy())
            if np.shape(predicted) != seen.shape:
                raise ValueError(
                    "fill must return the observations of all environments, whose first axis is the environment: "
                    f"expected {seen.shape}, got {np.shape(predicted)}"
                )
            seen = _where(ages == 0, seen, predicted)
        return settings.entries.added_to(seen, ages[:, None], samples.arrived[:, None], self._decided)

    def _with_network(self, info: dict[str, Any]) -> dict[str, Any]:
        require_no_network(info)
        return {
            **info,
            "measurement_age": self._steps - self._samples.stamp,
            "packet_arrived": self._samples.arrived.copy(),
            "action_age": self._action_age.copy(),
            "action_applied": self._applied.copy(),
            "packets": self._packets.copy(),
            **snapshot(self._network),
        }


class _ManyArrivals:
    """What `_Arrivals` is, of N environments, whose episodes begin with what was taken at step `first`."""

    def __init__(self, link: VectorChannelState, count: int, first: int) -> None:
        self.link, self._first, self._past = link, first, []
        self.sample = np.empty(0)
        self.stamp, self.arrived = np.full(count, first), np.zeros(count, np.bool_)

    def begin(self, rows: np.ndarray, samples: np.ndarray) -> None:
        """Starts episodes in some environments, with what is there of all N."""
        self.sample = self.sample.copy() if len(self.sample) else samples
        self.sample[rows] = samples[rows]
        self.stamp[rows], self.arrived[rows] = self._first, False

    def exchange(self, rng: np.random.Generator, steps: np.ndarray, sample: np.ndarray, space: Any = None) -> Any:
        """Sends where it is time, quantized if a space is given, and takes what arrives; returns which send, (N,)."""
        sends, channel = self.link.send(rng, steps), self.link.channel
        if space is not None and np.count_nonzero(channel.quantization_step):
            sample = quantized(channel, space, sample)
        self._past = [sample, *self._past[: channel.longest_delay]]
        before = self.stamp
        for age, arrives in self.link.arrivals():
            newer = arrives & (steps - age > self.stamp)
            self.sample = _where(newer, self._past[age], self.sample)
            self.stamp = np.where(newer, steps - age, self.stamp)
        self.arrived = self.stamp > before
        return sends


def _where(chosen: np.ndarray, there: Any, elsewhere: Any) -> np.ndarray:
    """Returns a batch with the rows of one where a mask (N,) says so and of another elsewhere; either may be a row."""
    ndim = max(np.ndim(there), np.ndim(elsewhere))
    return np.where(chosen.reshape(-1, *[1] * (ndim - 1)), there, elsewhere)
