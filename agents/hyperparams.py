"""Hyperparameters of the learning algorithms: stable-baselines3's keywords, in the form of rl-zoo3's files.

Hyperparameters are a dictionary of JSON values by name. Most are keyword arguments of the algorithm's constructor in
stable-baselines3, which judges them when a model is made (`agents.algorithms.build_model`). As in rl-zoo3,
`"lin_0.003"` stands for a rate that falls linearly from 0.003 during the training, and these names are no arguments of
the constructor:

- `n_envs`: number of environments stepped side by side;
- `n_timesteps`: training steps, where the caller asks for no number of them;
- `normalize`: true, or arguments of `VecNormalize` such as `{"norm_reward": false}`;
- `noise_std`, and `noise_type`, which is "normal": exploration noise of off-policy algorithms, in units of the limits;
- `policy_kwargs`: may have `activation_fn`, an activation function of `torch.nn` by its name, such as "nn.ReLU";
- `stored_action`: of off-policy algorithms, "applied" to learn from the actions that the shield applied, "proposed"
  (the default) from the agent's own.

`agents/tuned/ppo.json` has those found by a search for each registered environment (docs/agents.md).
"""

from __future__ import annotations

import ast
import json
import re
import warnings
from collections.abc import Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from ncs_gym.reading import LARGEST_HYPERPARAMS, MOST_HYPERPARAMS, json_values, read_text, require_moderate
from ncs_gym.validation import reason_of, shown

# The package of each algorithm, which has a class of the same name.
ALGORITHMS = {
    "PPO": "stable_baselines3",
    "A2C": "stable_baselines3",
    "SAC": "stable_baselines3",
    "TD3": "stable_baselines3",
    "TRPO": "sb3_contrib",
    "TQC": "sb3_contrib",
    "CrossQ": "sb3_contrib",
}
# Numbers that are counted from 1: of a wrong one the library complains only while it trains, or never.
# Keys of rl-zoo3's files that are no hyperparameters of an algorithm: what is put around environments, and callbacks.
RL_ZOO_KEYS = ("env_wrapper", "vec_env_wrapper", "frame_stack", "env_kwargs", "monitor_kwargs", "callback")
# Names of torch.nn as rl-zoo3's files write them, and what is no part of a literal.
_OF_TORCH = re.compile(r"(?:(?:torch|th)\.)?nn\.([A-Za-z]\w*)")
_NO_LITERALS = (ast.Call, ast.Name, ast.Attribute, ast.Lambda, ast.comprehension, ast.Starred, ast.BinOp)
# Longest number in YAML, which multiplies those with colons in them (1:30 is 90) [letters].
_LONGEST_NUMBER = 1000
# The largest: of ten million transitions a buffer takes gigabytes.
MOST_TRANSITIONS = 10_000_000
_COUNTS = {"n_envs": 100_000, "n_steps": MOST_TRANSITIONS, "n_epochs": 100_000, "buffer_size": MOST_TRANSITIONS}
_COUNTS |= {"batch_size": MOST_TRANSITIONS}
# What is had here of that which stable-baselines3 and rl-zoo3 have more of.
_HAD = {"policy": ("MlpPolicy",), "noise_type": ("normal", None)}
# Most weights of the networks of an agent together, and most outputs of each.
MOST_WEIGHTS, MOST_OUTPUTS = 20_000_000, 1000
# Algorithms that learn from whole rollouts of `n_steps` steps in every environment.
ON_POLICY = ("PPO", "A2C", "TRPO")

