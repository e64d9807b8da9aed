"""Trains PPO on an environment, shielded or not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

import ncs_gym  # noqa: F401  (registers the environments)
from agents.callbacks import SafetyCallback, TrainingPoint
from agents.sb3_vec_env import EPISODE_KEYS, SB3VecEnv
from agents.settings import PPOSettings
from shields import Certificate, SafetyShield, VectorSafetyShield

# Files of a saved agent.
MODEL, NORMALIZER = "model.zip", "normalizer.pkl"


@dataclass(frozen=True)
class Shielding:
    """How an environment is shielded.

    Attributes:
        certificate: Verified when the shield is built.
        mode: Of `SafetyShield`.
        penalty: Subtracted from the reward per intervention.
    """

    certificate: Certificate
    mode: str = "project"
    penalty: float = 0.0


@dataclass(frozen=True)
class Agent:
    """A trained policy with the statistics its observations are normalized by.

    Attributes:
        model: PPO.
        normalizer: VecNormalize, no longer updated.
    """

    model: PPO
    normalizer: VecNormalize

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Returns deterministic actions, shape (N, m), for raw observations, shape (N, entries)."""
        return self.model.predict(self.normalizer.normalize_obs(observations), deterministic=True)[0]

    def save(self, folder: Path) -> None:
        """Writes `model.zip` and `normalizer.pkl` into an existing folder."""
        self.model.save(folder / MODEL)
        self.normalizer.save(str(folder / NORMALIZER))

    @classmethod
    def load(cls, file: Path, env_id: str) -> Agent:
        """Returns what `save` wrote, by the path of the model; without a normalizer beside it, raw input.

        Raises:
            ValueError: If it is no PPO model, or belongs to an environment with other spaces.
            OSError: If it cannot be read.
        """
        with file.open("rb"):
            pass  # stable-baselines3 would look for another name
        try:
            model = PPO.load(file, device="cpu")
        except Exception as error:
            raise ValueError(f"{file} is no PPO model of stable-baselines3") from error
        env = DummyVecEnv([lambda: make_env(env_id)])
        if (model.observation_space.shape, model.action_space.shape) != (
            env.observation_space.shape,
            env.action_space.shape,
        ):
            raise ValueError(f"{file} was trained on an environment with other spaces than {env_id}")
        beside = file.with_name(NORMALIZER)
        if not beside.exists():
            return cls(model, VecNormalize(env, training=False, norm_obs=False))
        normalizer = VecNormalize.load(str(beside), env)
        normalizer.training = False
        return cls(model, normalizer)


@dataclass(frozen=True)
class TrainingResult:
    """What a training run leaves.

    Attributes:
        agent: The trained policy.
        history: Totals after each rollout.
        steps: Environment steps taken (whole rollouts: at least what was asked for).
        violation_steps: Steps whose true state violated the safe box, all of training.
        interventions: Steps in which the shield intervened, all of training.
    """

    agent: Agent
    history: list[TrainingPoint]
    steps: int
    violation_steps: int
    interventions: int


def make_env(env_id: str, shielding: Shielding | None = None) -> gym.Env:
    """Returns an environment, shielded if asked for."""
    env = gym.make(env_id)
    if shielding is None:
        return env
    return SafetyShield(env, shielding.certificate, mode=shielding.mode, penalty=shielding.penalty)


def make_training_env(env_id: str, count: int, shielding: Shielding | None = None) -> VecEnv:
    """Returns `count` environments for stable-baselines3: a vector environment if the id has one, else single ones."""
    if gym.spec(env_id).vector_entry_point is None:
        return DummyVecEnv([lambda: Monitor(make_env(env_id, shielding), info_keywords=EPISODE_KEYS)] * count)
    env = gym.make_vec(env_id, num_envs=count)
    if shielding is not None:
        env = VectorSafetyShield(env, shielding.certificate, mode=shielding.mode, penalty=shielding.penalty)
    return SB3VecEnv(env)


def train(
    env_id: str,
    steps: int,
    seed: int,
    shielding: Shielding | None = None,
    settings: PPOSettings | None = None,
    *,
    log_folder: Path | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> TrainingResult:
    """Returns a trained agent and what happened on the way; the same seed gives the same result on one machine.

    Args:
        env_id: A registered `ncs_gym` id.
        steps: Environment steps to train for, rounded up to whole rollouts.
        seed: Seeds environments, network and sampling; arms with the same seed meet the same draws
            of nature as long as their episodes last equally long.
        shielding: None trains unshielded.
        settings: Of PPO; the defaults if None.
        log_folder: Where TensorBoard's events go.
        on_progress: Called with the number of steps taken since its last call.
    """
    settings = settings or PPOSettings()
    env = VecNormalize(make_training_env(env_id, settings.envs, shielding), gamma=settings.discount)
    model = _ppo(env, settings, seed)
    model.set_logger(configure(str(log_folder), ["tensorboard"]) if log_folder else Logger(None, []))
    callback = SafetyCallback(on_progress)
    model.learn(steps, callback=callback)
    env.training = False
    return TrainingResult(
        Agent(model, env), callback.history, model.num_timesteps, callback.violation_steps, callback.interventions
    )


def untrained(env_id: str, seed: int, settings: PPOSettings | None = None) -> Agent:
    """Returns a policy with the random weights that training starts from."""
    env = VecNormalize(make_training_env(env_id, 1), training=False)
    return Agent(_ppo(env, settings or PPOSettings(), seed), env)


def _ppo(env: VecNormalize, settings: PPOSettings, seed: int) -> PPO:
    torch.set_num_threads(1)  # more threads only pay off at batches of 16384 and make results depend on their number
    return PPO(
        "MlpPolicy",
        env,
        learning_rate=LinearSchedule(settings.learning_rate, 0.0, 1.0),
        n_steps=settings.rollout,
        batch_size=min(settings.batch_size, settings.rollout * env.num_envs),
        n_epochs=settings.epochs,
        gamma=settings.discount,
        gae_lambda=settings.gae_lambda,
        policy_kwargs={"net_arch": [settings.width] * 2, "log_std_init": settings.log_std},
        seed=seed,
        device="cpu",
    )
