"""A trained policy, and its files: `agent.json`, and stable-baselines3's `model.zip`, whose weights alone are read.

torch is imported where an agent is read.
"""

from __future__ import annotations

import hashlib
import io
import json
import platform
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from importlib import resources
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from agents.hyperparams import complete_hyperparams
from agents.loop import LoopConfig, ShieldSettings
from ncs_gym import Channel, LinearPlant
from ncs_gym.envs.json_settings import to_json
from ncs_gym.reading import LARGEST_DOCUMENT, LARGEST_MODEL, json_values, read_file
from ncs_gym.validation import reason_of, shown
from shields.documents import write_atomically
from shields.runtime.safety_filter import LONGEST_HORIZON, MODES

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecNormalize

# Files of an agent, and how many bytes each may have.
AGENT_FILES = {"agent.json": LARGEST_DOCUMENT, "model.zip": LARGEST_MODEL}
_FORMAT = "ncs-gym agent 3"
_DEPENDENCIES = ("ncs-gym", "stable-baselines3", "sb3-contrib", "torch", "gymnasium", "mujoco", "numpy")


class AgentError(ValueError):
    """A file or folder holds no agent, a damaged or altered one, or one of another environment."""


@dataclass(frozen=True, eq=False)
class Normalization:
    """Normalizes observations: clip((o - mean) / sqrt(variance + epsilon), -clip, clip), by entry."""

    mean: np.ndarray
    variance: np.ndarray
    epsilon: float
    clip: float

    @classmethod
    def of(cls, env: VecNormalize) -> Normalization:
        """Returns the present statistics; raises TypeError if observations are dictionaries."""
        statistics = env.obs_rms
        if isinstance(statistics, dict):
            raise TypeError("observations must be one array, got a dictionary of them")
        return cls(statistics.mean.copy(), statistics.var.copy(), float(env.epsilon), float(env.clip_obs))

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Returns normalized observations (N, entries), float32."""
        scaled = (observations - self.mean) / np.sqrt(self.variance + self.epsilon)
        return np.clip(scaled, -self.clip, self.clip).astype(np.float32)


@dataclass(frozen=True, eq=False, kw_only=True)
class Agent:
    """A policy with everything needed to act, to be saved and to be loaded.

    Attributes:
        algorithm: Name of the algorithm in `agents.hyperparams.ALGORITHMS`.
        hyperparams: Hyperparameters the agent was trained with, JSON values by name.
        env: Id of the environment the agent was trained in.
        channel: Channel the agent was trained with; None for that of the id.
        model: The stable-baselines3 model.
        normalization: Normalization of the model's observations.
        seed: Seed of the training.
        shield_mode: Mode of the shield that the agent was trained behind.
        horizon: Horizon of that shield in mode "lookahead" [steps].
        kwargs: Other keyword arguments of the environment that it was trained in, JSON values where it is to be saved.
    """

    algorithm: str
    hyperparams: dict[str, Any]
    env: str
    channel: Channel | None
    model: BaseAlgorithm
    normalization: Normalization
    seed: int | None = None
    shield_mode: str | None = None
    horizon: int | None = None
    kwargs: dict[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Short, in place of all settings."""
        return f"<Agent: {self.algorithm} in {self.env}, weights {self.checksum[:16]}>"

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """Keyword arguments of the environment that it was trained in: `gym.make(agent.env, **agent.env_kwargs)`."""
        return self.kwargs | ({} if self.channel is None else {"channel": self.channel})

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Returns deterministic actions, shape (N, m) or (m,), for raw observations, shape (N, entries) or (entries,).

        Raises:
            ValueError: If observations have another number of entries than in training, or are not finite.
        """
        observations = np.asarray(observations)
        shape, entries = observations.shape, self.normalization.mean.size
        if shape[-1:] != (entries,) or len(shape) > 2:
            raise ValueError(
                f"the agent was trained in {self.env} with observations of {entries} entries: "
                f"they must have shape ({entries},) or (N, {entries}), got {shape}"
            )
        batch = np.reshape(observations, (-1, entries))
        if not np.isfinite(batch).all():
            raise ValueError("observations must be finite numbers, got NaN or infinity")
        actions = self.model.predict(self.normalization(batch), deterministic=True)[0]
        return actions[0] if len(shape) == 1 else actions

    @cached_property
    def checksum(self) -> str:
        """SHA-256 of the weights."""
        digest = hashlib.sha256()
        for name, tensor in sorted(self.model.policy.state_dict().items()):
            digest.update(name.encode() + tensor.detach().cpu().numpy().tobytes())
        return digest.hexdigest()

    def files(self) -> dict[str, bytes]:
        """Returns the contents of `model.zip` and `agent.json`; raises ValueError as `require_kept` does."""
        require_kept(self.kwargs, self.env)
        buffer = io.BytesIO()
        self.model.save(buffer)
        content = {
            "format": _FORMAT,
            "env": self.env,
            "algorithm": self.algorithm,
            "seed": self.seed,
            "versions": installed_versions(_DEPENDENCIES),
            "hyperparams": self.hyperparams,
            "channel": to_json(self.channel),
            "shield": self.shield_mode and {"mode": self.shield_mode, "horizon": self.horizon},
            "plant": None if (plant := _plant_of(self.env, self.kwargs)) is None else plant.fingerprint,
            "normalization": {
                "mean": self.normalization.mean.tolist(),
                "variance": self.normalization.variance.tolist(),
                "epsilon": self.normalization.epsilon,
                "clip": self.normalization.clip,
            },
            "sha256_of_model": hashlib.sha256(buffer.getvalue()).hexdigest(),
        }
        if self.kwargs:
            content["kwargs"] = self.kwargs
        return {"model.zip": buffer.getvalue(), "agent.json": (json.dumps(content, indent=1) + "\n").encode()}

    def save(self, folder: str | Path, shield: ShieldSettings | None = None) -> None:
        """Writes or replaces `model.zip`, `agent.json`, and `certificate.json` of a shield, in a folder to be shared.

        Raises:
            ValueError: If the certificate is for another plant than that of the agent's environment; see `files`.
            OSError: If a file cannot be written.
        """
        folder = Path(folder)
        if shield is not None and not _is_for_plant_of(self.env, self.kwargs, shield.certificate.fingerprint):
            raise ValueError(f"the certificate is for another plant than that of {self.env}: their fingerprints differ")
        files = self.files()
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            write_atomically(folder / name, content)
        if shield is None:
            (folder / "certificate.json").unlink(missing_ok=True)
        else:
            shield.certificate.save(folder / "certificate.json")

    @classmethod
    def load(cls, folder: str | Path) -> Agent:
        """Returns the agent of a folder, or of a file in it.

        Of `model.zip` torch reads the weights alone (`weights_only=True`).

        Raises:
            AgentError: If the files are missing, too large, damaged, of another format or of an environment that has
                changed.
            ModuleNotFoundError: If a package that the algorithm or the environment needs is not installed.
        """
        folder = Path(folder)
        folder = folder.parent if folder.name in AGENT_FILES else folder
        try:
            return cls.of_files({name: read_file(folder / name, most) for name, most in AGENT_FILES.items()})
        except OSError as error:
            raise AgentError(
                f"no agent in {folder}: cannot read {Path(error.filename).name} ({error.strerror}); agents are in "
                "OUT/models of what trained them"
            ) from error

    @classmethod
    def of_files(cls, files: Mapping[str, bytes]) -> Agent:
        """Returns the agent whose `files` these are; for errors see `load`."""
        try:
            content: Any = json_values(files["agent.json"])
        except (ValueError, RecursionError) as error:
            raise AgentError("the agent is damaged: its agent.json is not valid JSON") from error
        if not isinstance(content, dict) or content.get("format") != _FORMAT:
            raise AgentError(f"agent.json is not of format {_FORMAT!r}")
        weights = files["model.zip"]
        if hashlib.sha256(weights).hexdigest() != content.get("sha256_of_model"):
            raise AgentError("model.zip is not the one that agent.json belongs to")
        try:
            return _rebuilt(content, weights)
        except (AgentError, ModuleNotFoundError):  # the second is nothing wrong with the files
            raise
        except Exception as error:  # a forged file may break any part of the libraries that read it
            raise AgentError(f"the agent is damaged: {reason_of(error)}") from error


def pretrained(env_id: str) -> Agent:
    """Returns the small agent that comes with the package for an id.

    It was trained behind the shield of the environment's certificate (`shields.certificate_for`).

    Raises:
        AgentError: If the package has none for it, or the environment has changed since.
    """
    return Agent.load(pretrained_folder(env_id))


def pretrained_folder(env_id: str) -> Path:
    """Returns the folder of the small agent that comes with the package for an id; raises AgentError if it has none."""
    found = pretrained_folders()
    if env_id not in found:
        raise AgentError(f"there is no pretrained agent of {shown(env_id)}, only of {', '.join(found)}")
    return found[env_id]


def pretrained_folders() -> dict[str, Path]:
    """Returns the folders of the agents that come with the package by id."""
    root = Path(str(resources.files("agents"))) / "trained"
    return {f"ncs_gym/{file.parent.name}": file.parent for file in sorted(root.glob("*/agent.json"))}


def installed_versions(packages: Iterable[str]) -> dict[str, str]:
    """Returns the versions of Python and of those packages that are installed."""
    found = {"python": platform.python_version()}
    for name in packages:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def require_kept(kwargs: Mapping[str, Any], env_id: str) -> None:
    """Raises ValueError unless keyword arguments of an environment are those that files of agents keep."""
    for name, value in kwargs.items():
        try:
            json.dumps(value, allow_nan=False)
            # A plant is kept whole: what was downloaded names no file to read.
            is_kept = name in _KEPT and not (name == "plant" and isinstance(value, str))
        except (TypeError, ValueError):
            is_kept = False
        if not is_kept:
            raise ValueError(
                f"files of agents do not keep {name}={shown(value)} of {env_id}: register an environment with it "
                "(register_plant), and train in that"
            )


def _plant_of(env_id: str, kwargs: Mapping[str, Any]) -> LinearPlant | None:
    return getattr(gym.make(env_id, **kwargs).unwrapped, "plant", None)


def _is_for_plant_of(env_id: str, kwargs: Mapping[str, Any], fingerprint: str | None) -> bool:
    """Returns whether a fingerprint is that of an environment's plant, None of one without a plant."""
    plant = _plant_of(env_id, kwargs)
    return fingerprint is None if plant is None else fingerprint is not None and plant.fingerprint == fingerprint


