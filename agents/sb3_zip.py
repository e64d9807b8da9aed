"""What files of stable-baselines3 tell of an agent besides its weights; nothing in them is unpickled."""

from __future__ import annotations

import base64
import io
import json
import zipfile
from collections.abc import Collection
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.spaces import Box

from agents.agent_file import AgentError
from agents.pickled_data import Made, Named, array_of, is_shape, parts_of, pickled_data
from ncs_gym.reading import LARGEST_MODEL, MOST_HYPERPARAMS, MOST_MEMBERS, json_values, read_file, require_moderate
from ncs_gym.validation import reason_of

# Classes of policies, and the algorithms of which each may be; those of a tuple are told apart by their settings.
_POLICIES: dict[str, tuple[str, ...]] = {
    "stable_baselines3.common.policies.ActorCriticPolicy": ("PPO", "TRPO", "A2C"),
    "stable_baselines3.sac.policies.SACPolicy": ("SAC",),
    "stable_baselines3.td3.policies.TD3Policy": ("TD3",),
    "sb3_contrib.tqc.policies.TQCPolicy": ("TQC",),
    "sb3_contrib.crossq.policies.CrossQPolicy": ("CrossQ",),
}
_MARKS = {"PPO": "clip_range", "TRPO": "cg_max_steps", "A2C": "gae_lambda"}
# What other policies need besides observations and weights, by a part of their name.
_NEEDS = {
    "recurrent": "a recurrent state",
    "maskable": "action masks",
    "MultiInput": "observations that are dictionaries",
    "Cnn": "images",
}
_ACTIVATIONS = "torch.nn.modules.activation."
# Ends of the names of files that `torch.save` wrote, and those that hold no weights, which are not read.
_WEIGHTS, _VARIABLES = ".pth", ("pytorch_variables.pth", "tensors.pth")
# What torch writes into such a file: a pickle, in which tensors are made from numbers in files of their own.
_PICKLE, _TENSOR = "data.pkl", "torch._utils._rebuild_tensor_v2"
_NUMBERS = {"torch.FloatStorage": "<f4", "torch.DoubleStorage": "<f8", "torch.LongStorage": "<i8"}
# With what the entry of a file in a zip begins, of which each takes memory before it can be counted.
_MEMBER = b"PK\1\2"
# Of the arguments of a policy these say how it learns, not how it acts.
_OF_LEARNING = ("optimizer_class", "optimizer_kwargs")


@dataclass(frozen=True)
class SavedModel:
    """What a zip that `model.save` wrote says of a model.

    Attributes:
        algorithm: Name of its algorithm.
        policy_kwargs: Arguments of its policy, JSON values.
        use_sde: Whether it explores by a noise that depends on the state, which changes the network.
        observations: Lower and upper bounds of the observations that it saw, of any shape.
        actions: The same of its actions.
        is_normalized: Whether these observations were normalized by `VecNormalize`; None if the zip does not tell.
        file: The zip.
    """

    algorithm: str
    policy_kwargs: dict[str, Any]
    use_sde: bool
    observations: tuple[np.ndarray, np.ndarray]
    actions: tuple[np.ndarray, np.ndarray]
    is_normalized: bool | None
    file: bytes


def _members(archives: Collection[bytes]) -> list[dict[str, bytes]]:
    """Returns the files in some zips by their names, once it is certain that all unpack to no more than they may.

    Raises:
        ValueError: If they would unpack to more.
        zipfile.BadZipFile: If one is no zip.
    """
    too_much = ValueError(f"it unpacks to more than {MOST_MEMBERS} files or {LARGEST_MODEL:,} bytes")
    if sum(each.count(_MEMBER) for each in archives) > 2 * MOST_MEMBERS:  # also of zips in it
        raise too_much
    opened = [zipfile.ZipFile(io.BytesIO(each)) for each in archives]
    members = [member for archive in opened for member in archive.infolist()]
    if len(members) > MOST_MEMBERS or sum(each.file_size for each in members) > LARGEST_MODEL:
        raise too_much
    return [{member.filename: archive.read(member) for member in archive.infolist()} for archive in opened]


