"""Policies of single environments by name: some that need no training, and trained agents from a folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from agents.agent import Agent, AgentError, pretrained_folder
from experiments.baselines.controllers import REGULATORS, controller
from experiments.baselines.tuned import tuned_weights
from experiments.terminal import say
from ncs_gym import NCSEnv
from shields.certificate import Fallback

# Controllers that need neither training nor a certificate.
_UNTRAINED = ("zero input", "random", *REGULATORS)
# Stands for the agent of the environment that comes with the package.
PRETRAINED = "pretrained"

# Maps an observation, shape (entries,), and its info to an action, shape (m,).
Policy = Callable[[np.ndarray, dict], np.ndarray]


def policy_by_name(name: str, env_id: str, env: NCSEnv, seed: int) -> Policy:
    """Returns an untrained controller, whose spaces may be given as hyphens, or what an agent of `agent_named` does.

    Raises:
        AgentError: If there is no agent for this environment.
        ValueError: If there is no such policy, file or folder.
    """
    if (untrained := name.replace("-", " ")) in _UNTRAINED:
        nothing = Fallback.of_gain(np.zeros((env.plant.m, env.plant.n)))
        act = controller(untrained, env, nothing, seed, tuned_weights(env_id, untrained))

        def action(observation: np.ndarray, info: dict) -> np.ndarray:
            return act(observation[None], {key: np.asarray(value)[None] for key, value in info.items()})[0].astype("f4")

        return action
    if name != PRETRAINED and not Path(name).exists():
        names = ", ".join(each for each in (*_UNTRAINED, PRETRAINED) if ":" not in each)
        raise ValueError(f"no policy {name}: there is no such file or folder, and those with a name are {names}")
    agent, _ = agent_named(name, env_id)
    if name != PRETRAINED and agent.env_kwargs:
        say(f"{name} was trained with its own {', '.join(agent.env_kwargs)}: here it acts in {env_id} as registered")
    return lambda observation, info: agent.act(observation[None])[0]


def agent_named(name: str, env_id: str | None) -> tuple[Agent, Path]:
    """Returns the "pretrained" agent or one of a folder, and the folder that it is in; its environment may be any.

    Raises:
        AgentError: If there is no agent, or it is of another environment.
        ValueError: If nothing says of which environment the agent is.
    """
    path = Path(name)
    if name == PRETRAINED:
        if env_id is None:
            raise ValueError(f"{name} does not say of which environment the agent is: give --env")
        path = pretrained_folder(env_id)
    agent = Agent.load(path)
    if env_id not in (None, agent.env):
        raise AgentError(f"the agent in {path} was trained in {agent.env}, not in {env_id}")
    return agent, path


def certificate_file(agent: Path) -> Path | None:
    """Returns the certificate beside an agent, or of the run that left it in its models; None if there is none."""
    agent = agent.resolve()
    places = (agent, agent.parent.parent) if agent.parent.name == "models" else (agent,)
    return next((file for place in places if (file := place / "certificate.json").is_file()), None)
