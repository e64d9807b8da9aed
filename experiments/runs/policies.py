"""Policies of single environments by name: some that need no training, and trained agents from a folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from agents.agent_file import AgentError, pretrained_folder
from experiments.baselines import REGULATORS, controller, tuned_weights
from experiments.terminal import say
from ncs_gym import NCSEnv
from shields.certificate import Fallback

if TYPE_CHECKING:
    from agents.agent import Agent

# Controllers that need neither training nor a certificate, and the short name of one.
UNTRAINED_POLICIES = ("zero", "random", *REGULATORS)
_SHORT = {"zero": "zero input"}
# Stands for the agent of the environment that comes with the package.
PRETRAINED = "pretrained"
# Agents that a message names.
_MOST_LISTED = 4
# Folder of a sweep's certificates, one for each channel.
CERTIFICATES = "certificates"

# Maps an observation, shape (entries,), and its info to an action, shape (m,).
Policy = Callable[[np.ndarray, dict], np.ndarray]


def policy_by_name(name: str, env_id: str, env: NCSEnv, seed: int, vec_normalize: Path | None = None) -> Policy:
    """Returns a policy for an environment.

    Args:
        name: One of `UNTRAINED_POLICIES`, "pretrained" for the agent that comes with the package, the folder of a
            trained agent or of the run that left it, or a zip of stable-baselines3.
        env_id: Id of the environment.
        env: The environment.
        seed: Seed of the random policy.
        vec_normalize: As for `agent_named`.

    Raises:
        AgentError: If there is no agent for this environment.
        ValueError: If the folder of a run holds several agents, or statistics are given for what is no zip.
    """
    if name in UNTRAINED_POLICIES:
        require_no_statistics(vec_normalize, name)
        nothing = Fallback.of_gain(np.zeros((env.plant.m, env.plant.n)))
        act = controller(_SHORT.get(name, name), env, nothing, seed, tuned_weights(env_id, name))
        return lambda observation, info: act(observation[None], {"estimate": info["estimate"][None]})[0].astype("f4")
    if name != PRETRAINED and not Path(name).exists():
        names = ", ".join(each for each in (*UNTRAINED_POLICIES, PRETRAINED) if ":" not in each)
        raise ValueError(f"no policy {name}: there is no such file or folder, and those with a name are {names}")
    agent, _ = agent_named(name, env_id, vec_normalize)
    if name != PRETRAINED and agent.env_kwargs:
        say(f"{name} was trained with its own {', '.join(agent.env_kwargs)}: here it acts in {env_id} as registered")
    return lambda observation, info: agent.act(observation[None])[0]


def agent_named(name: str, env_id: str | None, vec_normalize: Path | None = None) -> tuple[Agent, Path]:
    """Returns a trained agent, and the folder or zip that it is in.

    Args:
        name: As for `policy_by_name`.
        env_id: Id of the environment that it has to be of; None for any.
        vec_normalize: Statistics beside a zip of stable-baselines3, as `agents.agent.load_sb3_zip` takes them.

    Raises:
        AgentError: If there is no agent, it is of another environment, or a zip needs what is not given.
        ValueError: If the folder of a run holds several agents, nothing says of which environment the agent is, or
            statistics are given for what is no zip.
    """
    from agents.agent import Agent, is_sb3_zip, load_sb3_zip  # imports torch

    path = _only_agent(Path(name))
    if name != PRETRAINED and not path.exists():
        raise ValueError(f"no agent in {name}: there is no such file or folder")
    if env_id is None and (name == PRETRAINED or is_sb3_zip(path)):
        raise ValueError(f"{name} does not say of which environment the agent is: give --env")
    if env_id is not None and name == PRETRAINED:
        path = pretrained_folder(env_id)
    if env_id is not None and is_sb3_zip(path):
        return load_sb3_zip(path, env_id, vec_normalize), path
    require_no_statistics(vec_normalize, name)
    agent = Agent.load(path)
    if env_id not in (None, agent.env):
        raise AgentError(f"the agent in {path} was trained in {agent.env}, not in {env_id}")
    return agent, path


def require_no_statistics(vec_normalize: Path | None, name: str) -> None:
    """Raises ValueError if statistics are given for a policy that is no zip of stable-baselines3."""
    if vec_normalize is not None:
        raise ValueError(f"--vec-normalize is for zips of stable-baselines3, {name} needs no statistics")


def _only_agent(folder: Path) -> Path:
    """Returns the folder of the only agent in a run's output; any other folder is returned as it is."""
    models = sorted(file.parent for file in folder.glob("models/*/agent.json"))
    if (folder / "agent.json").exists() or not models:
        return folder
    if len(models) > 1:
        names = ", ".join([*(model.name for model in models[:_MOST_LISTED]), *["..."] * (len(models) > _MOST_LISTED)])
        raise ValueError(
            f"{folder} holds {len(models)} agents: give the folder of one, in {folder / 'models'} ({names})"
        )
    return models[0]


def certificate_file(agent: Path) -> Path | None:
    """Returns the certificate beside an agent, or of the run that left it in its models; None if there is none.

    A sweep has one for each channel, whose name the names of its agents begin with.
    """
    agent = agent.resolve()
    found = [agent / "certificate.json"]
    if agent.parent.name == "models":
        run = agent.parent.parent
        of_channel = [each for each in (run / CERTIFICATES).glob("*.json") if agent.name.startswith(f"{each.stem}-")]
        # Of a former sweep with fewer sides to its grid another one may be there, with a shorter name.
        found += sorted(of_channel, key=lambda each: -len(each.stem))
        found += [run / "certificate.json"]
    return next((file for file in found if file.is_file()), None)