def parameters_of(content: bytes) -> dict[str, Any]:
    """Returns the parameters in a zip that `model.save` wrote, as `set_parameters` takes them; torch reads none of it.

    Raises:
        ValueError: If they are none, or unpack to more than files of agents may.
        zipfile.BadZipFile: If it is no zip, or one that it holds is none.
    """
    (files,) = _members([content])
    named = {name: each for name, each in files.items() if name.endswith(_WEIGHTS) and name not in _VARIABLES}
    inner = _members(named.values())
    return {name.removesuffix(_WEIGHTS): _tensors(each) for name, each in zip(named, inner, strict=True)}


def _tensors(files: dict[str, bytes]) -> Any:
    """Returns what `torch.save` wrote into these files of a zip, with tensors whose numbers stand there.

    Each file of numbers belongs to one tensor, so that together they take no more memory than the files.
    """
    (folder,) = (name.removesuffix(_PICKLE) for name in files if name.endswith(_PICKLE))
    if files.get(f"{folder}byteorder", b"little") != b"little":
        raise ValueError("its numbers were written by a machine with another order of bytes")

    def built(value: Any) -> Any:
        if isinstance(value, dict):
            return {name: built(each) for name, each in value.items()}
        if isinstance(value, list):
            return [built(each) for each in value]
        if isinstance(value, tuple):
            return tuple(map(built, value))
        return tensor(*value.arguments) if isinstance(value, Made) and value.name == _TENSOR else value

    def tensor(
        stored: Made, offset: int, shape: tuple[int, ...], strides: tuple[int, ...], *_rest: Any
    ) -> torch.Tensor:
        ((_, kind, key, *_),) = stored.arguments
        whole = is_shape(shape) and strides == tuple(prod(shape[at + 1 :]) for at in range(len(shape)))
        if not whole or offset != 0 or kind.name not in _NUMBERS or (name := f"{folder}data/{key}") not in files:
            raise ValueError("it has a tensor that is no array of its own of float32, float64 or int64")
        numbers = np.frombuffer(files.pop(name), dtype=_NUMBERS[kind.name])
        return torch.from_numpy(numbers.reshape(shape).copy())

    saved = pickled_data(files[f"{folder}{_PICKLE}"])
    require_moderate(saved, parts_of, MOST_HYPERPARAMS)
    return built(saved)


def read_model(path: Path) -> SavedModel:
    """Returns what a zip says of a model.

    Raises:
        AgentError: If it is no such zip, or the model needs what is not had here: a recurrent state, masks, images, a
            policy class of its own; the message names it.
    """
    try:
        weights = read_file(path, LARGEST_MODEL)
        (files,) = _members([weights])
        data = json_values(files["data"])
        content = {name: _entry(data.get(name)) for name in _READ}
    except Exception as error:  # a forged file may break any part of the libraries that read it
        raise AgentError(f"{path} is no agent that stable-baselines3 saved: {reason_of(error)}") from error
    algorithm = _algorithm(path, content["policy_class"], data)
    spaces = {}
    for name, what in (("observation_space", "observations"), ("action_space", "actions")):
        bounds = _bounds(content[name])
        if bounds is None:
            kind = getattr(content[name], "name", type(content[name]).__name__)
            raise AgentError(f"the agent in {path} has {what} of another kind than arrays of real numbers: {kind}")
        spaces[what] = bounds
    was_reset, on_policy = data.get("_last_obs") is not None, algorithm in _MARKS
    normalized = data.get("_last_original_obs") is not None
    return SavedModel(
        algorithm=algorithm,
        policy_kwargs=_policy_kwargs(path, content["policy_kwargs"]),
        use_sde=data.get("use_sde") is True,
        # Of algorithms with a replay buffer, this attribute is set without `VecNormalize`, too.
        is_normalized=normalized if on_policy and was_reset else None,
        file=weights,
        **spaces,
    )


_READ = ("policy_class", "policy_kwargs", "observation_space", "action_space")


def _entry(value: Any) -> Any:
    """Returns an entry of a zip's description: as it stands there, or what it holds as pickled data."""
    if isinstance(value, dict) and ":serialized:" in value:
        return pickled_data(base64.b64decode(value[":serialized:"]))
    return value


