"""`Networked` for vector environments: arrays whose first axis is the environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
from gymnasium import Space
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Dict, Tuple
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space, iterate

from ncs_gym.envs.vector_env import NCSVectorEnv
from ncs_gym.network.channel import Channel
from ncs_gym.network.packet_loss_and_delay import VectorChannelState
from ncs_gym.networked.network_settings import (
    NetworkSettings,
    Predictor,
    ReadNetwork,
    network_rng,
    require_action,
    require_no_network,
    require_no_restarts,
)
from ncs_gym.networked.observations import is_batched, joined, quantized, snapshot, zero_of
from ncs_gym.networked.wrapper import nothing
from ncs_gym.validation import AroundEnvironments, require_batched_infos, shown


class VectorNetworked(ReadNetwork, AroundEnvironments, VectorWrapper, RecordConstructorArgs):
    """Puts a network between N environments and their agent; see `Networked`, also for the arguments.

    Each environment has a network of its own; all draw from one generator, so that N = 1 is what `Networked` does (with
    NEXT_STEP until the first episode ends: the step that resets draws, too). It works in all modes of autoreset. Infos
    are arrays (with several channels dictionaries of arrays) for all environments at each step, without masks. A
    function for `fill` is given batches: (last, age, actions) have the shapes (N, ...), (N,) and (N, pending, ...).
    With SAME_STEP `info["final_obs"]` holds what the agent sees last: an array for all environments, or, of
    dictionaries and tuples, an array of objects, one for each that ended.

    Args:
        env: Any vector environment but an `NCSVectorEnv`, which has its own network.
        channel: See `Networked`.
        downlink: See `Networked`.
        observe: See `Networked`.
        fill: See `Networked`.
        late: See `Networked`.
        idle: See `Networked`.
        neutral: See `Networked`; an action of one environment.
        pending: See `Networked`.
        delay_reward: See `Networked`.

    Attributes:
        episode_channels: The channels of the present episodes, N of them; with several a dictionary of these.
        episode_downlinks: The downlinks, likewise; None for an ideal one.

    Raises:
        ValueError: If a setting is wrong, or does not fit the environments' spaces.
    """

    def __init__(
        self,
        env: VectorEnv,
        channel: Channel | Mapping[str, Any] | tuple[Any, ...] | None = None,
        downlink: Channel | Mapping[str, Any] | None = None,
        observe: Sequence[str] = (),
        fill: str | Predictor = "last",
        late: str = "apply",
        idle: str = "hold",
        neutral: Any = None,
        pending: int | None = None,
        delay_reward: bool = False,
    ) -> None:
        given = {"channel": channel, "downlink": downlink, "observe": observe, "fill": fill, "late": late, "idle": idle}
        given |= {"neutral": neutral, "pending": pending, "delay_reward": delay_reward}
        if not isinstance(env, VectorEnv):
            raise ValueError(f"VectorNetworked takes vector environments, as gym.make_vec returns, got {shown(env)}")
        if isinstance(env.unwrapped, NCSVectorEnv):
            raise ValueError("expected a vector environment without a network of its own: an NCSVectorEnv has one")
        if not is_batched(env.single_observation_space):
            raise ValueError(
                f"VectorNetworked takes observations that are arrays, not {shown(env.single_observation_space)}: put "
                "Networked around each environment"
            )
        if isinstance(env.single_action_space, Dict | Tuple) or not is_batched(env.single_action_space):
            raise ValueError(
                f"VectorNetworked takes actions that are one array, not {shown(env.single_action_space)}: put "
                "Networked around each environment"
            )
        require_no_restarts(env)
        self._settings = settings = NetworkSettings(env.single_observation_space, env.single_action_space, given)
        if settings.channels[0].on_request:
            raise ValueError("samples on request are for single environments: make each with Networked")
        RecordConstructorArgs.__init__(self, **settings.recorded)
        VectorWrapper.__init__(self, env)
        self.single_observation_space = settings.entries.space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._mode = env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)
        self._uplinks, self._downlinks = settings.uplinks(self.num_envs), settings.downlinks(self.num_envs)
        self._nothing = settings.neutral if settings.neutral is not None else nothing(env.single_action_space)
        self._keeps_actions = "pending_actions" in settings.entries.names or callable(settings.fill)
        self._started = False

    @property
    def episode_channels(self) -> Any:
        """The channels of the present episodes, N of them; with several a dictionary of these."""
        return self._settings.by_part([tuple(links.now) for links in self._uplinks])

    @property
    def episode_downlinks(self) -> tuple[Channel | None, ...]:
        """The downlinks of the present episodes, N of them; None for an ideal one."""
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
        chosen = np.asarray(own.get("reset_mask", np.ones(count, np.bool_)))
        own |= {"reset_mask": chosen} if "reset_mask" in own else {}
        if not self._started:
            chosen = np.ones(count, np.bool_)
        sources = self._settings.sources(own, self._uplinks)
        downlink = self._downlinks.read(own.pop("downlink", None), "downlink")
        if first is not None:
            self._rng = network_rng(first)
        every, rows = (*self._uplinks, self._downlinks), np.flatnonzero(chosen).tolist()
        given = zip(every, (*sources, downlink), strict=True)
        read = [links.drawn(each, self.np_random, rows) for links, each in given]
        observations, info = self.env.reset(seed=seed, options=own or None)  # pyright: ignore[reportArgumentType]
        require_batched_infos(info, "VectorNetworked")
        require_no_network(info)
        for links, each in zip(every, read, strict=True):
            links.give(each, rows)
        everywhere = bool(chosen.all())
        if not everywhere:
            self._over = self._over & ~chosen  # what is reset now begins no episode in the next step
        else:
            self._make()
            self._network = self._settings.infos(self._uplinks, self._downlinks, many=True)
        self._begin(np.flatnonzero(chosen), snapshot(observations), anew=not everywhere)
        return self._seen(), self._with_network(info)

    def _make(self) -> None:
        """Makes the memory of all networks, for episodes that begin in all environments."""
        rng, settings, count = self.np_random, self._settings, self.num_envs
        self._started = True
        for links in (*self._uplinks, self._downlinks):
            links.begin(rng)
        self._arrivals = [_Arrivals(VectorChannelState(links.now, rng, count), count) for links in self._uplinks]
        self._actuator = None
        if settings.downlink is not None:
            self._actuator = _Actuators(settings, VectorChannelState(self._downlinks.now, rng, count), count)
        idle = np.repeat(np.asarray(self._nothing)[None], count, axis=0)
        self._decided = np.repeat(idle[:, None], settings.pending, axis=1)
        self._applied, self._action_age = idle, np.zeros(count, np.int64)
        self._steps, self._packets = np.zeros(count, np.int64), np.zeros(count, np.int64)
        self._earned, self._told = np.zeros(count), np.zeros(count)
        self._over = np.zeros(count, np.bool_)

    def _begin(self, rows: np.ndarray, samples: Any, *, anew: bool = False) -> None:
        """Starts episodes in some environments, with their first observations.

        Args:
            rows: Indices of the environments.
            samples: Observations of all environments.
            anew: Whether other episodes ran before, whose packets are on their way.
        """
        settings, rng = self._settings, self.np_random
        if anew:
            for arrivals, links in zip(self._arrivals, self._uplinks, strict=True):
                arrivals.link.begin(rng, rows, links.begin(rng, rows))
            if self._actuator is not None:
                self._actuator.begin(rng, rows, self._downlinks.begin(rng, rows))
            if not all(links.is_plain for links in (*self._uplinks, self._downlinks)):
                self._network = settings.infos(self._uplinks, self._downlinks, many=True)
        for part, arrivals in zip(settings.parts, self._arrivals, strict=True):
            arrivals.begin(rows, part.of(samples))
        self._steps[rows] = self._packets[rows] = self._action_age[rows] = 0
        self._applied[rows] = self._nothing
        if settings.delay_reward:
            self._earned[rows] = self._told[rows] = 0.0
        if self._keeps_actions:
            self._decided[rows] = self._nothing

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Sends the actions, steps the environments with those that act now, and sees what arrives."""
        if not self._started:
            raise ResetNeeded("call reset before the first step")
        rng, settings = self.np_random, self._settings
        actions = np.array(actions)
        restarted = self._over if self._mode is AutoresetMode.NEXT_STEP else np.zeros(self.num_envs, np.bool_)
        self._applied = actions
        if self._actuator is not None:
            require_action(self.action_space, actions)
            self._applied, self._action_age = self._actuator.exchange(rng, self._steps, actions)
        if self._keeps_actions:
            self._decided = np.concatenate([self._decided[:, 1:], actions[:, None]], axis=1)
        # A copy: environments may change their actions in place, and these may act again.
        observations, rewards, terminated, truncated, info = self.env.step(self._applied.copy())
        self._steps += 1
        done = terminated | truncated
        sampled = observations
        if self._mode is AutoresetMode.SAME_STEP and done.any():
            sampled = _merged(done, info["final_obs"], observations)
        sample = snapshot(sampled)
        if settings.delay_reward:
            self._earned = self._earned + np.where(restarted, 0.0, rewards)
        for part, arrivals in zip(settings.parts, self._arrivals, strict=True):
            sends = arrivals.exchange(rng, self._steps, part, sample, self._earned if settings.delay_reward else None)
            self._packets += sends
        if settings.delay_reward:
            newest = np.argmax([each.stamp for each in self._arrivals], axis=0)
            taken = np.array([each.earned for each in self._arrivals])[newest, np.arange(self.num_envs)]
            earned = np.where(done, self._earned, taken)
            rewards = np.where(restarted, rewards, earned - self._told)
            self._told = np.where(restarted, 0.0, earned)
        if len(rows := restarted.nonzero()[0]):
            self._begin(rows, sample, anew=True)
        if self._mode is AutoresetMode.SAME_STEP and done.any():
            info = info | {"final_obs": _listed(self.observation_space, self._seen(), done)}
            ended = info.get("final_info")
            ended = ended if isinstance(ended, dict) else {}
            info |= {"final_info": self._with_network(ended), "_final_info": info.get("_final_info", done)}
            self._begin(np.flatnonzero(done), snapshot(observations), anew=True)
        self._over = done
        return self._seen(), rewards, terminated, truncated, self._with_network(info)

    def _seen(self) -> Any:
        """Returns what the agent sees now."""
        settings, arrivals = self._settings, self._arrivals
        seen = [each.seen() for each in arrivals]
        if settings.fill == "zero":
            pairs = zip(seen, settings.parts, arrivals, strict=True)
            seen = [_where(each.is_new(self._steps), sample, zero_of(part.space)) for sample, part, each in pairs]
        elif callable(settings.fill):
            ages = self._steps - arrivals[0].stamp
            settings.warn_of_lacking_actions(int(ages.max()))
            predicted = settings.fill(snapshot(seen[0]), ages, self._decided.copy())
            _require_batch(predicted, seen[0])
            seen = [_where(ages == 0, seen[0], predicted)]
        if not settings.entries.names:
            return joined(settings.parts, seen)
        ages = np.stack([self._steps - each.stamp for each in arrivals], axis=1)
        arrived = np.stack([each.arrived for each in arrivals], axis=1)
        return settings.entries.added_to(joined(settings.parts, seen), ages, arrived, self._decided)

    def _with_network(self, info: dict[str, Any]) -> dict[str, Any]:
        """Returns the environments' infos with those of the networks."""
        require_no_network(info)
        by_part = self._settings.by_part
        return {
            **info,
            "measurement_age": by_part([self._steps - each.stamp for each in self._arrivals]),
            "packet_arrived": by_part([each.arrived.copy() for each in self._arrivals]),
            "action_age": self._action_age.copy(),
            "action_applied": self._applied.copy(),
            "packets": self._packets.copy(),
            **deepcopy(self._network),
        }


