"""The same environment many times over, in arrays: no Python loop over environments in a step."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from ncs_gym.draws import fill_keys
from ncs_gym.envs.env import NCSEnv, RenderModeError, known_options
from ncs_gym.estimation import gain_table
from ncs_gym.estimation.estimator import ALARM_TOLERANCE
from ncs_gym.estimation.gain_table import GainTable
from ncs_gym.fleet import fleet_of, rows_of
from ncs_gym.law import law_of_disturbance
from ncs_gym.motion import DRAW, LAST, MOVE, PREDICT, RECEIVE, clip, read_actions, run
from ncs_gym.network.channel import GilbertElliott
from ncs_gym.report import Layout, Report
from ncs_gym.residuals import are_outside
from ncs_gym.system import packed, system_of
from ncs_gym.tasks.task import Regulation
from ncs_gym.uncertainty.disturbance import checked_many, stays_inside
from ncs_gym.uncertainty.minkowski_sum import HALVINGS
from ncs_gym.validation import as_count, as_numbers, shown


class NCSVectorEnv(VectorEnv):
    """N copies of `NCSEnv` with the same semantics, spaces and info keys; every info value has N as its first axis.

    Means run in compiled loops. Gains and error shapes depend on what arrived when and on nothing else, so that they
    are computed once per pattern of arrivals (`GainTable`), with the estimator's own methods. The first steps of a
    process are therefore slower than the rest, and the very first on a machine waits half a minute for the compiler.

    Args:
        num_envs: N.
        max_episode_steps: Truncation; None never truncates.
        autoreset_mode: `AutoresetMode.NEXT_STEP` or "NextStep" (the step after an episode's last ignores the action
            and returns the new episode's first observation), "SameStep" (`final_obs` and `final_info` hold the last
            ones) or "Disabled" (reset with `options={"reset_mask": ...}`).
        settings: Those of `NCSEnv`.

    Attributes:
        single: The scalar environment with these settings; never stepped.
        episodes: Episodes begun in each environment, shape (N,).
        starts: States that episodes were started at by an option, NaN where not, shape (N, n).

    Raises:
        ValueError: If a setting is wrong; see `NCSEnv`.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **settings: Any,
    ) -> None:
        self.num_envs = as_count(num_envs, "num_envs", low=1)
        limit = max_episode_steps
        self.max_episode_steps = None if limit is None else as_count(limit, "max_episode_steps", low=1)
        modes = [mode for mode in AutoresetMode if autoreset_mode is mode or _is_text(autoreset_mode, mode.value)]
        if not modes:
            names = [mode.value for mode in AutoresetMode]
            raise ValueError(f"autoreset_mode must be one of {names}, got {shown(autoreset_mode)}")
        self.autoreset_mode = modes[0]
        self.metadata = NCSEnv.metadata | {"autoreset_mode": self.autoreset_mode, "render_modes": []}
        if settings.get("render_mode") is not None:
            raise RenderModeError("a vector environment draws nothing: use gym.make(..., render_mode=...)")
        self.single = NCSEnv(**settings)
        self.plant, self.channel, self.task = self.single.plant, self.single.channel, self.single.task
        self.contract, self.error_set, self.render_mode = self.single.contract, self.single.error_set, None
        self.single_observation_space = self.single.observation_space
        self.single_action_space = self.single.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._counts, self._constants = packed(system_of(self.single, self.max_episode_steps))
        self._table = GainTable(self.single.estimator)
        self._allocate()
        self._tick = self._moment = 0
        self._some_done = False
        self.episodes = np.zeros(self.num_envs, dtype=np.int64)
        self.starts = np.full((self.num_envs, self.plant.n), np.nan)
        self._consistent = False
        self._shapes: _Shapes | None = None

    def _allocate(self) -> None:
        """Makes the arrays that are kept."""
        plant, count, slots = self.plant, self.num_envs, self.channel.longest_delay + 1
        sizes = plant.n, plant.m, plant.p, slots
        rows, marks = rows_of(*sizes)
        self._kept = np.zeros((rows, count)), np.zeros((marks, count), np.int32)
        # With NUMBA_DISABLE_JIT=1, for debuggers and mutants, it is a function of Python's already.
        self._fleet = getattr(fleet_of, "py_func", fleet_of)(*sizes, *self._kept)
        self._fleet.counted[:] = 1
        self._doubts, self._residuals = np.empty((count * slots, 4), np.int32), np.empty((count * slots, plant.p))
        self._progress, self._done = np.zeros(4, np.int64), np.zeros(count, np.bool_)
        self._layout = Layout(count, plant.n, plant.m, len(plant.C), len(self.single.observation_space.low))
        self._actions_shape, self._m = (count, plant.m), plant.m
        bounds = self.single.observation_space
        self._extra_low, self._extra_high = bounds.low[plant.n :], bounds.high[plant.n :]
        self._pays = type(self.task) is Regulation
        # Disturbances that are not drawn by compiled loops.
        self._disturbs = law_of_disturbance(self.single.disturbance, plant) is None

    @property
    def steps(self) -> np.ndarray:
        """Steps taken in each episode, shape (N,)."""
        return self._fleet.steps

    @property
    def ticks(self) -> int:
        """Steps of the whole vector since it was made."""
        return self._tick

    @property
    def error_shapes(self) -> tuple[Any, np.ndarray]:
        """The distinct error shapes met so far, as an object with `shapes` (k, n, n), and which each one has, (N,)."""
        if self._shapes is None or self._shapes.table is not self._table:
            self._shapes = _Shapes(self._table, self.plant.n)
        return self._shapes, self._fleet.node

    @property
    def patterns(self) -> tuple[GainTable, np.ndarray]:
        """The gain table in use, and the node in it, shape (N,), whose error shape is the present one."""
        return self._table, self._fleet.node

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts episodes.

        Args:
            seed: Seeds `np_random`, the only source of randomness of all environments.
            options: {"state": x0} starts at x0, shape (n,) or (N, n); {"reset_mask": (N,)} says which environments.

        Raises:
            ValueError: If an option is unknown, has a wrong shape or is not finite.
        """
        mask, starts = self._reset_options(options)
        if isinstance(seed, (list, tuple, np.ndarray)):
            seeds = [as_count(each, "each seed", low=0, high=2**64) for each in seed]
            seed = int(np.random.SeedSequence(seeds).generate_state(1, np.uint64)[0] >> 1)
        super().reset(seed=seed)
        if seed is not None or not self._consistent:
            fill_keys(self.np_random.integers(2**64, dtype=np.uint64), self._fleet.keys)
            self._moment = 0
        if not (self._consistent or mask.all()):
            raise gym.error.ResetNeeded("reset all environments first")
        self._consistent = False
        self._begin(mask, starts)
        self._consistent = True
        self._some_done = self._done.any()
        return self._report(mask)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Applies u = u_max * action, actions of shape (N, m), for one step of every environment.

        Raises:
            ValueError: If an action is not finite or the shape is wrong; nothing has moved then.
            gymnasium.error.ResetNeeded: If there was no reset, or an earlier step failed half-way.
        """
        filled = self._layout.new()
        self._read(actions, filled.numbers)
        if not self._consistent:
            raise gym.error.ResetNeeded("call reset: there was none, or an earlier step failed half-way")
        if self._some_done and self.autoreset_mode is AutoresetMode.DISABLED and self._done.any():
            raise gym.error.ResetNeeded("some episodes are over: reset them with options={'reset_mask': ...}")
        self._consistent = False
        u, resetting = filled.numbers[: self._m], None
        first = self._start_step(filled, u)
        if self._some_done and self.autoreset_mode is AutoresetMode.NEXT_STEP:
            first, resetting = self._run(first, LAST, filled), self._done.copy()
            self._begin(resetting, None)
            u[:, resetting] = 0.0
        self._run(first, LAST + 1, filled)
        flags = filled.flags
        rewards, terminated, truncated, self._done = filled.numbers[-2], flags[3], flags[4], flags[5]
        if not self._pays:
            rewards[:] = self.task.reward_many(self.plant, self._memory, self._fleet.state.T, u.T)
        if resetting is not None:
            rewards[resetting] = 0.0
            filled.flags[3:, resetting] = False
            self._progress[3] = self._done.sum()
        observation, info = self._observed(filled), self._layout.infos(filled)
        self._some_done = self._progress[3] > 0
        if self._some_done and self.autoreset_mode is AutoresetMode.SAME_STEP:
            observation, info = self._restarted(observation, info)
        self._consistent = True
        return observation, rewards, terminated, truncated, info

    def inputs_of(self, actions: np.ndarray) -> np.ndarray:
        """Returns the float64 inputs, shape (m, N), that actions (N, m) stand for.

        Raises:
            ValueError: If one is not finite or the shape is wrong.
        """
        u = np.empty(self._actions_shape[::-1])
        self._read(actions, u)
        return u

    def _read(self, actions: np.ndarray, rows: np.ndarray) -> None:
        """Fills the first m rows, shape (N,) each, with the inputs that actions stand for."""
        numbers, wanted = actions, self._actions_shape
        if not (type(actions) is np.ndarray and actions.dtype == np.float32 and actions.flags.c_contiguous):
            numbers = as_numbers(actions)
        if numbers is None or numbers.shape != wanted or not read_actions(numbers, self.plant.u_max, rows):
            raise ValueError(f"the actions must be finite with shape {wanted}, got {shown(actions)}")

    def _start_step(self, filled: Report, u: np.ndarray) -> int:
        """Does what compiled loops cannot, for what a user wrote; returns the stage to go on from."""
        self._tick += 1
        self._moment += 1
        if self._disturbs:
            self._run(DRAW, MOVE, filled)
            self._disturb(u)
        self._memory = self.task.advance_many(self.np_random, self.plant, self._memory, u.T)
        return MOVE if self._disturbs else DRAW

    def _disturb(self, u: np.ndarray) -> None:
        """Adds disturbances that are not drawn by compiled loops to the process noise."""
        source, plant, fleet = self.single.disturbance, self.plant, self._fleet
        nominal = fleet.state.T @ plant.A.T + u.T @ plant.B.T
        d = source.draw_many(self.np_random, plant, nominal, fleet.steps, self._disturbance_memory)
        if not source.replaces_process_noise:
            d = d + fleet.disturbance.T
        if not stays_inside(source):
            violation = self.single.allow_assumption_violation
            d = checked_many(plant, d, self.num_envs, allow_assumption_violation=violation)
        fleet.disturbance[:] = d.T

    def _run(self, first: int, end: int, filled: Report) -> int:
        """Runs stages of a step; where the gain table lacks edges it works them out and goes on. Returns `end`."""
        table, progress, moves = self._table, self._progress, first < LAST <= end
        while not run(
            first,
            end,
            self._tick,
            self._moment,
            self._counts,
            self._constants,
            *self._kept,
            table.nodes,
            table.edges,
            table.weights,
            table.shapes,
            self._doubts,
            self._residuals,
            *filled,
            progress,
        ):
            first, missed, *_ = progress.tolist()
            for node in np.unique(self._doubts[:missed, 0]).tolist():
                if first == PREDICT:
                    table.predict(node)
                else:
                    table.receive(node, self.channel.longest_delay - (first - RECEIVE))
        if moves and progress[2] > 0:
            self._look_closer(int(progress[2]))
            filled.flags[1] = self._fleet.alarm
        if len(table) >= gain_table.MOST_NODES:
            self._table, self._fleet.node[:] = table.keeping(self._fleet.node)
        return end

    def _look_closer(self, doubtful: int) -> None:
        """Raises the alarm for residuals beyond the quick test that are beyond the exact one, too."""
        suspects, residuals, table = self._doubts[:doubtful, 1:], self._residuals[:doubtful], self._table
        outside, limit = np.empty(doubtful, np.bool_), (1.0 + ALARM_TOLERANCE) ** 2
        are_outside(suspects, residuals, table.turns, table.values, limit, HALVINGS, outside)
        self._fleet.alarm[suspects[outside, 0]] = 1

    def _begin(self, mask: np.ndarray, starts: np.ndarray | None) -> None:
        """Starts episodes where `mask` says so, at `starts` (N, n) or drawn from the initial set."""
        fleet, rng, plant = self._fleet, self.np_random, self.plant
        # A slice of all is faster than their numbers.
        chosen = slice(None) if mask.all() else np.flatnonzero(mask)
        count = int(mask.sum())
        drawn = (1.0 - 1e-9) * self.single.initial_set.sample_many(rng, count) if starts is None else starts[chosen]
        memory = self.task.begin_many(rng, plant, count)
        disturbance_memory = self.single.disturbance.begin_many(rng, plant, count)
        if count == self.num_envs:
            self._memory, self._disturbance_memory = memory, disturbance_memory
        else:
            self._memory[chosen], self._disturbance_memory[chosen] = memory, disturbance_memory
        fleet.state[:, chosen] = drawn.T
        fleet.mean[:, chosen] = (drawn + plant.initial_noise.sample_many(rng, count)).T
        fleet.due[:, chosen] = -1
        fleet.node[chosen] = self._table.root
        for array in (fleet.age, fleet.steps, fleet.lost, fleet.alarm, fleet.arrived):
            array[chosen] = 0
        fleet.wait[chosen] = self.channel.send_period
        fleet.violations[chosen] = 0.0
        loss = self.channel.loss
        if isinstance(loss, GilbertElliott):
            fleet.bad[chosen] = rng.random(count) < loss.stationary_bad
        self.episodes[chosen] += 1
        self._done[chosen] = False
        self.starts[chosen] = np.nan if starts is None else drawn

    def _report(self, counted: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
        """Returns observations (N, n + extra) and infos of now, without inputs; counts violations of some."""
        filled = self._layout.new()
        filled.numbers[: self._m] = 0.0
        self._fleet.counted[:] = counted
        self._run(LAST, LAST + 1, filled)
        self._fleet.counted[:] = 1
        return self._observed(filled), self._layout.infos(filled)

    def _observed(self, filled: Report) -> np.ndarray:
        """Returns the observations, shape (N, n + extra)."""
        low, observation = self._extra_low, filled.observation
        if low.size > 0:
            extra = np.ascontiguousarray(self.task.observe_many(self._memory), dtype=np.float64)
            clip(extra, low, self._extra_high, observation[-low.size :])
        return observation.T

    def _restarted(self, observation: np.ndarray, info: dict[str, Any]) -> tuple[np.ndarray, dict[str, Any]]:
        """Returns the first of new episodes where old ones ended, whose last go to final_obs and final_info."""
        done = self._done.copy()
        final = {key: np.where(done.reshape(-1, *[1] * (value.ndim - 1)), value, 0) for key, value in info.items()}
        final = {key: value.astype(info[key].dtype) for key, value in final.items()}
        final |= {f"_{key}": done.copy() for key in info}
        final_observation = np.where(done[:, None], observation, 0).astype(np.float32)
        self._begin(done, None)
        fresh_observation, fresh = self._report(done)
        self._some_done = False
        observation = np.where(done[:, None], fresh_observation, observation)
        merged = {
            key: np.where(done.reshape(-1, *[1] * (value.ndim - 1)), fresh[key], value) for key, value in info.items()
        }
        return observation, merged | {
            "final_obs": final_observation,
            "_final_obs": done.copy(),
            "final_info": final,
            "_final_info": done.copy(),
        }

    def _reset_options(self, options: dict[str, Any] | None) -> tuple[np.ndarray, np.ndarray | None]:
        """Returns which environments to reset, shape (N,), and where they start, (N, n) or None."""
        options = known_options(options, {"state", "reset_mask"})
        given = options.get("reset_mask", np.ones(self.num_envs, np.bool_))
        mask = np.zeros(0, np.bool_) if as_numbers(given) is None else np.asarray(given)
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
            raise ValueError(
                f"options['reset_mask'] must be bool with shape ({self.num_envs},), some True, got {shown(given)}"
            )
        if "state" not in options:
            return mask, None
        n, starts = self.plant.n, as_numbers(options["state"])
        if starts is None or starts.shape not in {(n,), (self.num_envs, n)} or not np.isfinite(starts).all():
            raise ValueError(
                f"options['state'] must be finite with shape ({n},) or ({self.num_envs}, {n}), got {shown(starts)}"
            )
        return mask, np.broadcast_to(starts, (self.num_envs, n))


class _Shapes:
    """The error shapes of a gain table, one per node."""

    def __init__(self, table: GainTable, n: int) -> None:
        self.table, self._n, self._shapes = table, n, np.empty((0, n, n))

    @property
    def shapes(self) -> np.ndarray:
        """Shape (k, n, n)."""
        if len(self.table) > len(self._shapes):
            self._shapes = self.table.shapes[:, : len(self.table)].T.reshape(-1, self._n, self._n).copy()
        return self._shapes


def _is_text(value: Any, text: str) -> bool:
    """Returns whether a value is a text, and which one."""
    return isinstance(value, str) and value == text
