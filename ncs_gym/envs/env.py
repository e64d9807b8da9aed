"""The Gymnasium environment: plant -> sensor -> channel -> estimator -> observation."""

from __future__ import annotations

from typing import Any, ClassVar, TypeVar

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box

from ncs_gym.estimation.error_bound import UnstablePlantError, certified_error_set
from ncs_gym.estimation.estimator import Estimator
from ncs_gym.network.channel import Channel, Link
from ncs_gym.network.contract import ChannelContract, contract_of
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.rendering import Annotation, Renderer
from ncs_gym.tasks.task import Regulation, Task
from ncs_gym.uncertainty.disturbance import as_disturbance, checked, stays_inside
from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.validation import as_count, as_flag, as_numbers, as_vector, read_only, shown

T = TypeVar("T")

# The default start covers this share of the half-width of the safe box in every direction.
START_SHARE = 0.1
# Keeps the rounding of a sampled start inside the initial set.
SAMPLE_ROUNDING = 1e-9
# Observations of an unstable plant end this many half-widths of the box out: what lies beyond is lost anyway.
FARTHEST_OBSERVED = 1e6
# The steps the observation space is sized for are gone through one by one.
LONGEST_HORIZON = 100_000
# Widens the observation box: float32 rounding, and estimates a little off the reachable set.
OBSERVATION_MARGIN = 1.01
RENDER_MODES = ["human", "rgb_array"]
RENDER_FPS = 30


class RenderModeError(ValueError, TypeError):
    """An unknown render mode; a TypeError too, because stable-baselines3 asks for "rgb_array" and retries on that."""