class _Arrivals:
    """What has arrived of a part of the observations of N environments.

    Attributes:
        link: Their channels.
        stamp: Step at which the newest sample was taken, shape (N,).
        sample: These samples.
        arrived: Whether one arrived at this step, shape (N,).
        earned: Sums of the rewards until they were taken, shape (N,).
    """

    def __init__(self, link: VectorChannelState, count: int) -> None:
        self.link, self.sample = link, None
        self.stamp, self.arrived = np.zeros(count, np.int64), np.zeros(count, np.bool_)
        self.earned = np.zeros(count)
        self._past: list[tuple[Any, np.ndarray | None]] = []

    def begin(self, rows: np.ndarray, samples: Any) -> None:
        """Starts episodes in some environments, whose first samples are there."""
        if len(rows) == len(self.stamp):
            self.sample = samples
        else:
            self.sample = snapshot(self.sample)
            _write(self.sample, samples, rows)
        self.stamp[rows], self.earned[rows], self.arrived[rows] = 0, 0.0, False

    def seen(self) -> Any:
        """Returns the newest samples for the agent."""
        return snapshot(self.sample)

    def is_new(self, steps: np.ndarray) -> np.ndarray:
        """Returns where the newest sample arrived at this step, as the first of an episode does, shape (N,)."""
        return self.arrived | (self.stamp == steps)

    def exchange(
        self, rng: np.random.Generator, steps: np.ndarray, part: Any, samples: Any, earned: np.ndarray | None
    ) -> np.ndarray:
        """Sends samples where it is time, and takes those that arrive; returns which environments send, (N,)."""
        sends, own = self.link.send(rng, steps), part.of(samples)
        if np.count_nonzero(self.link.channel.quantization_step):
            own = quantized(self.link.channel, part.space, own)
        self._past = [(own, earned), *self._past[: self.link.channel.longest_delay]]
        before = self.stamp
        for age, arrives in self.link.arrivals():
            stamp, (sample, by_then) = steps - age, self._past[age]
            newer = arrives & (stamp > self.stamp)
            self.sample = sample if newer.all() else _where(newer, sample, self.sample)
            self.stamp = np.where(newer, stamp, self.stamp)
            if by_then is not None:
                self.earned = np.where(newer, by_then, self.earned)
        self.arrived = self.stamp > before
        return sends