def _algorithm(path: Path, policy: Any, data: dict[str, Any]) -> str:
    """Returns the algorithm whose policy acts by observations and weights alone; raises AgentError for others."""
    if not isinstance(policy, Named):
        raise AgentError(f"the agent in {path} has a policy class of its own: load it yourself and use agents.evaluate")
    fitting = _POLICIES.get(policy.name, ())
    found = next((each for each in fitting if len(fitting) == 1 or _MARKS[each] in data), None)
    if found is None:
        needs = [need for part, need in _NEEDS.items() if part in policy.name]
        known = f"of none of the policies {', '.join(name.rpartition('.')[2] for name in _POLICIES)}"
        reason = f"needs {needs[0]}, which it is not given here" if needs else f"is {known}"
        raise AgentError(f"the agent in {path}, a {policy.name.rpartition('.')[2]}, {reason}")
    return found


def _policy_kwargs(path: Path, content: Any) -> dict[str, Any]:
    """Returns arguments of a policy as JSON values, with an activation function by its name, such as "nn.ReLU"."""
    content = {} if content is None else content
    if not isinstance(content, dict):
        raise AgentError(f"the policy_kwargs in {path} are no dictionary")
    found = {name: value for name, value in content.items() if name not in _OF_LEARNING}
    for name, value in found.items():
        if isinstance(value, Named) and value.name.startswith(_ACTIVATIONS):
            found[name] = f"nn.{value.name.removeprefix(_ACTIVATIONS)}"
    try:
        require_moderate(found, parts_of, MOST_HYPERPARAMS)
        return json.loads(json.dumps(found, allow_nan=False, default=_refuse))
    except (ValueError, TypeError, RecursionError) as error:
        raise AgentError(
            f"the policy_kwargs in {path} have {error}, and such pickles are not read: load it yourself, and evaluate "
            "it with agents.evaluate"
        ) from error


def _refuse(value: Any) -> Any:
    raise ValueError(getattr(value, "name", "") or f"a {type(value).__name__}")


def _bounds(space: Any) -> tuple[np.ndarray, np.ndarray] | None:
    """Returns lower and upper bounds of a pickled `Box`; None for any other space."""
    if not (isinstance(space, Made) and space.name.endswith(".spaces.box.Box")):
        return None
    try:
        low, high = (array_of(space.attributes.get(name)) for name in ("low", "high"))
    except ValueError:
        return None
    return (low, high) if low.shape == high.shape else None


def require_same_spaces(model: SavedModel, observations: gym.Space, actions: gym.Space) -> str:
    """Returns what may be another environment or channel, in a sentence; empty if all is the same.

    Args:
        model: What the zip says.
        observations: Space of the environment's observations.
        actions: Space of its actions.

    Raises:
        ValueError: If observations or actions went through a wrapper that is missing here; the message names it.
    """
    assert isinstance(observations, Box)
    assert isinstance(actions, Box)
    low, high = model.observations
    if low.shape != observations.shape:
        entries, own = low.size, int(np.prod(observations.shape))
        is_longer = low.ndim == 1 and entries > own
        more = ": perhaps with observe=(...), for which register_plant makes an id" if is_longer else ""
        more += f", or of {entries // own} stacked frames" if more and entries % own == 0 else ""
        raise ValueError(f"it saw observations of shape {low.shape}{more}, and those here are {observations.shape}")
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ValueError(
            "it saw observations without bounds, as gymnasium's NormalizeObservation makes them, whose statistics are "
            "in no file"
        )
    own = [bound.astype(np.float64) for bound in (actions.low, actions.high)]
    if not all(map(np.array_equal, model.actions, own)):
        limits = f"{model.actions[0].tolist()} to {model.actions[1].tolist()}"
        raise ValueError(f"its actions were {limits}, as of a wrapper that rescales them, and are -1 to 1 here")
    own = [bound.astype(np.float64) for bound in (observations.low, observations.high)]
    if all(map(np.array_equal, model.observations, own)):
        return ""
    return "saw observations within other bounds: in another environment, on another channel or through a wrapper"
