"""Gymnasium's vector environments for stable-baselines3."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from gymnasium.wrappers.vector import NormalizeObservation
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from ncs_gym import NCSVectorEnv
from ncs_gym.validation import require_batched_infos

# Networks of control loops are small: more threads wait for each other, pay off at batches of 16384 only, and make
# results depend on their number. Set once, at the import, so that torch.set_num_threads afterwards has the last word.
torch.set_num_threads(1)

# Vector environments whose reset takes options={"reset_mask": ...} and resets only the environments in the mask.
_WITH_RESET_MASK = (NCSVectorEnv, SyncVectorEnv, AsyncVectorEnv)
# What gymnasium reports of ends of episodes, beside the infos of the next ones.
_FINAL = ("final_obs", "final_info")
# Infos that callbacks of the package and of others read at every step.
INFO_KEYWORDS = ("cost", "shield_intervened", "shield_correction", "shield_guaranteed")
# Infos of an episode's last step that become part of info["episode"], as with `Monitor(info_keywords=...)`.
_EPISODE_KEYS = ("episode_violations", "is_success", "episode_guaranteed")


class SB3VecEnv(VecEnv):
    """A gymnasium `VectorEnv` as a stable-baselines3 `VecEnv`.

    stable-baselines3 expects the step that ends an episode to return the first observation of the next episode, and
    the last observation in `info["terminal_observation"]`. This class provides that exactly for SAME_STEP autoreset,
    and for NEXT_STEP and DISABLED where single environments can be reset (`NCSVectorEnv`, gymnasium's sync and async).

    Like `Monitor` it adds `info["episode"]` (`r`, `l`, `t`) to the last step of an episode, with `episode_violations`,
    `is_success` and `episode_guaranteed` where there are such infos. Besides, the dict of an environment has those of
    its infos that `info_keywords` names, at every step; `batch_info` has all infos as arrays.

    Importing this class sets torch to one thread; call `torch.set_num_threads` after the import for another number.

    Attributes:
        batch_info: Infos of the last step, arrays with the environment as first axis; for an environment whose episode
            ended they are those of the episode's last step.

    Raises:
        ValueError: If episodes cannot be restarted in the step that ends them, or observations are not arrays.
    """

    def __init__(self, vector_env: VectorEnv, *, info_keywords: Sequence[str] = INFO_KEYWORDS) -> None:
        if not isinstance(vector_env, (VectorEnv, gym.vector.VectorWrapper)):
            raise ValueError(f"vector_env must be a gymnasium VectorEnv, got {type(vector_env).__name__}")
        if isinstance(vector_env.single_observation_space, (gym.spaces.Dict, gym.spaces.Tuple)):
            raise ValueError(f"observations must be arrays, got {vector_env.single_observation_space}")
        layer: Any = vector_env
        while isinstance(layer, gym.vector.VectorWrapper):
            if isinstance(layer, NormalizeObservation):
                raise ValueError(
                    "NormalizeObservation of vector environments cannot reset some of them: put stable-baselines3's "
                    "VecNormalize around SB3VecEnv in its place"
                )
            layer = layer.env
        if isinstance(info_keywords, str):
            raise ValueError(f"info_keywords must be names of infos, such as ('cost',), got {info_keywords!r}")
        self.vector_env, self._info_keywords = vector_env, tuple(info_keywords)
        self._mode = vector_env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)
        self._masks = isinstance(vector_env.unwrapped, _WITH_RESET_MASK)
        if self._mode is not AutoresetMode.SAME_STEP and not self._masks:
            raise ValueError(
                f"{type(vector_env.unwrapped).__name__} cannot reset some environments in the step that ends their "
                'episode: make it with autoreset_mode="SameStep", or with vectorization_mode="sync"'
            )
        self.batch_info: dict[str, Any] = {}
        self._started = time.time()
        super().__init__(vector_env.num_envs, vector_env.single_observation_space, vector_env.single_action_space)

    def reset(self) -> np.ndarray:
        """Starts all episodes, with the seeds and options of `seed` and `set_options`, which have to be the same."""
        options = self._options[0]
        if not all(_same(option, options) for option in self._options):
            self._reset_options()
            raise ValueError(
                "a vector environment takes the same options for all environments; for channels that differ give a "
                'list, {"channel": [c_1, ..., c_N]}, or draw them with VectorRandomChannel'
            )
        seeds: Any = None if self._seeds[0] is None else self._seeds
        if seeds is not None and not isinstance(self.vector_env.unwrapped, (SyncVectorEnv, AsyncVectorEnv)):
            seeds = seeds[0]
        observation, info = self.vector_env.reset(seed=seeds, options=options or None)
        require_batched_infos(info, "SB3VecEnv")
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._keep_first_infos(np.ones(self.num_envs, np.bool_), info)
        self._returns, self._lengths = np.zeros(self.num_envs), np.zeros(self.num_envs, np.int64)
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Stores a copy of the actions for `step_wait`."""
        self._actions = np.array(actions)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Steps all environments; returns observations, rewards (float32), dones and a dict per environment."""
        observation, rewards, terminated, truncated, info = self.vector_env.step(self._actions)
        done = terminated | truncated
        self._returns += rewards
        self._lengths += 1
        last = observation
        self.batch_info = info
        if self._mode is AutoresetMode.SAME_STEP and done.any():
            last = info["final_obs"]
            self.batch_info = _with_final(info, done)
        infos = _step_infos(_named(info, self._info_keywords), self.num_envs)
        # In SAME_STEP mode the others are those of the next episodes.
        final = info.get("final_info", info) if self._mode is AutoresetMode.SAME_STEP else info
        final = _named(final, (*self._info_keywords, *_EPISODE_KEYS))
        for e in np.flatnonzero(done).tolist():
            infos[e] = self._last_info(e, _info_of(final, e), last[e], bool(truncated[e] and not terminated[e]))
        if done.any():
            self._returns[done], self._lengths[done] = 0.0, 0
            if self._mode is AutoresetMode.SAME_STEP:
                self._keep_first_infos(done, info)
            else:
                fresh, reset_info = self.vector_env.reset(options={"reset_mask": done.copy()})
                observation = np.where(done.reshape(-1, *[1] * (observation.ndim - 1)), fresh, observation)
                self._keep_first_infos(done, reset_info)
        return observation, rewards.astype(np.float32), done, infos

    def _keep_first_infos(self, chosen: np.ndarray, info: dict[str, Any]) -> None:
        for e in np.flatnonzero(chosen).tolist():
            self.reset_infos[e] = _info_of(info, e)

    def _last_info(self, e: int, info: dict[str, Any], observation: np.ndarray, cut: bool) -> dict[str, Any]:
        """Returns the info of environment e, whose episode ends, made of what was reported."""
        elapsed = round(time.time() - self._started, 6)
        info["episode"] = {"r": float(self._returns[e]), "l": int(self._lengths[e]), "t": elapsed}
        info["episode"] |= {key: float(info[key]) for key in _EPISODE_KEYS if key in info}
        info["terminal_observation"] = np.array(observation)
        info["TimeLimit.truncated"] = cut
        return info

    def close(self) -> None:
        """Closes the environment."""
        self.vector_env.close()

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Returns an attribute of the outermost vector wrapper or environment that has it, the same for all.

        Raises:
            AttributeError: If there is no such attribute, or it holds arrays, which may be about all environments.
        """
        chosen, source = self._get_indices(indices), self.vector_env
        if attr_name in ("action_space", "observation_space"):
            return [getattr(self, attr_name) for _ in chosen]
        while source is not source.unwrapped and (hasattr(VectorWrapper, attr_name) or not _has_own(source, attr_name)):
            source = source.env  # pyright: ignore[reportAttributeAccessIssue]
        value = getattr(source, attr_name)
        if any(isinstance(each, np.ndarray) for each in (value if isinstance(value, tuple) else (value,))):
            raise AttributeError(f"{attr_name} is an array of {type(source).__name__}: read it from vector_env")
        return [value for _ in chosen]

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Raises AttributeError, as `env_method`."""
        self.env_method(attr_name)

    def env_method(
        self, method_name: str, *method_args: Any, indices: int | Iterable[int] | None = None, **method_kwargs: Any
    ) -> list[Any]:
        """Raises AttributeError: environments of a vector are reached through `vector_env`."""
        raise AttributeError(f"SB3VecEnv reaches no {method_name} of single environments: use vec_env.vector_env")

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper], indices: int | Iterable[int] | None = None
    ) -> list[bool]:
        """Returns whether a vector wrapper of that class is around; True for `Monitor`, whose infos are provided."""
        wrapped, layer = wrapper_class is Monitor, self.vector_env
        while isinstance(layer, VectorWrapper):
            wrapped |= isinstance(layer, wrapper_class)
            layer = layer.env
        return [wrapped for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Returns a frame per environment, None where the vector environment renders none."""
        frames: Any = self.vector_env.render() if self.vector_env.render_mode is not None else None
        if frames is not None and isinstance(self.vector_env.unwrapped, NCSVectorEnv):
            return frames[:1]  # all are the picture of the environment that was chosen
        if frames is None:
            return [None] * self.num_envs
        return [frame if isinstance(frame, np.ndarray) else None for frame in frames]


def _dense(info: dict[str, Any]) -> dict[str, np.ndarray]:
    return {
        key: value
        for key, value in info.items()
        if not key.startswith("_") and key not in _FINAL and not isinstance(value, dict)
    }


def _named(info: dict[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """Returns the infos of these names, and gymnasium's marks of who reported them."""
    return {key: info[key] for name in names for key in (name, f"_{name}") if key in info}


def _step_infos(info: dict[str, Any], count: int) -> list[dict[str, Any]]:
    """Returns a dict per environment with what it reported, in which no episode ends."""
    if any(isinstance(value, dict) or (key.startswith("_") and not np.all(value)) for key, value in info.items()):
        return [{"TimeLimit.truncated": False} | _info_of(info, e) for e in range(count)]
    infos: list[dict[str, Any]] = [{"TimeLimit.truncated": False} for _ in range(count)]
    for key, values in info.items():
        if not key.startswith("_"):
            for each, value in zip(infos, values.tolist() if values.ndim == 1 else values.copy(), strict=True):
                each[key] = value
    return infos


def _info_of(info: dict[str, Any], e: int) -> dict[str, Any]:
    """Returns what environment e reported: gymnasium fills arrays up, and marks what was in them before."""
    return {
        key: _info_of(value, e) if isinstance(value, dict) else value[e]
        for key, value in info.items()
        if not key.startswith("_") and key not in _FINAL and (f"_{key}" not in info or info[f"_{key}"][e])
    }


def _with_final(info: dict[str, Any], done: np.ndarray) -> dict[str, Any]:
    """Returns the infos, of environments whose episode ended those of the last step."""
    final = _dense(info.get("final_info", {}))
    merged = dict(info) | {key: value for key, value in final.items() if key not in info}
    for key in final.keys() & _dense(info).keys():
        value = info[key]
        merged[key] = np.where(done.reshape(-1, *[1] * (value.ndim - 1)), final[key], value)
    return merged


def _has_own(source: VectorEnv, name: str) -> bool:
    """Returns whether a layer has an attribute itself, not by what is inside."""
    return name in vars(source) or hasattr(type(source), name)


def _same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(one[key], other[key]) for key in one)