class _Actuators:
    """The commands on their way to N environments and those that act."""

    def __init__(self, settings: NetworkSettings, link: VectorChannelState, count: int) -> None:
        self._link, self._late, self._idle = link, settings.late, settings.idle
        self._neutral = np.asarray(settings.neutral)
        self._action = np.repeat(self._neutral[None], count, axis=0)
        self._stamp = np.full(count, -1)
        self._past: list[np.ndarray] = []
        # What waits for its turn, oldest first: how old each was at its arrival, counted from now on; -1 for none.
        self._waiting = np.zeros((0, count), np.int64)

    def begin(self, rng: np.random.Generator, rows: np.ndarray, channels: Any) -> None:
        """Starts episodes in some environments; what is on its way there never arrives."""
        self._link.begin(rng, rows, channels)
        self._action[rows], self._stamp[rows], self._waiting[:, rows] = self._neutral, -1, -1

    def exchange(
        self, rng: np.random.Generator, steps: np.ndarray, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Sends actions; returns those that act at these steps, and their ages, -1 for `neutral` [steps]."""
        self._link.send(rng, steps)
        self._past = [actions.copy(), *self._past[: 2 * self._link.channel.longest_delay + 1]]
        arrivals = self._link.arrivals()
        if self._late == "drop":
            arrivals = [(age, arrives & (age == np.asarray(self._link.channel.delay))) for age, arrives in arrivals]
        if self._late == "queue":
            arrivals = self._next_in_turn(arrivals)
        acts = np.zeros(len(steps), np.bool_)
        for age, arrives in arrivals:
            fresh = arrives & ((steps - age > self._stamp) | (self._late == "queue"))
            rows = np.flatnonzero(fresh)
            self._action[rows], self._stamp[rows], acts[rows] = self._past[age][rows], steps[rows] - age, True
        decided = acts if self._idle == "neutral" else self._stamp >= 0
        return _where(decided, self._action, self._neutral), np.where(decided, steps - self._stamp, -1)

    def _next_in_turn(self, arrivals: list[tuple[int, np.ndarray]]) -> list[tuple[int, np.ndarray]]:
        """Returns the command of each environment whose turn it is, by its age, and has the others wait."""
        waiting = [np.where(row >= 0, row + 1, -1) for row in self._waiting]
        waiting += [np.where(arrives, age, -1) for age, arrives in arrivals]
        if not waiting:
            return []
        rows = np.array(waiting)
        order = np.argsort(rows < 0, axis=0, kind="stable")  # what is there moves up
        rows = np.take_along_axis(rows, order, axis=0)
        first, self._waiting = rows[0], rows[1:][(rows[1:] >= 0).any(axis=1)]
        return [(age, first == age) for age in np.unique(first[first >= 0]).tolist()]


def _write(samples: Any, new: Any, rows: np.ndarray) -> None:
    """Writes rows of a batch over those of another one."""
    if isinstance(samples, dict):
        for key, each in samples.items():
            _write(each, new[key], rows)
    elif isinstance(samples, tuple):
        for each, other in zip(samples, new, strict=True):
            _write(each, other, rows)
    else:
        samples[rows] = new[rows]


def _where(chosen: np.ndarray, there: Any, elsewhere: Any) -> Any:
    """Returns a batch with the rows of one where a mask (N,) says so and of another elsewhere; either may be a row."""
    if isinstance(there, dict):
        return {key: _where(chosen, each, elsewhere[key]) for key, each in there.items()}
    if isinstance(there, tuple):
        return tuple(_where(chosen, each, other) for each, other in zip(there, elsewhere, strict=True))
    there, elsewhere = np.asarray(there), np.asarray(elsewhere)
    ndim = max(there.ndim, elsewhere.ndim)
    return np.where(chosen.reshape(-1, *[1] * (ndim - 1)), there, elsewhere)


def _require_batch(predicted: Any, samples: Any) -> None:
    """Raises ValueError unless predictions are a batch as samples are, one for each environment."""
    if isinstance(samples, dict):
        for key, each in samples.items():
            _require_batch(predicted[key], each)
    elif isinstance(samples, tuple):
        for one, each in zip(predicted, samples, strict=True):
            _require_batch(one, each)
    elif np.shape(predicted) != np.shape(samples):
        raise ValueError(
            "fill must return the observations of all environments, whose first axis is the environment: expected "
            f"{np.shape(samples)}, got {np.shape(predicted)}"
        )


def _merged(done: np.ndarray, final: Any, observations: Any) -> Any:
    """Returns observations with the final ones of episodes that ended; vector environments of Gymnasium list these."""
    if isinstance(observations, dict):
        if isinstance(final, dict):
            return {key: _merged(done, final[key], each) for key, each in observations.items()}
        rows = {key: [None if each is None else each[key] for each in final] for key in observations}
        return {key: _merged(done, rows[key], each) for key, each in observations.items()}
    if isinstance(observations, tuple):
        if not isinstance(final, tuple):
            final = [[None if each is None else each[i] for each in final] for i in range(len(observations))]
        return tuple(_merged(done, part, each) for part, each in zip(final, observations, strict=True))
    merged = observations.copy()
    for e in np.flatnonzero(done).tolist():
        merged[e] = final[e]
    return merged


def _listed(space: Space[Any], observations: Any, done: np.ndarray) -> Any:
    """Returns final observations; of dictionaries and tuples one for each environment, None where no episode ended."""
    if isinstance(observations, np.ndarray):
        return observations
    listed = np.full(len(done), None, dtype=object)
    for e, each in enumerate(iterate(space, observations)):
        listed[e] = each if done[e] else None
    return listed