# Many environments, batches of 2048 and a higher learning rate than stable-baselines3's defaults train about eight
# times as fast at no loss of return on these small tasks (`python -m benchmarks.speed ppo`).
_ROLLOUTS = {
    "n_envs": 64,
    "gamma": 0.9,
    "gae_lambda": 0.9,
    "policy_kwargs": {"net_arch": [64, 64], "log_std_init": -0.7},
    "normalize": True,
}
_MINIBATCHES = {**_ROLLOUTS, "n_steps": 64, "batch_size": 2048, "learning_rate": "lin_0.003"}
_REPLAY = {
    "n_envs": 64,
    "gradient_steps": 16,
    "batch_size": 256,
    "buffer_size": 200_000,
    "learning_starts": 2_000,
    "learning_rate": "lin_0.003",
    "gamma": 0.9,
    "policy_kwargs": {"net_arch": [64, 64]},
    "normalize": True,
}
# What an algorithm learns with where nothing else is said; of everything else stable-baselines3 has the defaults.
DEFAULTS: dict[str, dict[str, Any]] = {
    "PPO": {**_MINIBATCHES, "n_epochs": 10, "ent_coef": 0.0},
    "TRPO": {**_MINIBATCHES, "n_critic_updates": 10},
    "A2C": {**_ROLLOUTS, "n_steps": 8, "learning_rate": "lin_0.002"},
    "SAC": _REPLAY,
    "TD3": {**_REPLAY, "noise_std": 0.2},
    "TQC": _REPLAY,
    "CrossQ": _REPLAY,
}


