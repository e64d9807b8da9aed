"""The same environment many times over, in arrays: no Python loop over environments in a step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from ncs_gym.envs.env import DEFAULT_HORIZON, LONGEST_HORIZON, SAMPLE_ROUNDING, NCSEnv
from ncs_gym.envs.episode_channels import channel_infos, covering, downlinks, uplinks
from ncs_gym.envs.info import Constraints, Known, loop_info
from ncs_gym.envs.json_settings import SpecOfJson
from ncs_gym.envs.loop_settings import CHANNELS, vector_reset_options
from ncs_gym.envs.spaces import Observer, actions_of, read_actions
from ncs_gym.estimation.arrival_histories import arrival_histories
from ncs_gym.estimation.error_sets import ErrorSet
from ncs_gym.estimation.vector_estimator import VectorEstimator
from ncs_gym.network.channel import Channel, widest
from ncs_gym.network.contract import ChannelContract, largest_age
from ncs_gym.network.downlink import DownlinkProtocol, Inputs, VectorDownlinkState, no_inputs
from ncs_gym.network.packet_loss_and_delay import VectorChannelState
from ncs_gym.network.requests import Requested, Requests, require_on_request
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes.plant_step import PlantSimulation
from ncs_gym.processes.process import Process
from ncs_gym.rendering import Annotation, PacketRecord
from ncs_gym.tasks.base_task import Task
from ncs_gym.uncertainty.disturbances import Disturbance
from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.validation import as_count, frozen, setting, shown


def _with_columns(values: np.ndarray, mask: np.ndarray, new: Any) -> np.ndarray:
    """Returns an array (..., N) with others where `mask` (N,) says so, of a type that holds both."""
    found = values.astype(np.result_type(values, new))
    found[..., mask] = new
    return found


class NCSVectorEnv(SpecOfJson, VectorEnv):
    """N copies of `NCSEnv` with the same semantics, spaces and info keys; every info value has N as its first axis.

    Inside, the environment is the last axis, so that A x + B u stands as in the formulas. What depends only on when
    packets arrive is looked up (`ArrivalHistories`); it is worked out when a history occurs for the first time.

    Args:
        num_envs: N.
        max_episode_steps: Truncation; None or, as for `gym.make`, -1 never truncates. A `horizon` that is shorter
            becomes as long.
        autoreset_mode: `AutoresetMode.NEXT_STEP` or "NextStep" (the step after an episode's last ignores the action
            and returns the new episode's first observation), "SameStep" (`final_obs` and `final_info` hold the last
            ones) or "Disabled" (reset with `options={"reset_mask": ...}`).
        channel: A channel, or a list of N, one for each environment; likewise `downlink`. `channel`, `downlink` and by
            default the contract are then those of the widest of them (`ncs_gym.network.channel.widest`).
        downlink: See `channel`.
        rendered_env: Number of the environment that is drawn, with a `render_mode`.
        settings: The others of `NCSEnv`.

    Attributes:
        episode_channels: The channels of the present episodes, N of them; those the environments were made with unless
            options of a reset gave others.
        episode_downlinks: The downlinks, likewise.
        single: The scalar environment with these settings; never stepped.
        steps: Steps taken in each episode, shape (N,).
        episodes: Episodes begun in each environment, shape (N,).
        starts: States that episodes were started at by an option or outside the initial set, NaN elsewhere, (N, n).
        ticks: Steps of the whole vector since it was made.

    Raises:
        ValueError: If a setting is wrong; see `NCSEnv`.
    """

    single: NCSEnv = setting("single")
    plant: LinearPlant = setting("plant")
    channel: Channel = setting("channel")
    task: Task = setting("task")
    disturbance: Disturbance = setting("disturbance", "_single.disturbance")
    initial_set: Ellipsoid = setting("initial_set", "_single.initial_set")
    terminate_on_violation: bool = setting("terminate_on_violation", "_single.terminate_on_violation")
    allow_assumption_violation: bool = setting("allow_assumption_violation", "_single.allow_assumption_violation")
    horizon: int = setting("horizon", "_single.horizon")
    noise: str = setting("noise", "_single.noise")
    observe: tuple[str, ...] = setting("observe", "_single.observe")
    process: Process = setting("process", "_single.process")
    contract: ChannelContract | None = setting("contract")
    certificate_contract: ChannelContract | None = setting("certificate_contract")
    error_set: ErrorSet = setting("error_set")
    downlink: Channel | None = setting("downlink")
    downlink_contract: ChannelContract | None = setting("downlink_contract", "_single.downlink_contract")
    downlink_protocol: DownlinkProtocol = setting("downlink_protocol", "_protocol")
    max_episode_steps: int | None = setting("max_episode_steps")
    autoreset_mode: AutoresetMode = setting("autoreset_mode")

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        channel: Channel | Sequence[Channel] | None = None,
        downlink: Channel | Sequence[Channel] | None = None,
        rendered_env: int = 0,
        **settings: Any,
    ) -> None:
        self.num_envs = as_count(num_envs, "num_envs", low=1)
        limit = None if type(max_episode_steps) is int and max_episode_steps == -1 else max_episode_steps
        self._max_episode_steps = None if limit is None else as_count(limit, "max_episode_steps", low=1)
        self._autoreset_mode = _autoreset_mode(autoreset_mode)
        self.metadata = NCSEnv.metadata | {"autoreset_mode": self._autoreset_mode}
        self.rendered_env = as_count(rendered_env, "rendered_env", low=0, high=self.num_envs - 1)
        own = [self._one_each(each, name) for name, each in zip(CHANNELS, (channel, downlink), strict=True)]
        if self._max_episode_steps is not None:
            own_horizon = as_count(settings.get("horizon", DEFAULT_HORIZON), "horizon", low=1, high=LONGEST_HORIZON)
            settings["horizon"] = max(own_horizon, min(self._max_episode_steps, LONGEST_HORIZON))
        settings |= {name: each and widest(each) for name, each in zip(CHANNELS, own, strict=True)}
        self._single = single = NCSEnv(**settings)
        self._plant, self._channel, self._task = single.plant, single.channel, single.task
        self._contract, self._error_set, self.render_mode = single.contract, single.error_set, single.render_mode
        self._oldest = largest_age(self._contract)
        self.single_observation_space = single.observation_space
        self.single_action_space = single.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._observer = Observer(self._task, single.observation_space, single.observe, single.horizon, many=True)
        allowed = single.allow_assumption_violation
        self._process = PlantSimulation(
            self._plant, single.disturbance, allowed, self.num_envs, noise=single.noise, process=single.process
        )
        self._downlink, self._protocol = single.downlink, single.downlink_protocol
        self._certificate_contract = single.certificate_contract
        count = self.num_envs
        dt = self._plant.dt
        self._uplinks = uplinks(own[0] or [self._channel] * count, self._channel, dt)
        self._downlinks = downlinks(own[1] or [None] * count, self._protocol, dt)
        histories = arrival_histories(self._plant, self._channel, self._certificate_contract)
        self._estimator = VectorEstimator(self._plant, histories, self.num_envs)
        self._downlink_state = VectorDownlinkState(self._protocol, self._plant.m, self.num_envs)
        self._requests = None
        if self._channel.on_request:
            self._requests = Requests(self._channel, self._contract, self._protocol.input_delay, self.num_envs)
        self._packets, self._nothing = np.zeros(self.num_envs, np.int64), np.zeros(self.num_envs, np.bool_)
        self._state = np.zeros((self._plant.n, self.num_envs))
        self._worst = self._plant.values_at_start(self._state)
        self._violations, self._done = np.zeros(self.num_envs), np.zeros(self.num_envs, np.bool_)
        self.steps, self.episodes = np.zeros(self.num_envs, np.int64), np.zeros(self.num_envs, np.int64)
        self.starts = np.full((self.num_envs, self._plant.n), np.nan)
        self.ticks, self._consistent = 0, False
        self._known: Known
        self._ended: tuple[np.ndarray, Known] | None = None

    @property
    def state(self) -> np.ndarray:
        """The true states, shape (N, n), a copy; only `reset(options={"state": x})` sets them."""
        return self._state.T.copy()

    @property
    def episode_channels(self) -> tuple[Channel, ...]:
        """The channels of the present episodes."""
        return tuple(self._uplinks.now)

    @property
    def episode_downlinks(self) -> tuple[Channel | None, ...]:
        """The downlinks of the present episodes; None for ideal ones."""
        return tuple(self._downlinks.now)

    @property
    def known(self) -> Known:
        """What a shield decides on, read-only: no wrapper stands between."""
        return self._known

    @property
    def ended(self) -> tuple[np.ndarray, Known] | None:
        """With SAME_STEP, where an episode ended in the last step, shape (N,), and what was known at its end."""
        return self._ended

    def estimates_ahead(self, chosen: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Returns what `NCSEnv` does for some environments, by index: estimates (n, k), numbers (k,)."""
        pending = self._downlink_state.committed.pending
        return [self._estimator.predicted(pending[:ahead], chosen) for ahead in range(len(pending) + 1)]

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts episodes.

        Args:
            seed: Seeds `np_random`, the only source of randomness of all environments.
            options: {"state": x0} starts at x0, shape (n,) or (N, n); {"reset_mask": (N,)} says which environments.
                {"channel": c}, {"downlink": c} give these environments other channels, one for all or a list of N, in
                which None stands for an environment's own; see `NCSEnv.reset`. They are for these episodes; those that
                begin by themselves have the environments' own again (`VectorRandomChannel` draws for every episode).
                {"parameters": {name: value}} fixes parameters of these episodes, each a number or shape (N,).

        Raises:
            ValueError: If an option is unknown or wrong, or the environments cannot have the channel.
        """
        mask, starts = vector_reset_options(options, self.num_envs, self._plant)
        links = list(zip(CHANNELS, (self._uplinks, self._downlinks), strict=True))
        read = [each.read((options or {}).get(name), name) for name, each in links]
        fixed = self._process.read_parameters((options or {}).get("parameters"))
        if isinstance(seed, (list, tuple, np.ndarray)):
            seeds = [as_count(each, "each seed", low=0, high=2**64) for each in seed]
            if len(seeds) != self.num_envs:
                raise ValueError(f"give one seed, or {self.num_envs} of them, got {len(seeds)}")
            seed = int(np.random.SeedSequence(seeds).generate_state(1, np.uint64)[0] >> 1)
        super().reset(seed=seed)
        if seed is not None:
            self._process.forget()
        if not (self._consistent or mask.all()):
            raise gym.error.ResetNeeded("reset all environments first")
        chosen = np.flatnonzero(mask).tolist()
        read = [each.drawn(sources, self.np_random, chosen) for (_, each), sources in zip(links, read, strict=True)]
        self._consistent, self._ended = False, None
        for (_, each), sources in zip(links, read, strict=True):
            each.give(sources, chosen)
        self._begin(mask, starts, fixed)
        self._worst = np.where(mask, self._plant.values_at_start(self._state), self._worst)
        info = self._info(no_inputs(self._plant.m, self.num_envs), np.zeros(self.num_envs, np.bool_), mask)
        self._consistent = True
        self._draw(info, begins=mask, moved=False)
        return self._observation(), info

    @np.errstate(all="ignore")
    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Applies the inputs of actions of shape (N, m), for one step of every environment.

        Raises:
            ValueError: If an action is not finite or the shape is wrong; nothing has moved then.
            gymnasium.error.ResetNeeded: If there was no reset, or an earlier step failed half-way.
        """
        u = read_actions(self._plant, actions, self.num_envs)[1]
        if not self._consistent:
            raise gym.error.ResetNeeded("call reset: there was none, or an earlier step failed half-way")
        some_done = np.count_nonzero(self._done) > 0
        if some_done and self._autoreset_mode is AutoresetMode.DISABLED:
            raise gym.error.ResetNeeded("some episodes are over: reset them with options={'reset_mask': ...}")
        self._consistent, self._ended = False, None
        inputs = self._downlink_state.exchange(self.np_random, self.steps, u)
        applied, committed, missing = inputs
        arrived = self._advance(applied, self._requested(missing))
        reward = self._task.reward_many(self._plant, self._task_state, self._state, applied)
        restarted = self._done.copy() if some_done else None
        if restarted is not None:  # NEXT_STEP: the last step ended these episodes
            self._begin(restarted, None)
            applied, committed = (frozen(np.where(restarted, 0.0, each)) for each in (applied, committed))
            reward[restarted], arrived[restarted] = 0.0, False
            self._worst[:, restarted] = self._plant.values_at_start(self._state[:, restarted])
            inputs = Inputs(applied, committed, missing & ~restarted)
        info = self._info(inputs, arrived, None)
        terminated, truncated = self._ends(info["cost"], restarted)
        self._done = terminated | truncated
        observation = self._observation()
        if self._autoreset_mode is AutoresetMode.SAME_STEP and self._done.any():
            observation, info = self._restarted(observation, info)
            restarted = self._ended and self._ended[0]
        self._consistent = True
        self._draw(info, begins=restarted)
        return observation, reward, terminated, truncated, info

    def request(self, asked: Any = True) -> None:
        """Asks for samples in the next step, in all environments or where a mask (N,) says so; see `NCSEnv.request`.

        Raises:
            ValueError: If the channel does not take samples on request, or what is given is no bool.
        """
        require_on_request(self._requests).ask(asked)

    @property
    def outstanding(self) -> np.ndarray:
        """What `NCSEnv.outstanding` is, shape (N,).

        Raises:
            ValueError: If the channel does not take samples on request.
        """
        return require_on_request(self._requests).outstanding(self._estimator.age)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Returns the picture of `rendered_env` for each environment (`RecordVideo(record_first_only=True)`).

        Raises:
            gymnasium.error.ResetNeeded: If there was no reset.
        """
        if self._single.renderer is None or not self._consistent:
            self._single.render()  # says what is missing
            return None
        picture = self._single.renderer.render()
        return None if picture is None else (picture,) * self.num_envs

    def annotate(self, annotation: Annotation) -> None:
        """Shows what a shield knows of `rendered_env` in the picture of the next step or reset."""
        self._single.annotate(annotation)

    def _draw(self, info: dict[str, Any], begins: np.ndarray | None, *, moved: bool = True) -> None:
        renderer, e = self._single.renderer, self.rendered_env
        if renderer is None:
            return
        own = {key: value[e] for key, value in info.items() if not key.startswith(("_", "final"))}
        task_state = np.copy(self._task_state[..., e])[()]
        if begins is not None and begins[e]:
            renderer.begin(own, task_state)
        elif moved:
            step = int(self.steps[e])
            sends, arrival = self._channel_state.arrival_of(e, step)
            renderer.record(own, task_state, PacketRecord(step, arrival) if sends else None)

    def close_extras(self, **kwargs: Any) -> None:
        """Closes the process."""
        self._process.close()
        self._single.close()

    def inputs_of(self, actions: np.ndarray) -> np.ndarray:
        """Returns the float64 inputs, shape (m, N), that actions (N, m) stand for.

        Raises:
            ValueError: If one is not finite or the shape is wrong.
        """
        return read_actions(self._plant, actions, self.num_envs)[1]

    def _requested(self, missing: Any) -> np.ndarray | None:
        """Decides the requests; returns where a sample is requested now, (N,), or None if samples are not on request.

        A sensor that has not heard whether a sample is requested, where commands are missing (N,), takes it.
        """
        if self._requests is None:
            return None
        self._requests.decide(self._estimator.age)
        return self._requests.decided[0] | missing

    def _advance(self, u: np.ndarray, requested: np.ndarray | None) -> np.ndarray:
        """Moves everything one step on; returns where packets arrived, shape (N,).

        Args:
            u: Inputs, shape (m, N).
            requested: Where samples are requested, (N,); None if samples are not on request.
        """
        rng, estimator, before = self.np_random, self._estimator, self._state
        self._state = self._process.advance(rng, before, u, self.steps, self._disturbance_memory)
        self._worst = self._plant.worst_constraint_values(before, u, self._state)
        self._task_state = self._task.advance_many(rng, self._plant, self._task_state, u)
        self.steps += 1
        self.ticks += 1
        sends, samples = self._channel_state.send(rng, self.steps, requested), None
        self._packets = self._packets + sends
        if np.count_nonzero(sends):
            samples = self._channel_state.channel.quantize(self._process.measure(rng, self._state))
            if not np.isfinite(samples.sum()):  # no sensor within the assumptions sends this
                damaged = np.asarray(~np.isfinite(samples).all(axis=0))
                self._channel_state.discard(damaged)
                estimator.damaged |= sends & damaged
                estimator.alarm |= estimator.damaged
                samples[:, damaged] = 0.0  # times a gain of zero it is to be nothing
        arrivals = self._channel_state.arrivals()
        estimator.advance(u, samples, arrivals)
        arrived = np.zeros(self.num_envs, np.bool_)
        for _, arrives in arrivals:
            arrived |= arrives
        return arrived

    def _ends(self, cost: np.ndarray, restarted: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Returns which episodes are terminated and which truncated, shape (N,) each; those that just began are not."""
        terminated, truncated = np.zeros((2, self.num_envs), np.bool_)
        process = self._process.process
        if process.terminated is not False:  # other people's environments may end
            terminated, truncated = terminated | process.terminated, truncated | process.truncated
        if self._single.terminate_on_violation:
            terminated |= cost > 0.0
        if self._max_episode_steps is not None:
            truncated |= self.steps >= self._max_episode_steps
        if restarted is not None:
            terminated, truncated = terminated & ~restarted, truncated & ~restarted
        return terminated, truncated

    def _begin(self, mask: np.ndarray, starts: np.ndarray | None, fixed: np.ndarray | None = None) -> None:
        """Starts episodes where `mask` (N,) says so, at `starts` (N, n) or drawn from the initial set.

        `fixed` is what the process read of the parameters of a family, (N, k).
        """
        rng, rows = self.np_random, np.flatnonzero(mask)
        count = len(rows)
        first_states, first_errors = self._first(count)
        initial, states = (self._single.initial_set, first_states) if starts is None else (None, starts[mask].T)
        states, known = self._process.start_many(rng, states, initial, mask, fixed)
        task_state, memory = self._task.begin_many(rng, self._plant, count), self._process.begin(rng, count)
        channels, downlinks = self._uplinks.begin(rng, rows), self._downlinks.begin(rng, rows)
        if count == self.num_envs or not (self._uplinks.is_plain and self._downlinks.is_plain):
            self._network = channel_infos(self._uplinks, self._downlinks, many=True)
        if count == self.num_envs:
            self._task_state, self._disturbance_memory = np.array(task_state), np.array(memory)
            self._channel_state = VectorChannelState(channels or self._channel, rng, count)
        else:
            self._task_state = _with_columns(self._task_state, mask, task_state)
            self._disturbance_memory = _with_columns(self._disturbance_memory, mask, memory)
            self._channel_state.begin(rng, rows, channels)
        self._prepare_estimator(all_begin=count == self.num_envs)
        self._state[:, mask] = states
        self._estimator.begin(mask, states + first_errors)
        self._downlink_state.begin(rng, mask, downlinks)
        if self._requests is not None:
            self._requests.begin(mask, channels)
        self._packets = np.where(mask, 0, self._packets)
        self.steps[mask], self._violations[mask], self._done[mask] = 0, 0.0, False
        self.episodes[mask] += 1
        self.starts[mask] = known

    def _prepare_estimator(self, *, all_begin: bool) -> None:
        """Makes the estimator one for the delays of all present channels; it forgets nothing unless all begin."""
        known = self._estimator.histories.channel
        used = [self._channel] if self._uplinks.is_plain else [*self._uplinks.now, *([] if all_begin else [known])]
        if (wanted := covering(used, self._channel)) != known:
            histories = arrival_histories(self._plant, wanted, self._certificate_contract)
            if all_begin:
                self._estimator = VectorEstimator(self._plant, histories, self.num_envs)
            else:
                self._estimator.follow(histories)

    def _one_each(self, value: Any, name: str) -> list[Channel] | None:
        """Returns a channel that is given for all environments, or for each, as a list of N; None for None."""
        if value is None:
            return None
        each = list(value) if isinstance(value, (list, tuple)) else [value] * self.num_envs
        if len(each) != self.num_envs or not all(isinstance(channel, Channel) for channel in each):
            raise ValueError(
                f"{name} must be of type Channel, or a list of {self.num_envs} of these, got {shown(value)}"
            )
        return each

    def _predicted_estimates(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns estimates, (n, N), and numbers of error statistics, (N,), of the times of the next effects."""
        return self._estimator.predicted(self._downlink_state.committed.pending)

    def _first(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        rng = self.np_random
        states = (1.0 - SAMPLE_ROUNDING) * self._single.initial_set.sample(rng, count)
        return states.T, self._process.first_error(rng, count)

    def _observation(self) -> np.ndarray:
        task_state = self._task_state
        for u in self._downlink_state.committed.pending:
            task_state = self._task.predict_many(self._plant, task_state, u)
        return self._observer.observation(self._known, self._task.observe_many(task_state)).T

    def _info(self, inputs: Inputs, arrived: np.ndarray, counted: np.ndarray | None) -> dict[str, Any]:
        """Returns the infos; the costs of environments that are not `counted`, shape (N,), do not count once more."""
        plant = self._plant
        is_now = plant.between_samples is None and not len(plant.mixed_rows)
        values = self._worst.copy() if is_now else plant.constraint_values(self._state)
        cost = (np.maximum.reduce(self._worst) > 0.0).astype(np.float64)
        self._violations = self._violations + (cost if counted is None else cost * counted)
        estimates, numbers = self._predicted_estimates()
        table = self._estimator.histories.table
        constraints = Constraints(values, self._worst, cost, self._violations.copy())
        alarm = self._estimator.alarm | self._process.alarm
        age, damaged, outside = self._estimator.age.copy(), self._estimator.damaged.copy(), self._process.alarm.copy()
        applied, committed, missing = inputs
        shapes = table.shapes.take(numbers, axis=0)
        for array in (estimates, shapes, age, alarm, damaged, numbers, outside):
            array.setflags(write=False)
        self._known = Known(estimates, shapes, age, alarm, damaged, applied, committed, table, numbers, outside)
        asked, forced = self._nothing, self._nothing
        if self._requests is not None:
            asked, forced = self._requests.requested, self._requests.forced
        happened = self._estimator.mean, self._state, self.steps, missing, arrived
        sampled = Requested(asked, forced, self._packets)
        told = constraints, sampled, self._network | self._process.infos, actions_of(inputs, self._plant)
        return loop_info(self._known, *happened, self._oldest, *told)

    def _restarted(self, observation: np.ndarray, info: dict[str, Any]) -> tuple[np.ndarray, dict[str, Any]]:
        """Returns the first of new episodes where old ones ended, whose last go to final_obs and final_info."""
        done = self._done.copy()
        ended = self._known
        self._ended = frozen(done), ended
        final = {key: _where(done, value, np.zeros_like(value)) for key, value in info.items()}
        final |= {f"_{key}": done.copy() for key in info}
        final_observation = _where(done, observation, np.zeros_like(observation))
        self._begin(done, None)
        self._worst = self._plant.values_at_start(self._state)
        fresh = self._info(no_inputs(self._plant.m, self.num_envs), np.zeros(self.num_envs, np.bool_), done)
        inputs = (np.where(done, 0.0, each) for each in (ended.applied, ended.committed))
        self._known = self._known._replace(applied=frozen(next(inputs)), committed=frozen(next(inputs)))
        merged = {key: _where(done, fresh[key], value) for key, value in info.items()}
        return _where(done, self._observation(), observation), merged | {
            "final_obs": final_observation,
            "_final_obs": done.copy(),
            "final_info": final,
            "_final_info": done.copy(),
        }


def _where(mask: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Returns the first array where a mask (N,) is True, the second elsewhere; both have N as first axis."""
    return np.where(mask.reshape(-1, *[1] * (first.ndim - 1)), first, second)


def _autoreset_mode(value: AutoresetMode | str) -> AutoresetMode:
    """Returns a mode given as such or by its name."""
    for mode in AutoresetMode:
        if value is mode or (isinstance(value, str) and value == mode.value):
            return mode
    raise ValueError(f"autoreset_mode must be one of {[mode.value for mode in AutoresetMode]}, got {shown(value)}")
