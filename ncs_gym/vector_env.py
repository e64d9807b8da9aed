"""The same environment many times over, in arrays: no Python loop over environments in a step."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from ncs_gym import kernels
from ncs_gym.channel import Channel, GilbertElliott
from ncs_gym.disturbance import checked_many, stays_inside
from ncs_gym.env import NCSEnv, RenderModeError
from ncs_gym.frozen import as_count, as_numbers
from ncs_gym.gain_table import GainTable
from ncs_gym.plant import LinearPlant

# Random numbers that do not depend on the state are drawn in blocks of about this many environment steps.
BLOCK = 8192


class NCSVectorEnv(VectorEnv):
    """N copies of `NCSEnv` with the same semantics, spaces and info keys; every info value has N as its first axis.

    Means run in compiled loops. Gains and error shapes depend on what arrived when and on nothing else, so that they
    are computed once per pattern of arrivals (`GainTable`), with the estimator's own methods. The first steps of a
    process are therefore slower than the rest, and the very first waits a few seconds for the compiler.

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
        self.autoreset_mode = AutoresetMode(autoreset_mode)
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
        plant = self.plant
        self._model = kernels.Model(
            *(np.ascontiguousarray(a) for a in (plant.A, plant.B, plant.H, plant.C, plant.u_max))
        )
        self._network, self._uniform_count = _network_of(self.channel)
        self._table = GainTable(self.single.estimator)
        self._fleet = _fleet(self.num_envs, plant, self.channel.longest_delay + 1)
        self._tick = 0
        self._done, self._everyone = np.zeros(self.num_envs, np.bool_), np.ones(self.num_envs, np.bool_)
        self._missing = np.empty(self.num_envs, np.int64)
        room = self.num_envs * (self.channel.longest_delay + 1)
        self._suspects, self._residuals = np.empty((room, 3), np.int32), np.empty((room, plant.p))
        self.episodes = np.zeros(self.num_envs, dtype=np.int64)
        self.starts: np.ndarray | None = None
        self._consistent = False

    @property
    def steps(self) -> np.ndarray:
        """Steps taken in each episode, shape (N,)."""
        return self._fleet.steps

    @property
    def ticks(self) -> int:
        """Steps of the whole vector since it was made."""
        return self._tick

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
            seed = int(np.random.SeedSequence([int(each) for each in seed]).generate_state(1, np.uint64)[0] >> 1)
        super().reset(seed=seed)
        if seed is not None or not self._consistent:
            self._blocks: dict[str, tuple[np.ndarray, int]] = {}
        if not (self._consistent or mask.all()):
            raise gym.error.ResetNeeded("reset all environments first")
        self._consistent = False
        self._begin(mask, starts)
        self._consistent = True
        return self._report(np.zeros((self.plant.m, self.num_envs)), mask)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Applies u = u_max * action, actions of shape (N, m), for one step of every environment.

        Raises:
            ValueError: If an action is not finite or the shape is wrong; nothing has moved then.
            gymnasium.error.ResetNeeded: If there was no reset, or an earlier step failed half-way.
        """
        u = self.inputs_of(actions)
        if not self._consistent:
            raise gym.error.ResetNeeded("call reset: there was none, or an earlier step failed half-way")
        if self.autoreset_mode is AutoresetMode.DISABLED and self._done.any():
            raise gym.error.ResetNeeded("some episodes are over: reset them with options={'reset_mask': ...}")
        self._consistent = False
        resetting = self._done.copy() if self.autoreset_mode is AutoresetMode.NEXT_STEP and self._done.any() else None
        self._move(u)
        if resetting is not None:
            self._begin(resetting, None)
            u[:, resetting] = 0.0
        rewards = self.task.reward_many(self.plant, self._memory, self._fleet.state.T, u.T)
        observation, info = self._report(u, self._everyone)
        terminated = info["cost"] > 0.0 if self.single.terminate_on_violation else np.zeros(self.num_envs, np.bool_)
        truncated = np.zeros(self.num_envs, np.bool_)
        if self.max_episode_steps is not None:
            truncated = self._fleet.steps >= self.max_episode_steps
        if resetting is not None:
            rewards[resetting], terminated[resetting], truncated[resetting] = 0.0, False, False
        self._done = terminated | truncated
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._done.any():
            observation, info = self._restarted(observation, info)
        self._consistent = True
        return observation, rewards, terminated, truncated, info

    def inputs_of(self, actions: np.ndarray) -> np.ndarray:
        """Returns the float64 inputs, shape (m, N), that actions (N, m) stand for.

        Raises:
            ValueError: If one is not finite or the shape is wrong.
        """
        numbers = actions
        if not (isinstance(actions, np.ndarray) and actions.dtype == np.float32 and actions.flags.c_contiguous):
            numbers = as_numbers(actions)
        u = np.empty((self.plant.m, self.num_envs))
        wanted = (self.num_envs, self.plant.m)
        if numbers is None or numbers.shape != wanted or not kernels.read_actions(numbers, self._model.u_max, u):
            raise ValueError(f"the actions must be finite with shape {wanted}, got {actions!r}")
        return u

    def _move(self, u: np.ndarray) -> None:
        """Moves plants, channels and estimators one step on."""
        fleet, model = self._fleet, self._model
        nominal = np.empty_like(fleet.state)
        kernels.moved(model.A, fleet.state, model.B, u, nominal)
        d = self._disturbances(nominal)
        self._tick += 1
        kernels.advance(model, fleet, self._tick, u, nominal, d)
        self._memory = self.task.advance_many(self.np_random, self.plant, self._memory, u.T)
        noise, start = self._block("noise", self.plant.sensor_noise.sample_many)
        sent = kernels.send(model, self._network, fleet, self._tick, self._uniforms(), noise[start:])
        self._blocks["noise"] = noise, start + sent
        self._estimate()

    def _disturbances(self, nominal: np.ndarray) -> np.ndarray:
        """Returns this step's d, shape (N, n)."""
        source, plant, count = self.single.disturbance, self.plant, self.num_envs
        if source.is_memoryless and stays_inside(source):
            return self._drawn("disturbance", self._memoryless_disturbances)
        d = source.draw_many(self.np_random, plant, nominal.T, self._fleet.steps, self._disturbance_memory)
        if not source.replaces_process_noise:
            d = d + self._drawn("process", plant.process_noise.sample_many)
        if stays_inside(source):
            return d
        return checked_many(plant, d, count, allow_assumption_violation=self.single.allow_assumption_violation)

    def _memoryless_disturbances(self, rng: np.random.Generator, count: int) -> np.ndarray:
        source, plant = self.single.disturbance, self.plant
        d = source.draw_many(rng, plant, np.zeros((count, plant.n)), np.zeros(count), None)
        if not source.replaces_process_noise:
            plant.process_noise.add_to(rng, d)
        return d

    def _block(self, name: str, draw: Any) -> tuple[np.ndarray, int]:
        """Returns a block of rows filled by `draw`, at least N of them unused, and the number of the first of these."""
        block, start = self._blocks.get(name, (None, 0))
        if block is None or start + self.num_envs > len(block):
            block, start = draw(self.np_random, self.num_envs * max(1, BLOCK // self.num_envs)), 0
        return block, start

    def _drawn(self, name: str, draw: Any) -> np.ndarray:
        """Returns the next N rows of a block."""
        block, start = self._block(name, draw)
        self._blocks[name] = block, start + self.num_envs
        return block[start : start + self.num_envs]

    def _uniforms(self) -> np.ndarray:
        """Returns the uniform numbers that the channel needs, shape (0..3, N)."""
        if self._uniform_count == 0:
            return np.zeros((0, self.num_envs))
        block, start = self._blocks.get("uniform", (np.zeros((0, 0, 0)), 0))
        if start == len(block):
            block = self.np_random.random((max(1, BLOCK // self.num_envs), self._uniform_count, self.num_envs))
            start = 0
        self._blocks["uniform"] = block, start + 1
        return block[start]

    def _estimate(self) -> None:
        """Takes the prediction and what arrived into account, along the edges of the gain table."""
        table, fleet, channel = self._table, self._fleet, self.channel
        while missed := kernels.follow_predictions(table.predicted, fleet.node, self._missing):
            for node in np.unique(self._missing[:missed]).tolist():
                table.predict(node)
        for age in range(channel.longest_delay, channel.delay - 1, -1):
            doubtful = self._receive(age)
            for row in range(doubtful):
                e, edge, each = self._suspects[row].tolist()
                fleet.alarm[e] |= self.single.estimator.is_impossible(self._residuals[row], table.seen[edge, each])
        self._table, fleet.node[:] = table.keeping(fleet.node)

    def _receive(self, age: int) -> int:
        """Takes in the packets of one age; returns the number of residuals beyond the quick test."""
        table, column = self._table, age - self.channel.delay
        while True:
            arrays = kernels.Transitions(*(getattr(table, name) for name in kernels.Transitions._fields))
            missed, doubtful = kernels.receive(
                self._model,
                arrays,
                self._fleet,
                self._tick,
                age,
                column,
                self._missing,
                self._suspects,
                self._residuals,
            )
            if not missed:
                return doubtful
            for node in np.unique(self._missing[:missed]).tolist():
                table.receive(node, age)

    def _begin(self, mask: np.ndarray, starts: np.ndarray | None) -> None:
        """Starts episodes where `mask` says so, at `starts` (N, n) or drawn from the initial set."""
        fleet, rng, plant = self._fleet, self.np_random, self.plant
        chosen = np.flatnonzero(mask)
        count = len(chosen)
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
        for array in (fleet.age, fleet.steps, fleet.lost):
            array[chosen] = 0
        fleet.wait[chosen] = self.channel.send_period
        fleet.alarm[chosen] = fleet.arrived[chosen] = False
        fleet.violations[chosen] = 0.0
        loss = self.channel.loss
        if isinstance(loss, GilbertElliott):
            fleet.bad[chosen] = rng.random(count) < loss.stationary_bad
        self.episodes[chosen] += 1
        self._done[chosen] = False
        if self.starts is None:
            self.starts = np.full((self.num_envs, plant.n), np.nan)
        self.starts[chosen] = np.nan if starts is None else drawn

    def _report(self, u: np.ndarray, counted: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
        """Returns observations (N, n + extra) and infos of now, every array a fresh one; counts violations of some."""
        fleet, plant, space = self._fleet, self.plant, self.single_observation_space
        count, n = self.num_envs, plant.n
        observation = np.empty((space.shape[0], count), np.float32)
        error, shape = np.empty((n, count)), np.empty((count, n * n))
        values, cost, broken = np.empty((len(plant.C), count)), np.empty(count), np.empty(count, np.bool_)
        most = -1 if self.contract is None else self.contract.max_age
        kernels.report(
            self._model,
            fleet,
            self._table.shapes,
            most,
            space.low,
            space.high,
            counted,
            observation,
            error,
            shape,
            values,
            cost,
            broken,
        )
        if len(observation) > n:
            extra = self.task.observe_many(self._memory)
            observation[n:] = np.clip(extra, space.low[n:], space.high[n:]).T
        info = {
            "state": fleet.state.copy().T,
            "estimate": fleet.mean.copy().T,
            "estimation_error": error.T,
            "error_shape": shape.reshape(count, n, n),
            "input": u.T,
            "constraint_values": values.T,
            "cost": cost,
            "measurement_age": fleet.age.copy(),
            "packet_arrived": fleet.arrived.copy(),
            "assumption_violated": fleet.alarm.copy(),
            "episode_violations": fleet.violations.copy(),
            "is_success": (fleet.violations == 0.0).astype(np.float64),
            "contract_broken": broken,
        }
        return observation.T, info

    def _restarted(self, observation: np.ndarray, info: dict[str, Any]) -> tuple[np.ndarray, dict[str, Any]]:
        """Returns the first of new episodes where old ones ended, whose last go to final_obs and final_info."""
        done = self._done.copy()
        final = {key: np.where(done.reshape(-1, *[1] * (value.ndim - 1)), value, 0) for key, value in info.items()}
        final = {key: value.astype(info[key].dtype) for key, value in final.items()}
        final |= {f"_{key}": done.copy() for key in info}
        final_observation = np.where(done[:, None], observation, 0).astype(np.float32)
        self._begin(done, None)
        fresh_observation, fresh = self._report(np.zeros((self.plant.m, self.num_envs)), done)
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
        options = options or {}
        if unknown := sorted(set(options) - {"state", "reset_mask"}):
            raise ValueError(f"reset knows the options 'state' and 'reset_mask' only, got {unknown}")
        mask = np.asarray(options.get("reset_mask", np.ones(self.num_envs, np.bool_)))
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
            raise ValueError(
                f"options['reset_mask'] must be bool with shape ({self.num_envs},), some True, got {mask!r}"
            )
        if "state" not in options:
            return mask, None
        n, starts = self.plant.n, as_numbers(options["state"])
        if starts is None or starts.shape not in {(n,), (self.num_envs, n)} or not np.isfinite(starts).all():
            raise ValueError(
                f"options['state'] must be finite with shape ({n},) or ({self.num_envs}, {n}), got {options['state']!r}"
            )
        return mask, np.broadcast_to(starts, (self.num_envs, n))


def _network_of(channel: Channel) -> tuple[kernels.Network, int]:
    """Returns a channel as the loops need it, and how many uniform numbers it needs per step."""
    loss, bursts = channel.loss, isinstance(channel.loss, GilbertElliott)
    losses = (loss.loss_good, loss.loss_bad) if bursts else (loss, loss)
    moves = (loss.p_good_to_bad, loss.p_bad_to_good) if bursts else (0.0, 0.0)
    network = kernels.Network(
        period=channel.send_period,
        delay=channel.delay,
        jitter=channel.jitter,
        most_lost=-1 if channel.max_consecutive_losses is None else channel.max_consecutive_losses,
        step=channel.quantization_step,
        bursts=bursts,
        losses=np.array(losses),
        moves=np.array(moves),
    )
    needed = 3 if bursts else 2 if channel.jitter else 1 if max(losses) > 0.0 else 0
    return network, needed


def _fleet(count: int, plant: LinearPlant, slots: int) -> kernels.Fleet:
    """Returns the memory of `count` environments before their first episode."""
    return kernels.Fleet(
        state=np.zeros((plant.n, count)),
        mean=np.zeros((plant.n, count)),
        priors=np.zeros((slots, plant.n, count)),
        inputs=np.zeros((slots, plant.m, count)),
        samples=np.zeros((slots, plant.p, count)),
        due=np.full((slots, count), -1, np.int32),
        node=np.zeros(count, np.int32),
        age=np.zeros(count, np.int64),
        steps=np.zeros(count, np.int64),
        wait=np.zeros(count, np.int64),
        lost=np.zeros(count, np.int64),
        bad=np.zeros(count, np.bool_),
        alarm=np.zeros(count, np.bool_),
        arrived=np.zeros(count, np.bool_),
        violations=np.zeros(count),
    )