def with_changes(hyperparams: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Returns hyperparameters with changes, of `policy_kwargs` entry by entry."""
    changed = {**hyperparams, **changes}
    own, given = hyperparams.get("policy_kwargs"), changes.get("policy_kwargs")
    if isinstance(own, Mapping) and isinstance(given, Mapping):
        changed["policy_kwargs"] = {**own, **given}
    return changed


def complete_hyperparams(algorithm: str, given: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Returns the hyperparameters that an algorithm is trained with: those given, and the defaults.

    Args:
        algorithm: A name in `ALGORITHMS`.
        given: Hyperparameters by name; None for none.

    Raises:
        ValueError: If the algorithm is unknown, what is given is no dictionary of JSON values, `gamma` or a count
            (`n_envs`, `n_steps`, `n_epochs`, `batch_size`, `buffer_size`) is out of range, `policy` or `noise_type` is
            one that is not had here, or networks are larger than
            `MOST_WEIGHTS`.
    """
    if not (isinstance(algorithm, str) and algorithm in ALGORITHMS):
        meant = [name for name in ALGORITHMS if name.lower() == str(algorithm).lower()]
        advice = f"; it is written {meant[0]!r}" if meant else ""
        raise ValueError(f"unknown algorithm {shown(algorithm)}{advice}; known are {', '.join(ALGORITHMS)}")
    if not isinstance(given, Mapping | None):
        raise ValueError(f"hyperparameters must be a dictionary, got {type(given).__name__}")
    hyperparams = with_changes(DEFAULTS[algorithm], _as_json(given or {}))
    for name, most in _COUNTS.items():
        if name in hyperparams and (type(value := hyperparams[name]) is not int or not 1 <= value <= most):
            at_most = f" and at most {most:,}" if type(value) is int and value > most else ""
            raise ValueError(f"{name} must be a whole number >= 1{at_most}, got {shown(value)}")
    for name, had in _HAD.items():
        if hyperparams.get(name, had[0]) not in had:
            raise ValueError(f"{algorithm}: {name} must be {had[0]!r} here, got {shown(hyperparams[name])}")
    if hyperparams.get("noise_type") is not None and hyperparams.get("noise_std") is None:
        raise ValueError(f"{algorithm}: noise_type needs noise_std, without which there is no noise")
    if hyperparams["n_envs"] * hyperparams.get("n_steps", 1) > MOST_TRANSITIONS:
        raise ValueError(f"n_envs times n_steps must be at most {MOST_TRANSITIONS:,}")
    require_moderate_networks(hyperparams.get("policy_kwargs") or {})
    gamma = hyperparams["gamma"]
    if type(gamma) not in (int, float) or not 0.0 <= gamma <= 1.0:
        raise ValueError(f"gamma must be in [0, 1], got {shown(gamma)}")
    return hyperparams


def require_moderate_networks(policy_kwargs: Any) -> None:
    """Raises unless networks of these settings are moderate; whether they are right the library says.

    Raises:
        ValueError: If they have more than `MOST_WEIGHTS` weights, a count that is larger than `MOST_OUTPUTS`, or widths
            in a form that the library does not know.
    """
    if not isinstance(policy_kwargs, Mapping):
        return
    counts = {name: each for name, each in policy_kwargs.items() if type(each) in (int, float)}
    if any(not abs(each) <= MOST_OUTPUTS for each in counts.values()):
        raise ValueError(f"policy_kwargs must have numbers of at most {MOST_OUTPUTS}, got {shown(counts)}")
    arch = policy_kwargs.get("net_arch")
    weights = 0
    for widths in _networks_of([] if arch is None else arch):
        weights += sum(a * b for a, b in zip([MOST_OUTPUTS, *widths], widths, strict=False))
    if (total := weights * 2 * max(counts.get("n_critics", 1), 1)) > MOST_WEIGHTS:
        raise ValueError(f"networks may have {MOST_WEIGHTS:,} weights, those of {shown(arch)} might have {total:,.0f}")


def _networks_of(arch: Any) -> list[list[int]]:
    """Returns the widths of an agent's two networks, or of each that is named, in all forms that the library takes.

    That is a list of widths for both, a dictionary of such lists, or a list of dictionaries (an older form).

    Raises:
        ValueError: If it is anything else.
    """
    if isinstance(arch, list) and arch and all(isinstance(each, Mapping) for each in arch):
        return [widths for each in arch for widths in _networks_of(each)]
    nets = [*arch.values()] if isinstance(arch, Mapping) else [arch, arch]
    if not all(isinstance(net, list) and all(type(each) is int and each >= 1 for each in net) for net in nets):
        raise ValueError(f"net_arch must be widths >= 1, [64, 64] or {{'pi': [64], 'vf': [64]}}, got {shown(arch)}")
    return nets


def rollout_steps(algorithm: str, hyperparams: Mapping[str, Any]) -> int:
    """Returns how many steps of all environments together lie between two updates; trainings end with whole ones."""
    known = {**DEFAULTS[algorithm], **hyperparams}
    return known["n_envs"] * (known["n_steps"] if algorithm in ON_POLICY else 1)


def tuned_hyperparams(env_id: str, algorithm: str = "PPO") -> dict[str, Any] | None:
    """Returns the hyperparameters tuned for an environment; None where there are none, as for plants of one's own.

    Args:
        env_id: Id by which the environment is registered.
        algorithm: Name of the learning algorithm; none but PPO is tuned.
    """
    entry = _tuned().get(env_id) if algorithm == "PPO" else None
    return None if entry is None else {name: value for name, value in entry.items() if name != "n_timesteps"}


def tuned_steps(env_id: str, algorithm: str = "PPO") -> int | None:
    """Returns the number of training steps that belongs to the tuned hyperparameters; None where there are none."""
    return _tuned()[env_id]["n_timesteps"] if tuned_hyperparams(env_id, algorithm) is not None else None


@cache
def _tuned() -> dict[str, dict[str, Any]]:
    return json.loads(resources.files("agents").joinpath("tuned", "ppo.json").read_text("utf-8"))


def read_hyperparams(file: str | Path, env_id: str) -> dict[str, Any]:
    """Returns the hyperparameters of an environment in a file like those of rl-zoo3.

    What rl-zoo3 does itself with a key (`RL_ZOO_KEYS`) is not done here: a warning names such keys.

    Args:
        file: YAML (.yml, .yaml) or JSON: hyperparameters by environment id, or under "default" for all others. Texts
            such as `dict(net_arch=[64, 64], activation_fn=nn.ReLU)` are read as Python's literals. At most 256 KiB, and
            100,000 values once all aliases are written out.
        env_id: Id by which the environment is registered.

    Raises:
        ValueError: If the file has no entry for the environment, is damaged, or has an expression that is no literal or
            a value that JSON has not, such as a date.
        OSError: If it cannot be read.
    """
    path = Path(file)
    text = read_text(path, LARGEST_HYPERPARAMS)
    try:
        document = json_values(text) if path.suffix == ".json" else _yaml(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"hyperparameters {path} are damaged: {reason_of(error)}") from error
    entries = document if isinstance(document, dict) else {}
    entry = entries.get(env_id, entries.get("default"))
    if not isinstance(entry, dict):
        raise ValueError(f"{path} has no hyperparameters for {env_id}, nor for default")
    left_out = sorted(name for name in RL_ZOO_KEYS if entry.get(name) is not None)
    if left_out:
        warnings.warn(f"{', '.join(left_out)} in {path}: only rl-zoo3 reads that, it is left out here", stacklevel=2)
    try:
        return _as_json({name: value_of(name, value) for name, value in entry.items() if name not in RL_ZOO_KEYS})
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _yaml(text: str) -> Any:
    import yaml  # of the extra "train", as everything that is trained needs

    try:
        require_moderate(yaml.compose(text, Loader=yaml.SafeLoader), _parts_of_node, MOST_HYPERPARAMS)
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from error
    except (ArithmeticError, AttributeError, LookupError) as error:  # from its constructors, as of "!!bool maybe"
        raise ValueError(f"a value is none of its tag, {type(error).__name__}: {error}") from error


def _parts_of_node(node: Any) -> list[Any]:
    """Returns the nodes in a node of YAML: of a list its entries, of a dictionary keys and values.

    Raises:
        ValueError: If it is a number of too many digits or parts.
    """
    if node is not None and node.tag.endswith((":int", ":float")) and len(node.value) > _LONGEST_NUMBER:
        raise ValueError(f"it has a number of more than {_LONGEST_NUMBER:,} letters, {shown(node.value)}")
    parts = node.value if node is not None and isinstance(node.value, list) else []
    return [each for part in parts for each in (part if isinstance(part, tuple) else (part,))]


def _as_json(hyperparams: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a copy; raises ValueError for the first value that JSON has not."""
    copied: dict[str, Any] = {}
    for name, value in hyperparams.items():
        try:
            copied |= json.loads(json.dumps({name: value}, allow_nan=False))
        except (TypeError, ValueError, RecursionError) as error:
            given = f"{shown(name)}: {shown(value)}"
            raise ValueError(
                f"hyperparameters must be JSON values, got {given} ({reason_of(error)}); what is none is written as a "
                "text, as in 'nn.ReLU' or 'lin_0.003'"
            ) from error
    return copied


def value_of(name: str, value: Any) -> Any:
    """Returns what a hyperparameter that is given as a text stands for, and any other value as it is.

    Raises:
        ValueError: If it is an expression that `literal` cannot read; the message names the part that it cannot.
    """
    if not isinstance(value, str):
        return value
    found = literal(value)
    if found is value and (culprit := _unreadable(value)) is not None:
        raise ValueError(
            f"cannot read {shown(culprit)} in {name}: numbers, texts, lists, dictionaries and activation functions "
            "(nn.ReLU) are read, nothing is evaluated"
        )
    return found


def literal(text: str) -> Any:
    """Returns what a text stands for in Python: a number, a list, a dictionary (also `dict(a=1)`), True, False or None.

    Inside, `nn.ReLU` and its like stand for themselves, as texts, from which `agents.algorithms` takes the class.

    Returns:
        JSON values; the text itself if it stands for nothing that JSON can keep.
    """
    try:
        value = ast.literal_eval(_Plain().visit(ast.parse(text.strip(), mode="eval")).body)
        return json.loads(json.dumps(value, allow_nan=False))
    except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError):
        return text


class _Plain(ast.NodeTransformer):
    """Writes `dict(a=1)` as `{"a": 1}`, and the names of `torch.nn` as texts."""

    def visit_Call(self, node: ast.Call) -> ast.AST:
        names = [each.arg for each in node.keywords]
        if ast.unparse(node.func) != "dict" or node.args or None in names or len(set(names)) < len(names):
            return node
        values = [self.visit(each.value) for each in node.keywords]
        return ast.Dict(keys=[ast.Constant(name) for name in names], values=values)

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        found = _OF_TORCH.fullmatch(ast.unparse(node))
        return node if found is None else ast.Constant(f"nn.{found[1]}")


def _unreadable(text: str) -> str | None:
    """Returns the first part of an expression that is no literal; None for a word such as "auto" or "lin_0.003"."""
    try:
        tree = _Plain().visit(ast.parse(text.strip(), mode="eval")).body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return text if "(" in text or text.lstrip().startswith(("{", "[")) else None
    if not isinstance(tree, ast.Call | ast.Dict | ast.List | ast.Tuple | ast.Set):
        return None
    return next((ast.unparse(each) for each in ast.walk(tree) if isinstance(each, _NO_LITERALS)), text)
