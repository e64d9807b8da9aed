"""The Gymnasium environment: plant -> sensor -> channel -> estimator -> observation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box

from ncs_gym.ellipsoid import Ellipsoid
from ncs_gym.envs.guarded_loop import GuardedLoop
from ncs_gym.envs.json_settings import SpecOfJson
from ncs_gym.envs.loop import Loop, OneLoop
from ncs_gym.envs.loop_settings import expect, require_suitable, start_option
from ncs_gym.envs.spaces import Observer, observation_space, read_action, read_observed
from ncs_gym.network.channel import Channel, ChannelContract
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes.process import Process
from ncs_gym.tasks import Regulation, Task
from ncs_gym.validation import as_count, as_flag, setting, shown

# The steps the observation space is sized for are gone through one by one.
DEFAULT_HORIZON, LONGEST_HORIZON = 200, 100_000
RENDER_MODES = ["human", "rgb_array"]
RENDER_FPS = 30


class RenderModeError(ValueError, TypeError):
    """An unknown render mode; a TypeError too, because stable-baselines3 asks for "rgb_array" and retries on that."""


class NCSEnv(SpecOfJson, GuardedLoop, gym.Env[np.ndarray, np.ndarray]):
    """A plant behind an imperfect network; the controller sees an estimate of the state.

    ## Action space
    `Box(-1, 1, (m,), float32)`: -1 is the low end of an input's limits, 1 the high one, 0 the middle.
    Finite actions outside the box are clipped.

    ## Observation space
    A finite `Box` of float32, sized by what the plant and the task can reach within `horizon` steps, for an unstable
    plant by what one step out of the safe box can reach. Observations are clipped; `info` is not:

    | entries | meaning | unit |
    |---|---|---|
    | first n | the estimate x_hat (`info["estimate"]`) | those of the state |
    | next | the task's own, perfectly known entries | those of the task |
    | rest | with `observe=("age", "error")`: age of the newest sample used, half-widths of the error | steps, states |

    ## Step
    x+ = A x + B u + d (where an unstable plant runs away, up to `plant.state_limit`). The sensor measures y = H x+ + v;
    the channel quantizes it, sends it every few steps, loses and delays it; the estimator predicts with the input that
    was really applied and takes in what arrived (docs/shield_proof.md).

    ## Rewards
    The task's; see `Regulation`, `SpeedTracking` and `SetpointTracking`.

    ## Starting state
    Uniform in `initial_set`, or `options={"state": x0}`, in deviations from the operating point. The first estimate is
    off by Gaussian noise (truncated unless `noise` says otherwise) and a uniform draw from the plant's
    `of_first_error.bound`. Other options of `reset` give the episode another channel, or another member of the family.

    ## Episode end
    Terminates on a violation of the safe box only with `terminate_on_violation`, or with an environment that is the
    process. Truncation is that of the `TimeLimit` around, or that environment's own.

    ## Info (the same keys from reset and step, every array a fresh copy)
    States and inputs are deviations from the plant's operating point (`plant.operating_state`). Keys of
    the second table are there where the environment has what stands with them.

    | key | shape or type | unit | meaning |
    |---|---|---|---|
    | `state` | `(n,)` | of the states | the true state x |
    | `estimate` | `(n,)` | of the states | the estimate x_hat; behind a downlink that of when the next action acts |
    | `estimation_error` | `(n,)` | of the states | x_hat - x now, also behind a downlink |
    | `error_shape` | `(n, n)` | of the states, squared | Sigma_k: the error of `estimate` lies in E(Sigma_k) |
    | `input` | `(m,)` | of the inputs | the input applied in this step; zeros at reset |
    | `action_applied` | `(m,)` | - | the action in [-1, 1] that stands for `input`, float32 |
    | `action_committed` | `(m,)` | - | likewise of what was decided in this step, which clones learn |
    | `constraint_values` | `(k,)` | - | how far c_j x is beyond a limit, in halves of its range; positive is violated |
    | `cost` | float | - | 1.0 if a limit was violated since the last step, else 0.0 |
    | `episode_steps` | int | steps | steps taken in this episode |
    | `measurement_age` | int | steps | age of the newest sample used; the first estimate counts as a sample of step 0 |
    | `packet_arrived` | bool | - | whether a packet arrived at this step |
    | `assumption_violated` | bool | - | whether a measurement or the plant's step broke a bound since the reset |
    | `episode_violations` | float | steps | sum of `cost` in this episode |
    | `is_success` | float | - | 1.0 while `episode_violations` is zero, else 0.0 |
    | `contract_broken` | bool | - | whether the newest sample used is older now than the channel's contract allows |
    | `packets` | int | packets | samples sent in this episode |
    | `channel_loss` | float | - | long-run share of samples that this episode's channel loses (`Channel.mean_loss`) |
    | `channel_delay` | int | steps | longest delay of this episode's channel |
    | `downlink_loss` | float | - | likewise of its downlink; zero for an ideal one |
    | `downlink_delay` | int | steps | likewise |

    | key | shape or type | unit | meaning | where |
    |---|---|---|---|---|
    | `input_committed` | `(m,)` | of the inputs | the input decided in this step, for c steps later | downlink |
    | `downlink_broken` | bool | - | whether zero was applied because the committed input had not arrived | downlink |
    | `requested` | bool | - | whether a sample was requested in this step | on request |
    | `request_forced` | bool | - | whether only the contract asked for it | on request |
    | `worst_constraint_values` | `(k + q,)` | - | the largest since the last step, those of x and u too | more limits |
    | `parameters` | `(f,)` | of the parameters | those of the member that moves | family |

    "More limits" are limits at all times and limits of states and inputs together.

    Args:
        plant: The plant with its bounds.
        channel: The network; a perfect one by default.
        task: The reward; `Regulation` by default.
        disturbance: "ball", "box", "sinusoid" (truncated process noise is added), "sphere", "adversarial" (in its
            place), a `Disturbance`, or a function (rng, plant, nominal_next) -> d.
        initial_set: Ellipsoid of starting states; by default a tenth of the safe box, where its ends are not symmetric
            about the operating point of the largest box inside that is; states without a limit start at that point.
        terminate_on_violation: End the episode when the true state leaves the safe box.
        allow_assumption_violation: Let disturbances outside the certified bound pass instead of raising; infos say so.
        contract: What the channel promises (docs/contracts.md); by default that of the channel if the plant is
            unstable, none if it is stable. A channel that may break it is allowed.
        render_mode: "human" shows every step in a window, "rgb_array" makes `render` return an image; both need
            the extra `[render]` (docs/ncs_gym.md).
        horizon: Steps the observation space is sized for; give it beside a longer `max_episode_steps`.
        noise: "truncated"; "gaussian" for noise and first errors without a bound, where what is proved holds except
            with probability at most `bound_violation_probability` (docs/shield.md); or "extreme" for sensor noise and
            first errors as large as assumed, in random directions.
        process: What really moves (docs/beyond_linear.md); by default the plant's own equations, or those of another
            member of its family in every episode.
        downlink: The network between controller and actuator (docs/contracts.md); ideal by default.
        downlink_contract: What is assumed of the downlink, which may then break it; by default what its settings
            guarantee.
        observe: What observations hold besides, after the task's entries: "age", that of the newest sample used
            [steps], and "error", the n half-widths of the error's ellipsoid E(Sigma_k) [units of the states].

    Attributes:
        downlink_protocol: How commands are sent over the downlink, with its `input_delay`: 0 for an ideal one.
        certificate_contract: Contract that a certificate for this environment rests on: `contract` with c steps added.
        steps: Steps taken in this episode.
        episodes: Episodes begun.
        episode_channel: The channel of this episode, `channel` unless an option of the reset gave another one.
        episode_downlink: The downlink of this episode, likewise.
        start: What the start of this episode is known to lie in: `initial_set`, or the state given as an option.

    Raises:
        UnstablePlantError: If the plant is not Schur stable and there is no contract.
        ErrorSetError: If it is too ill-conditioned.
        ValueError: If a setting is of the wrong kind or does not fit the plant.
    """

    renderer_of: ClassVar[Callable[..., Any]]  # set where the package is put together
    metadata: ClassVar[dict[str, Any]] = {"render_modes": RENDER_MODES, "render_fps": RENDER_FPS}
    observation_space: Box
    action_space: Box
    _now: OneLoop
    task: Task = setting("task")
    terminate_on_violation: bool = setting("terminate_on_violation")
    horizon: int = setting("horizon")
    observe: tuple[str, ...] = setting("observe")
    steps: int = setting("steps", "_now.steps")
    episodes: int = setting("episodes", "_now.episodes")
    start: Ellipsoid | np.ndarray = setting("start", "_now.start")

    def __init__(
        self,
        plant: LinearPlant,
        channel: Channel | None = None,
        task: Task | None = None,
        disturbance: Any = "ball",
        initial_set: Ellipsoid | None = None,
        terminate_on_violation: bool = False,
        allow_assumption_violation: bool = False,
        contract: ChannelContract | None = None,
        render_mode: str | None = None,
        horizon: int = DEFAULT_HORIZON,
        noise: str = "truncated",
        process: Process | None = None,
        downlink: Channel | None = None,
        downlink_contract: ChannelContract | None = None,
        observe: Sequence[str] = (),
    ) -> None:
        loop = Loop(
            plant=plant,
            channel=channel,
            disturbance=disturbance,
            initial_set=initial_set,
            allow_assumption_violation=allow_assumption_violation,
            contract=contract,
            noise=noise,
            process=process,
            downlink=downlink,
            downlink_contract=downlink_contract,
        )
        self._task = Regulation() if task is None else expect(task, Task, "task")
        self._terminate_on_violation = as_flag(terminate_on_violation, "terminate_on_violation")
        require_suitable(self._task, plant)
        if render_mode is not None and not (isinstance(render_mode, str) and render_mode in RENDER_MODES):
            raise RenderModeError(f"render_mode must be None or one of {RENDER_MODES}, got {shown(render_mode)}")
        self.render_mode = render_mode
        self.renderer = None if render_mode is None else self.renderer_of(plant, self._task, render_mode, RENDER_FPS)
        self._now = OneLoop(loop)
        self._horizon = as_count(horizon, "horizon", low=1, high=LONGEST_HORIZON)
        self.action_space = Box(-1.0, 1.0, (plant.m,), np.float32)
        input_delay = len(self._now.pending)
        self._observe = read_observed(observe)
        sets, steps = (self.error_set, self.initial_set), self._horizon + input_delay
        self.observation_space = observation_space(plant, self._task, *sets, steps, input_delay, self._observe)
        self._observer = Observer(self._task, self.observation_space, self._observe, self._horizon)
        self._over = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: Seeds `np_random`, the only source of randomness, and the generator of the task that it spawns.
            options: {"state": x0} starts at x0, shape (n,). {"channel": c}, {"downlink": c} give this episode another
                channel, a `Channel` or a function (rng) -> Channel that draws one. Contract, error set and spaces stay
                as they are: a channel may break the contract, but one that rounds more coarsely than the environment's
                own, or delays commands by more than its downlink commits ahead, is refused. {"parameters": {name:
                value}} fixes parameters of the member of a family that moves in this episode; others are drawn.

        Raises:
            ValueError: If an option is unknown or wrong, or the environment cannot have the channel.
        """
        start, now = start_option(options, self.plant), self._now
        sources, fixed = now.read(options)
        super().reset(seed=seed)
        chosen = now.choose(sources, self.np_random)
        self._consistent = False
        if seed is not None:
            now.process.forget()
        now.begin(self.np_random, start, fixed, chosen)
        self._begin_draws_of_task(seed)
        self._task_state = self._task.begin(self._task_random, self.plant)
        guard = self._guard
        self._belief, info = now.report()
        if guard is not None:
            guard.begin(self._belief, *now.beginning())
            info |= guard.info()
        self._consistent, self._over = True, False
        if self.renderer is not None:
            self.renderer.begin(info, self._task_state, guard)
        observation = self._observation()
        if guard is not None:
            guard.lost.tell()
        return observation, info

    @np.errstate(all="ignore")
    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Applies the input of an action for one step.

        Raises:
            ValueError: If the action is not finite or wrongly shaped; nothing has moved then.
            gymnasium.error.ResetNeeded: If there was no reset, an earlier step failed half-way, or ended the episode.
        """
        read, now = read_action(self.plant, action), self._now
        if not self._consistent:
            raise gym.error.ResetNeeded("call reset: there was none, or an earlier step failed half-way")
        if self._over:
            raise gym.error.ResetNeeded("the episode is over, as the step before said: call reset")
        self._consistent = False
        guard, u = self._guard, read[1]
        if guard is not None and (decided := guard.decide(u)).intervened:
            u = decided.input
        now.move(self.np_random, u)
        applied = now.inputs.applied
        self._task_state = self._task.advance(self._task_random, self.plant, self._task_state, applied)
        reward = self._task.reward_one(self.plant, self._task_state, now.state, applied)
        self._belief, info = now.report(read)
        if guard is not None:
            guard.observe(self._belief)
            info |= guard.info()
            reward -= guard.penalty * info["shield_intervened"]
        process = now.process.process
        terminated = process.terminated or (self._terminate_on_violation and info["cost"] > 0.0)
        truncated = process.truncated
        self._consistent, self._over = True, terminated or truncated
        if self.renderer is not None:
            self.renderer.record(info, self._task_state, now, guard)
        observation = self._observation()
        if guard is not None:
            guard.lost.tell()
        return observation, reward, terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """Returns an image, shape (height, width, 3), uint8; None in mode "human", which shows every step by itself.

        Raises:
            gymnasium.error.DependencyNotInstalled: If pygame is missing.
            gymnasium.error.ResetNeeded: If there was no reset.
        """
        if self.renderer is None:
            gym.logger.warn('render() draws nothing without a render mode: gym.make(..., render_mode="rgb_array")')
            return None
        if not self._consistent:
            raise gym.error.ResetNeeded("call reset before render")
        return self.renderer.render()

    @property
    def episode_channel(self) -> Channel:
        """See the class."""
        return self._now.channels.now[0]

    @property
    def episode_downlink(self) -> Channel | None:
        """See the class; None for an ideal one."""
        return self._now.downlinks.now[0]

    def close(self) -> None:
        """Closes the window and the process."""
        self._now.process.close()
        if self.renderer is not None:
            self.renderer.close()

    def _observation(self) -> np.ndarray:
        task_state = self._task_state
        for u in self._now.downlink.committed.pending:
            task_state = self._task.predict_one(self.plant, task_state, u)
        return self._observer.observation(self._belief, self._task.observe(task_state))


def ncs_env(env: gym.Env) -> NCSEnv:
    """Returns the environment inside all wrappers; raises ValueError if it is not an `NCSEnv`."""
    inner = env.unwrapped
    if not isinstance(inner, NCSEnv):
        raise ValueError(
            f"expected an NCSEnv inside, got {type(inner).__name__}, which has no plant: ncs_gym.Networked puts a "
            "network without a shield around any environment"
        )
    return inner
