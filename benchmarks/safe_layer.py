"""Does it pay to train through the shield? PPO and SAC, with and without `shields.torch.SafeLayer` in the policy.

Both act behind the same shield, in training and in evaluation. With the layer, PPO's Gaussian is centered at the
projected mean; SAC's actor and target see projected actions, and its replay buffer holds what was applied. Prints a
line per environment, algorithm and arm: means over seeds of return and overridden steps in 64 evaluation episodes.
"""

import argparse
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.sac.policies import Actor, SACPolicy

from agents import AppliedActionBuffer, SB3VecEnv
from ncs_gym.envs.env import ncs_env
from shields import VectorSafetyShield, certificate_for
from shields.torch import SafeLayer

IDS = ("ncs_gym/TruckTrailerCruise-v0", "ncs_gym/BatchReactor-v0")


class SafePPOPolicy(ActorCriticPolicy):
    """A Gaussian whose mean is projected at the estimate, the first entries of the observation."""

    def __init__(self, *arguments: Any, layer: SafeLayer, **keywords: Any) -> None:
        self.layer_of = [layer]  # in a list it is no module of this one, before the base class is ready
        super().__init__(*arguments, **keywords)

    def extract_features(self, obs: Any, features_extractor: Any = None) -> Any:
        """Returns features, and remembers the observations."""
        self.seen = obs
        return super().extract_features(obs, features_extractor)

    def get_distribution(self, obs: Any) -> Any:
        """Returns the distribution of actions."""
        self.seen = obs
        return super().get_distribution(obs)

    def _get_action_dist_from_latent(self, latent_pi: Any) -> Any:
        (layer,) = self.layer_of
        mean = layer(self.action_net(latent_pi), self.seen[:, : layer.filter.plant.n])
        return self.action_dist.proba_distribution(mean, self.log_std)


class SafeActor(Actor):
    """SAC's actor with a projection behind it."""

    layer: SafeLayer

    def action_log_prob(self, obs: Any) -> Any:
        """Returns projected actions, and the logarithm of the density of the proposed ones."""
        actions, log_prob = super().action_log_prob(obs)
        return self.layer(actions, obs[:, : self.layer.filter.plant.n]), log_prob


class SafeSACPolicy(SACPolicy):
    """SAC's policy with that actor."""

    def __init__(self, *arguments: Any, layer: SafeLayer, **keywords: Any) -> None:
        self.layer_of = [layer]
        super().__init__(*arguments, **keywords)

    def make_actor(self, features_extractor: Any = None) -> Actor:
        """Returns the actor."""
        actor = SafeActor(**self._update_features_extractor(self.actor_kwargs, features_extractor)).to(self.device)
        actor.layer = self.layer_of[0]
        return actor


def trained(env_id: str, algorithm: str, layer: SafeLayer | None, seed: int, steps: int) -> Any:
    """Returns a model trained behind the shield, with the layer or without one."""
    single = ncs_env(gym.make(env_id))
    certificate = certificate_for(single.plant, single.certificate_contract)
    shield = VectorSafetyShield(gym.make_vec(env_id, num_envs=32), certificate)
    envs = SB3VecEnv(shield)
    own = {} if layer is None else {"layer": layer}
    if algorithm == "PPO":
        settings = {"n_steps": 32, "batch_size": 256, "n_epochs": 5, "gamma": 0.9, "gae_lambda": 0.98}
        kwargs = {"policy_kwargs": own | {"log_std_init": -1.0}, "seed": seed, "device": "cpu", "learning_rate": 1e-3}
        return PPO("MlpPolicy" if layer is None else SafePPOPolicy, envs, **settings, **kwargs).learn(steps)
    kwargs = {"gamma": 0.9, "learning_rate": 1e-3, "learning_starts": 1000, "gradient_steps": 8, "device": "cpu"}
    if layer is not None:
        kwargs |= {"replay_buffer_class": AppliedActionBuffer}
    policy = own | {"net_arch": [64, 64]}
    model = SAC("MlpPolicy" if layer is None else SafeSACPolicy, envs, seed=seed, policy_kwargs=policy, **kwargs)
    return model.learn(steps)


def evaluated(env_id: str, model: Any) -> tuple[float, float, float]:
    """Returns mean return, share of overridden steps and violating steps of 64 episodes."""
    single = ncs_env(gym.make(env_id))
    certificate = certificate_for(single.plant, single.certificate_contract)
    shield = VectorSafetyShield(gym.make_vec(env_id, num_envs=64), certificate)
    observations, infos = shield.reset(seed=1)
    total = np.zeros(64)
    for _ in range(200):
        observations, rewards, _, _, infos = shield.step(model.predict(observations, deterministic=True)[0])
        total += rewards
    return total.mean(), infos["episode_interventions"].mean() / 200, infos["episode_violations"].sum()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, nargs=2, default=(100_000, 20_000), help="of PPO and of SAC")
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    print(f"{'environment':32} {'algorithm':10} {'layer':8} {'return':>16} {'overridden':>11} {'violating steps':>16}")
    for env_id in IDS:
        single = ncs_env(gym.make(env_id))
        layer = SafeLayer(certificate_for(single.plant, single.certificate_contract), single.plant)
        for algorithm, steps in zip(("PPO", "SAC"), options.steps, strict=True):
            for name, each in {"without": None, "with": layer}.items():
                seeds = range(options.seeds)
                rows = np.array([evaluated(env_id, trained(env_id, algorithm, each, seed, steps)) for seed in seeds])
                score = f"{rows[:, 0].mean():.2f} +- {rows[:, 0].std():.2f}"
                cells = f"{score:>16} {rows[:, 1].mean():>10.1%} {rows[:, 2].sum():>16.0f}"
                print(f"{env_id:32} {algorithm:10} {name:8} {cells}", flush=True)