def _rebuilt(content: dict[str, Any], weights: bytes) -> Agent:
    """Returns the agent of an `agent.json` and a `model.zip` whose checksums are right."""
    env_id, algorithm = content["env"], content["algorithm"]
    if env_id not in gym.registry:
        raise AgentError(
            f"the agent was trained in {shown(str(env_id))[1:-1]}, which is not registered here: import the module "
            "that registers it, or on the command line give --env module:id, with the name of that module"
        )
    if unknown := content.keys() - _ENTRIES:
        raise AgentError(f"its agent.json is of another version: it has {', '.join(map(shown, sorted(unknown)))}")
    kwargs = content.get("kwargs", {})
    require_kept(kwargs, env_id)
    if not _is_for_plant_of(env_id, kwargs, content["plant"]):
        raise AgentError(f"the agent was trained on another plant than that of {env_id}: their fingerprints differ")
    hyperparams = complete_hyperparams(algorithm, content["hyperparams"])
    loop = LoopConfig(env=env_id, kwargs=kwargs | {"channel": content["channel"]})
    shield = content["shield"] or {"mode": None, "horizon": None}
    if shield["mode"] not in (None, *MODES) or shield["horizon"] not in (None, *range(1, LONGEST_HORIZON + 1)):
        raise AgentError("the agent is damaged: there is no shield of that mode and horizon")
    from agents import SB3VecEnv  # imports torch, or says what to install
    from agents.algorithms import build_model

    envs = SB3VecEnv(loop.vector(2))
    numbers = content["normalization"]
    mean, variance = (np.array(numbers[name], dtype=np.float64) for name in ("mean", "variance"))
    if mean.ndim == 1 and mean.shape != envs.observation_space.shape:
        raise AgentError(
            f"the agent saw observations of {len(mean)} entries, those of {env_id} have the shape "
            f"{envs.observation_space.shape} now: it is registered with another task or observe="
        )
    model = build_model(algorithm, envs, hyperparams, seed=0)  # as in `untrained`
    model.set_parameters(io.BytesIO(weights), exact_match=True, device="cpu")  # type: ignore[arg-type]
    usable = mean.shape == variance.shape == model.observation_space.shape
    if not (usable and np.isfinite(mean).all() and np.isfinite(variance).all() and (variance >= 0.0).all()):
        raise AgentError("the agent is damaged: its normalization has a wrong shape or value")
    return Agent(
        algorithm=algorithm,
        hyperparams=hyperparams,
        env=env_id,
        channel=loop.channel,
        model=model,
        normalization=Normalization(mean, variance, float(numbers["epsilon"]), float(numbers["clip"])),
        seed=content.get("seed"),
        shield_mode=shield["mode"],
        horizon=shield["horizon"],
        kwargs=kwargs,
    )


# What an agent.json has: what else it says might be a part of the policy.
_ENTRIES = {
    *("format", "env", "algorithm", "seed", "versions", "hyperparams", "kwargs", "channel", "plant", "shield"),
    *("normalization", "sha256_of_model"),
}
# Settings of environments that files of agents keep, as JSON values; the channel has a place of its own.
_KEPT = {
    *("plant", "task", "disturbance", "noise", "initial_set", "terminate_on_violation", "allow_assumption_violation"),
    *("process", "contract", "downlink", "downlink_contract", "observe", "horizon", "between_samples"),
    "max_episode_steps",
}