class NCSEnv(gym.Env[np.ndarray, np.ndarray]):
    """A linear plant behind an imperfect network; the controller sees a Kalman estimate.

    ## Action space
    `Box(-1, 1, (m,), float32)`: the input in units of its limit, u = u_max * action [physical units].
    Finite actions outside the box are clipped.

    ## Observation space
    A finite `Box` of float32, sized by what the plant and the task can reach within `horizon` steps:

    | entries | meaning | unit |
    |---|---|---|
    | first n | Kalman estimate x_hat | those of the state |
    | rest | the task's own, perfectly known entries | those of the task |

    ## Step
    x+ = A x + B u + d (where an unstable plant runs away, up to `plant.farthest`). The sensor measures y = H x+ + v;
    the channel quantizes, rations, loses and delays it;
    the estimator predicts with the input really applied and takes in what arrived (`theory.md` section 1).

    ## Rewards
    The task's; see `Regulation` and `SpeedTracking`.

    ## Starting state
    Uniform in `initial_set`, or `options={"state": x0}`. The first estimate is off by truncated Gaussian noise.

    ## Episode end
    Terminates on a violation of the safe box only with `terminate_on_violation`. Truncation is `TimeLimit`'s.

    ## Info (the same keys from reset and step, every array a fresh copy)
    | key | meaning |
    |---|---|
    | `state`, `estimate` | x and x_hat, float64, shape (n,) |
    | `estimation_error` | estimate - state |
    | `error_shape` | running Sigma_k, shape (n, n): the error lies in E(Sigma_k) |
    | `input` | applied input, shape (m,) [physical units]; zeros at reset |
    | `constraint_values` | abs(c_j x) - 1 per row of the safe box; positive is violated |
    | `cost` | 1.0 if the true state violates the box now, else 0.0 |
    | `measurement_age` | steps since the newest sample used was taken (the first estimate is step 0's) |
    | `packet_arrived` | whether a packet arrived at this step |
    | `assumption_violated` | latched alarm of the estimator's innovation monitor |
    | `episode_violations` | running sum of `cost` in this episode |
    | `is_success` | 1.0 while there was none |
    | `contract_broken` | whether the newest sample used is older now than the channel's contract allows |

    Args:
        plant: The plant with its bounds.
        channel: The network; a perfect one by default.
        task: The reward; `Regulation` by default.
        disturbance: "ball", "box", "sinusoid" (truncated process noise is added), "sphere", "adversarial" (in
            its place), a `Disturbance`, or a callable (rng, plant, nominal_next) -> d.
        initial_set: Ellipsoid of starting states; by default a tenth of the safe box.
        terminate_on_violation: End the episode when the true state leaves the safe box.
        allow_assumption_violation: Let disturbances outside the certified bound pass instead of raising.
        contract: What the channel promises, for unstable plants (docs/contracts.md); by default that of the channel
            if the plant is unstable, none if it is stable. A channel that may break it is allowed.
        render_mode: "human" shows every step in a window, "rgb_array" makes `render` return an image; both need
            the extra `[render]` (docs/rendering.md).
        horizon: Steps the observation space is sized for.

    Attributes:
        steps: Steps taken in this episode.
        episodes: Episodes begun.
        start: What the start of this episode is known to lie in: `initial_set`, or the state given as an option.

    Raises:
        UnstablePlantError: If the plant is not Schur stable and there is no contract.
        ErrorSetError: If it is too ill-conditioned.
        ValueError: If a setting is of the wrong kind or does not fit the plant.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": RENDER_MODES, "render_fps": RENDER_FPS}
    observation_space: Box
    action_space: Box

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
        horizon: int = 200,
    ) -> None:
        self.plant = _expect(plant, LinearPlant, "plant")
        self.channel = Channel() if channel is None else _expect(channel, Channel, "channel")
        self.task = Regulation() if task is None else _expect(task, Task, "task")
        self.terminate_on_violation = as_flag(terminate_on_violation, "terminate_on_violation")
        self.allow_assumption_violation = as_flag(allow_assumption_violation, "allow_assumption_violation")
        self.disturbance = as_disturbance(disturbance, plant, self.allow_assumption_violation)
        self.initial_set = default_initial_set(plant) if initial_set is None else initial_set
        _expect(self.initial_set, Ellipsoid, "initial_set")
        if self.initial_set.dim != plant.n:
            raise ValueError(f"initial_set must have dimension {plant.n}, got {self.initial_set.dim}")
        if problem := self.task.check(plant):
            raise ValueError(f"{type(self.task).__name__}: {problem}")
        if render_mode is not None and not (isinstance(render_mode, str) and render_mode in RENDER_MODES):
            raise RenderModeError(f"render_mode must be None or one of {RENDER_MODES}, got {shown(render_mode)}")
        self.render_mode = render_mode
        self._renderer = None if render_mode is None else Renderer(plant, self.task, render_mode, RENDER_FPS)
        self.contract = _contract(plant, self.channel, contract)
        self.error_set = certified_error_set(plant, self.contract)
        self.estimator = Estimator(plant, self.channel, self.error_set)
        self.horizon = as_count(horizon, "horizon", low=1, high=LONGEST_HORIZON)
        self.action_space = Box(-1.0, 1.0, (plant.m,), np.float32)
        bound = _as_float32(observation_bound(self))
        self.observation_space = Box(-bound, bound, dtype=np.float32)
        self.steps = self.episodes = 0
        self.start: Ellipsoid | np.ndarray = self.initial_set
        self._consistent = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: Seeds `np_random`, the only source of randomness.
            options: {"state": x0} starts at x0, shape (n,).

        Raises:
            ValueError: If an option is unknown or x0 has a wrong shape or is not finite.
        """
        start = _start_option(options, self.plant.n)
        super().reset(seed=seed)
        self._consistent = False
        rng = self.np_random
        self.start = self.initial_set if start is None else read_only(start)
        self._state = (1.0 - SAMPLE_ROUNDING) * self.initial_set.sample(rng) if start is None else start
        self._task_memory = self.task.begin(rng, self.plant)
        self._disturbance_memory = self.disturbance.begin(rng, self.plant)
        self._link = Link(self.channel, rng)
        self.estimator.reset(self._state + self.plant.initial_noise.sample(rng))
        self.steps = 0
        self.episodes += 1
        self._violations = 0.0
        self._consistent = True
        info = self._info(np.zeros(self.plant.m), packet_arrived=False)
        if self._renderer is not None:
            self._renderer.begin(info, self._task_memory)
        return self._observation(), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Applies u = u_max * action for one step.

        Raises:
            ValueError: If the action is not finite or wrongly shaped; nothing has moved then.
            gymnasium.error.ResetNeeded: If there was no reset, or an earlier step failed half-way.
        """
        u = applied_input(self.plant, action)
        if not self._consistent:
            raise gym.error.ResetNeeded("call reset: there was none, or an earlier step failed half-way")
        self._consistent = False
        rng = self.np_random
        nominal_next = self.plant.A @ self._state + self.plant.B @ u
        moved, farthest = nominal_next + self._draw_disturbance(nominal_next), self.plant.farthest
        self._state = np.clip(moved, -farthest, farthest)
        self._task_memory = self.task.advance(rng, self.plant, self._task_memory, u)
        self.steps += 1
        sample = self._measure() if self._link.sends_at(self.steps) else None
        packets = self._link.exchange(rng, self.steps, sample)
        self.estimator.advance(u, packets)
        reward = self.task.reward(self.plant, self._task_memory, self._state, u)
        info = self._info(u, packet_arrived=bool(packets))
        terminated = self.terminate_on_violation and info["cost"] > 0.0
        self._consistent = True
        if self._renderer is not None:
            self._renderer.record(info, self._task_memory, self._link, packets)
        return self._observation(), float(reward), terminated, False, info

    def render(self) -> np.ndarray | None:
        """Returns an image, shape (height, width, 3), uint8; None in mode "human", which shows every step by itself.

        Raises:
            gymnasium.error.DependencyNotInstalled: If pygame is missing.
            gymnasium.error.ResetNeeded: If there was no reset.
        """
        if self._renderer is None:
            gym.logger.warn('render() draws nothing without a render mode: gym.make(..., render_mode="rgb_array")')
            return None
        if not self._consistent:
            raise gym.error.ResetNeeded("call reset before render")
        return self._renderer.render()

    def annotate(self, annotation: Annotation) -> None:
        """Shows what a shield knows in the picture of the next step or reset; nothing where nothing is drawn."""
        if self._renderer is not None:
            self._renderer.annotate(annotation)

    def close(self) -> None:
        """Closes the window."""
        if self._renderer is not None:
            self._renderer.close()

    def _draw_disturbance(self, nominal_next: np.ndarray) -> np.ndarray:
        rng, source = self.np_random, self.disturbance
        d = source.draw(rng, self.plant, nominal_next, self.steps, self._disturbance_memory)
        if not source.replaces_process_noise:
            d = d + self.plant.process_noise.sample(rng)
        if stays_inside(source):
            return d
        return checked(self.plant, d, allow_assumption_violation=self.allow_assumption_violation)

    def _measure(self) -> np.ndarray:
        return self.plant.H @ self._state + self.plant.sensor_noise.sample(self.np_random)

    def _observation(self) -> np.ndarray:
        entries = np.concatenate([self.estimator.belief.mean, self.task.observe(self._task_memory)])
        space = self.observation_space
        return np.clip(entries, space.low, space.high).astype(np.float32)

    def _info(self, u: np.ndarray, *, packet_arrived: bool) -> dict[str, Any]:
        belief = self.estimator.belief
        values = self.plant.constraint_values(self._state)
        cost = float(values.max() > 0.0)
        self._violations += cost
        return {
            "state": self._state.copy(),
            "estimate": belief.mean.copy(),
            "estimation_error": belief.mean - self._state,
            "error_shape": belief.shape.copy(),
            "input": u.copy(),
            "constraint_values": values,
            "cost": cost,
            "measurement_age": self.estimator.age,
            "packet_arrived": packet_arrived,
            "assumption_violated": self.estimator.alarm,
            "episode_violations": self._violations,
            "is_success": float(self._violations == 0.0),
            "contract_broken": self.contract is not None and self.estimator.age > self.contract.max_age,
        }


def applied_input(plant: LinearPlant, action: Any) -> np.ndarray:
    """Returns the float64 input u = u_max * clip(action, -1, 1), shape (m,), that an action stands for.

    Raises:
        ValueError: If the action is not finite or does not have shape (m,).
    """
    normalized = as_numbers(action)
    if normalized is None or normalized.shape != (plant.m,) or not np.isfinite(normalized).all():
        raise ValueError(f"the action must be finite with shape ({plant.m},), got {shown(action)}")
    return plant.u_max * np.clip(normalized, -1.0, 1.0)


def default_initial_set(plant: LinearPlant) -> Ellipsoid:
    """Returns the starts {x : |C x|^2 <= 0.1^2}, well inside the safe box; W bounds directions C leaves free."""
    return Ellipsoid(START_SHARE**2 * np.linalg.inv(plant.weight))


def observation_bound(env: NCSEnv) -> np.ndarray:
    """Returns the largest absolute value of each observation entry, shape (n + extra,).

    The reach of x_hat is that of x from the initial set under every input and disturbance within the horizon,
    plus the certified error.
    """
    plant = env.plant
    reach = np.zeros(plant.n)
    power = np.eye(plant.n)
    largest = env.initial_set.support(power)
    for _ in range(env.horizon):
        reach += np.abs(power @ plant.B) @ plant.u_max + plant.disturbance.support(power)
        power = power @ plant.A
        largest = np.maximum(largest, reach + env.initial_set.support(power))
    ages = env.error_set.ages
    shapes = env.error_set.Sigma[None] if ages is None else ages.shapes
    estimate = largest + np.sqrt(np.diagonal(shapes, axis1=1, axis2=2).max(axis=0))
    estimate = np.minimum(
        estimate, np.maximum(FARTHEST_OBSERVED * plant.half_widths, env.initial_set.support(np.eye(plant.n)))
    )
    bound = np.concatenate([estimate, env.task.observation_bound(plant, env.horizon)])
    return OBSERVATION_MARGIN * bound


def _as_float32(bound: np.ndarray) -> np.ndarray:
    """Returns the bounds of observations in single precision.

    Raises:
        ValueError: If one is beyond its range, so that observations would be infinite, or always zero.
    """
    numbers = np.finfo(np.float32)
    if not ((bound >= numbers.tiny) & (bound <= numbers.max)).all():
        raise ValueError(
            f"observations of up to {shown(bound.tolist())} are out of float32's range: choose other units"
        )
    return bound.astype(np.float32)


def _contract(plant: LinearPlant, channel: Channel, contract: ChannelContract | None) -> ChannelContract | None:
    """Returns the contract that the estimator's error sets rest on.

    Raises:
        UnstablePlantError: If an unstable plant has neither a contract nor a channel that keeps one.
        ValueError: If the channel rounds more coarsely than the contract allows.
    """
    if contract is None and plant.spectral_radius >= 1.0:
        contract = contract_of(channel)
        if contract is None:
            raise UnstablePlantError(
                f"the plant is unstable (spectral radius {plant.spectral_radius:.6g}), the channel promises nothing: "
                "give it max_consecutive_losses, or the environment contract=ChannelContract(max_age=...)"
            )
    if contract is not None and not _expect(contract, ChannelContract, "contract").is_fine_enough_for(channel):
        raise ValueError(
            f"the channel rounds to {channel.quantization_step}, the contract allows {contract.quantization_step}"
        )
    return contract


def _start_option(options: dict[str, Any] | None, n: int) -> np.ndarray | None:
    """Returns options["state"] as a finite array of shape (n,), or None without one."""
    options = known_options(options, {"state"})
    if "state" not in options:
        return None
    return as_vector(options["state"], n, "options['state']")


def known_options(options: Any, known: set[str]) -> dict[str, Any]:
    """Returns the options of a reset; an empty dict for None.

    Raises:
        ValueError: If they are no dict, or have other keys.
    """
    if options is not None and not isinstance(options, dict):
        raise ValueError(f"the options of reset must be a dict, got {shown(options)}")
    if unknown := [key for key in options or {} if key not in known]:
        raise ValueError(f"reset knows the options {sorted(known)} only, got {shown(unknown)}")
    return options or {}


def ncs_env(env: gym.Env) -> NCSEnv:
    """Returns the environment inside all wrappers.

    Raises:
        ValueError: If it is not an `NCSEnv`.
    """
    inner = env.unwrapped
    if not isinstance(inner, NCSEnv):
        raise ValueError(f"expected an NCSEnv inside, got {type(inner).__name__}")
    return inner


def _expect(value: Any, kind: type[T], name: str) -> T:
    if not isinstance(value, kind):
        raise ValueError(f"{name} must be of type {kind.__name__}, got {type(value).__name__}")
    return value
