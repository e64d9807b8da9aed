"""The same environment many times over, in arrays: no Python loop over environments in a step."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from ncs_gym.envs.autoreset import Autoreset, Begun, Moved
from ncs_gym.envs.env import DEFAULT_HORIZON, LONGEST_HORIZON, NCSEnv, RenderModeError
from ncs_gym.envs.guarded_loop import GuardedLoop
from ncs_gym.envs.json_settings import SpecOfJson
from ncs_gym.envs.loop import ManyLoops, with_columns
from ncs_gym.envs.loop_settings import vector_reset_options
from ncs_gym.envs.spaces import Observer, read_actions
from ncs_gym.network.channel import Channel
from ncs_gym.tasks import Task
from ncs_gym.validation import as_count, setting


class NCSVectorEnv(SpecOfJson, GuardedLoop, VectorEnv):
    """N copies of `NCSEnv` with the same semantics, spaces and info keys; every info value has N as its first axis.

    Inside, the environment is the last axis, so that A x + B u stands as in the formulas. Pictures are drawn of single
    environments alone.

    Args:
        num_envs: N.
        max_episode_steps: Truncation; None or, as for `gym.make`, -1 never truncates. A `horizon` that is shorter
            becomes as long.
        autoreset_mode: `AutoresetMode.NEXT_STEP` or "NextStep" (the step after an episode's last ignores the action
            and returns the new episode's first observation), "SameStep" (`final_obs` and `final_info` hold the last
            ones) or "Disabled" (reset with `options={"reset_mask": ...}`).
        settings: Those of `NCSEnv` but `render_mode`.

    Attributes:
        episode_channels: The channels of the present episodes, N of them.
        episode_downlinks: The downlinks, likewise; None for ideal ones.
        single: The scalar environment with these settings; never stepped.
        steps: Steps taken in each episode, shape (N,).
        episodes: Episodes begun in each environment, shape (N,).
        starts: States that episodes were started at by an option or outside the initial set, NaN elsewhere, (N, n).

    Raises:
        ValueError: If a setting is wrong; see `NCSEnv`.
    """

    metadata = NCSEnv.metadata | {"render_modes": []}
    single: NCSEnv = setting("single")
    _now: ManyLoops
    task: Task = setting("task")
    terminate_on_violation: bool = setting("terminate_on_violation", "_single.terminate_on_violation")
    horizon: int = setting("horizon", "_single.horizon")
    observe: tuple[str, ...] = setting("observe", "_single.observe")
    max_episode_steps: int | None = setting("max_episode_steps")
    autoreset_mode: AutoresetMode = setting("autoreset_mode", "_autoreset.mode")
    steps: np.ndarray = setting("steps", "_now.steps")
    episodes: np.ndarray = setting("episodes", "_now.episodes")
    starts: np.ndarray = setting("starts", "_now.start")

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **settings: Any,
    ) -> None:
        self.num_envs = as_count(num_envs, "num_envs", low=1)
        limit = None if type(max_episode_steps) is int and max_episode_steps == -1 else max_episode_steps
        self._max_episode_steps = None if limit is None else as_count(limit, "max_episode_steps", low=1)
        self._autoreset = Autoreset(autoreset_mode, self.num_envs)
        self.metadata = self.metadata | {"autoreset_mode": self._autoreset.mode}
        if settings.get("render_mode") is not None:
            raise RenderModeError("pictures are drawn of single environments: gym.make(id, render_mode=...)")
        if self._max_episode_steps is not None:
            own_horizon = as_count(settings.get("horizon", DEFAULT_HORIZON), "horizon", low=1, high=LONGEST_HORIZON)
            settings["horizon"] = max(own_horizon, min(self._max_episode_steps, LONGEST_HORIZON))
        self._single = single = NCSEnv(**settings)
        self._task = single.task
        self.single_observation_space = single.observation_space
        self.single_action_space = single.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._observer = Observer(self._task, single.observation_space, single.observe, single.horizon, many=True)
        self._now = ManyLoops(single.loop, self.num_envs)

    @property
    def episode_channels(self) -> tuple[Channel, ...]:
        """See the class."""
        return tuple(self._now.channels.now)

    @property
    def episode_downlinks(self) -> tuple[Channel | None, ...]:
        """See the class."""
        return tuple(self._now.downlinks.now)

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts episodes.

        Args:
            seed: Seeds `np_random`, the only source of randomness of all environments.
            options: {"state": x0} starts at x0, shape (n,) or (N, n); {"reset_mask": (N,)} says which environments.
                {"channel": c}, {"downlink": c} give these environments other channels, one for all or a list of N, in
                which None stands for an environment's own; see `NCSEnv.reset`. Episodes that begin by themselves have
                the environments' own again (`VectorRandomChannel` draws for every episode).
                {"parameters": {name: value}} fixes parameters of these episodes, each a number or shape (N,).

        Raises:
            ValueError: If an option is unknown or wrong, or the environments cannot have the channel.
        """
        mask, starts = vector_reset_options(options, self.num_envs, self.plant)
        sources, fixed = self._now.read(options)
        if isinstance(seed, (list, tuple, np.ndarray)):
            seeds = [as_count(each, "each seed", low=0, high=2**64) for each in seed]
            if len(seeds) != self.num_envs:
                raise ValueError(f"give one seed, or {self.num_envs} of them, got {len(seeds)}")
            seed = int(np.random.SeedSequence(seeds).generate_state(1, np.uint64)[0] >> 1)
        super().reset(seed=seed)
        if seed is not None:
            self._now.process.forget()
        self._begin_draws_of_task(seed)
        chosen = self._now.choose(sources, self.np_random, np.flatnonzero(mask).tolist())
        if not (self._consistent or mask.all()):
            raise gym.error.ResetNeeded("reset all environments first")
        self._consistent = False
        observation, info = self._begin(mask, starts, fixed, chosen)
        self._autoreset.over = self._autoreset.over & ~mask
        self._consistent = True
        if self._guard is not None:
            self._guard.lost.tell()
        return observation, info

    @np.errstate(all="ignore")
    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Applies the inputs of actions of shape (N, m), for one step of every environment.

        Raises:
            ValueError: If an action is not finite or the shape is wrong; nothing has moved then.
            gymnasium.error.ResetNeeded: If there was no reset, or an earlier step failed half-way.
        """
        u = read_actions(self.plant, actions, self.num_envs)[1]
        if not self._consistent:
            raise gym.error.ResetNeeded("call reset: there was none, or an earlier step failed half-way")
        self._autoreset.require_under_way()
        self._consistent = False
        moved = self._autoreset.step(lambda: self._move(u), self._begin)
        self._consistent = True
        if self._guard is not None:
            self._guard.lost.tell()
        return moved

    def _move(self, u: np.ndarray) -> Moved:
        """Returns what a step returns in which no episode begins, given the inputs proposed, shape (m, N)."""
        now, guard = self._now, self._guard
        u = u if guard is None else guard.decide(u).input
        now.move(self.np_random, u)
        applied = now.inputs.applied
        self._task_state = self._task.advance_many(self._task_random, self.plant, self._task_state, applied)
        reward = self._task.reward_many(self.plant, self._task_state, now.state, applied)
        self._belief, info = now.report()
        if guard is not None:
            guard.observe(self._belief)
            info |= guard.info()
            reward = reward - guard.penalty * info["shield_intervened"]
        terminated, truncated = np.zeros((2, self.num_envs), np.bool_)
        process = now.process.process
        if process.terminated is not False:  # other people's environments may end
            terminated, truncated = terminated | process.terminated, truncated | process.truncated
        if self._single.terminate_on_violation:
            terminated |= info["cost"] > 0.0
        if self._max_episode_steps is not None:
            truncated |= self.steps >= self._max_episode_steps
        return self._observation(), reward, terminated, truncated, info

    def _begin(
        self,
        mask: np.ndarray,
        starts: np.ndarray | None = None,
        fixed: np.ndarray | None = None,
        chosen: list[dict[int, Any]] | None = None,
    ) -> Begun:
        """Begins episodes; see `ManyLoops.begin`."""
        now = self._now
        now.begin(self.np_random, mask, starts, fixed, chosen)
        begun = self._task.begin_many(self._task_random, self.plant, int(np.count_nonzero(mask)))
        self._task_state = np.array(begun) if mask.all() else with_columns(self._task_state, mask, begun)
        self._belief, info = now.report(counted=mask)
        if self._guard is not None:
            self._guard.begin(self._belief, *now.beginning(np.flatnonzero(mask)), mask)
            info |= self._guard.info()
        return self._observation(), info

    def close_extras(self, **kwargs: Any) -> None:
        """Closes the process."""
        self._now.process.close()
        self._single.close()

    def inputs_of(self, actions: np.ndarray) -> np.ndarray:
        """Returns the float64 inputs, shape (m, N), that actions (N, m) stand for.

        Raises:
            ValueError: If one is not finite or the shape is wrong.
        """
        return read_actions(self.plant, actions, self.num_envs)[1]

    def _observation(self) -> np.ndarray:
        task_state = self._task_state
        for u in self._now.pending:
            task_state = self._task.predict_many(self.plant, task_state, u)
        return self._observer.observation(self._belief, self._task.observe_many(task_state)).T
