"""An arm of the benchmark with a memory of its own: sb3-contrib's RecurrentPPO behind the shield."""

from __future__ import annotations

import inspect
from functools import cache
from typing import Any

import numpy as np
from sb3_contrib import RecurrentPPO

from agents import SB3VecEnv
from agents.algorithms import normalized_env
from agents.evaluation import Policy
from agents.hyperparams import DEFAULTS, with_changes
from agents.loop import LoopConfig
from experiments.baselines.tuned import tuned_training

# Steps of a training, as of the other agents; their rollouts, of whole sequences here, have as many steps in all.
STEPS, ENVS = 60_000, 16


def recurrent(loop: LoopConfig, seed: int) -> Policy:
    """Returns a policy that has been trained in a loop, with the hyperparameters that were tuned for `shielded`.

    Its rollouts of 256 steps in sixteen environments, instead of 64 in 64, leave sequences of up to an episode.
    """
    return _trained(loop, seed)


@cache
def _trained(loop: LoopConfig, seed: int) -> Policy:
    own = with_changes(DEFAULTS["PPO"], tuned_training(loop.env, "shielded").get("hyperparams", {}))
    env = normalized_env("PPO", SB3VecEnv(loop.vector(ENVS)), own)
    rollout = own["n_steps"] * own["n_envs"]
    known = inspect.signature(RecurrentPPO).parameters
    arguments: dict[str, Any] = {name: value for name, value in own.items() if name in known}
    rate = float(str(own["learning_rate"]).removeprefix("lin_"))
    arguments |= {"n_steps": rollout // ENVS, "learning_rate": lambda left: rate * left}
    model = RecurrentPPO("MlpLstmPolicy", env, seed=seed, device="cpu", **arguments)
    model.learn(STEPS)
    env.training = False
    state: list[Any] = [None]

    def policy(observations: np.ndarray, infos: dict[str, Any]) -> np.ndarray:
        begun = infos["episode_steps"] == 0
        state[0] = None if begun.all() else state[0]
        actions, state[0] = model.predict(env.normalize_obs(observations), state[0], begun, deterministic=True)
        return actions

    return policy
