"""Shows PPO in one file, written with torch and gymnasium alone, with or without a shield.

Compare `python examples/single_file_ppo.py` with `python examples/single_file_ppo.py --shield none`.

Takes about 35 seconds on one core.
"""

from collections import deque
from dataclasses import dataclass
from typing import Literal

import gymnasium as gym
import numpy as np
import torch
import tyro
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import NormalizeObservation, RecordEpisodeStatistics
from torch import nn
from torch.distributions import Normal

from shields import SafetyShield


@dataclass(frozen=True)
class Settings:
    """Settings of a training run."""

    env_id: str = "ncs_gym:ncs_gym/TruckTrailerCruise-v0"
    """Id of any environment with a Box of actions."""
    shield: Literal["none", "project", "switch", "boundary", "monitor"] = "project"
    """Mode of the shield; "none" trains without one."""
    penalty: float = 0.0
    """Subtracted from the reward for every intervention of the shield."""
    total_timesteps: int = 100_000
    """Environment steps, rounded down to whole rollouts; at least one."""
    num_envs: int = 8
    """Number of environments stepped together."""
    rollout: int = 256
    """Steps of each environment between updates."""
    epochs: int = 10
    """Number of passes over each rollout."""
    batch_size: int = 256
    """Transitions per gradient step."""
    learning_rate: float = 1e-3
    """Initial learning rate of Adam, which falls to zero linearly."""
    discount: float = 0.98
    """Discount factor gamma per step."""
    gae_lambda: float = 0.95
    """Parameter lambda of generalized advantage estimation."""
    clip: float = 0.2
    """Largest change of the probability ratio that is still rewarded."""
    max_grad_norm: float = 0.5
    """Gradients are clipped to this norm."""
    seed: int = 0
    """Seed of environments, network and sampling."""


def make_env(settings: Settings) -> gym.Env:
    """Returns an environment; wrappers that change observations or rewards are outside the shield."""
    env = gym.make(settings.env_id)
    if settings.shield != "none":
        env = SafetyShield(env, mode=settings.shield, penalty=settings.penalty)
    return NormalizeObservation(RecordEpisodeStatistics(env))


def network(inputs: int, outputs: int) -> nn.Sequential:
    """Returns a network with two hidden layers."""
    return nn.Sequential(nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs))


class Policy(nn.Module):
    """A Gaussian distribution over actions, and a value function."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.mean = nn.Sequential(
            nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs)
        )
        self.critic = network(inputs, 1)
        self.log_std = nn.Parameter(torch.full((outputs,), -0.5))
        with torch.no_grad():
            self.mean[-1].weight *= 0.01

    def actions(self, observation: torch.Tensor) -> Normal:
        """Returns the distribution of actions."""
        return Normal(self.mean(observation), self.log_std.exp())

    def value(self, observation: torch.Tensor) -> torch.Tensor:
        """Returns the expected discounted return."""
        return self.critic(observation).squeeze(-1)


def tensor(array: np.ndarray) -> torch.Tensor:
    """Returns a float32 tensor."""
    return torch.as_tensor(np.asarray(array), dtype=torch.float32)


settings = tyro.cli(Settings)
torch.manual_seed(settings.seed)
torch.set_num_threads(1)
rng = np.random.default_rng(settings.seed)
envs = SyncVectorEnv([lambda: make_env(settings)] * settings.num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
policy = Policy(envs.single_observation_space.shape[0], envs.single_action_space.shape[0])
optimizer = torch.optim.Adam(policy.parameters(), settings.learning_rate, eps=1e-5)
updates = max(1, settings.total_timesteps // (settings.rollout * settings.num_envs))
returns, episodes, violations, interventions = deque(maxlen=40), 0, 0.0, 0

observation = tensor(envs.reset(seed=settings.seed)[0])
for update in range(updates):
    optimizer.param_groups[0]["lr"] = settings.learning_rate * (1.0 - update / updates)
    steps = []
    for _ in range(settings.rollout):
        with torch.no_grad():
            distribution, value = policy.actions(observation), policy.value(observation)
            action = distribution.sample()
        following, reward, terminated, truncated, info = envs.step(action.numpy())
        done, reward = terminated | truncated, tensor(reward)
        if done.any():
            final, ended = info["final_info"], np.flatnonzero(done)
            returns.extend(final["episode"]["r"][ended].tolist())
            episodes += len(ended)
            violations += final["episode_violations"][ended].sum()
            interventions += int(final["episode_interventions"][ended].sum()) if settings.shield != "none" else 0
            for e in np.flatnonzero(truncated & ~terminated):  # A truncated episode would have gone on.
                with torch.no_grad():
                    reward[e] += settings.discount * policy.value(tensor(info["final_obs"][e]))
        steps.append((observation, action, distribution.log_prob(action).sum(-1), value, reward, tensor(done)))
        observation = tensor(following)

    observations, actions, log_probs, values, rewards, dones = (torch.stack(each) for each in zip(*steps, strict=True))
    advantages, advantage = torch.zeros_like(rewards), torch.zeros(settings.num_envs)
    with torch.no_grad():
        later = policy.value(observation)
    for t in reversed(range(settings.rollout)):
        going_on = settings.discount * (1.0 - dones[t])
        advantage = rewards[t] + going_on * later - values[t] + going_on * settings.gae_lambda * advantage
        advantages[t], later = advantage, values[t]

    observations, actions = observations.flatten(0, 1), actions.flatten(0, 1)
    log_probs, values, advantages = log_probs.flatten(), values.flatten(), advantages.flatten()
    targets = advantages + values
    for _ in range(settings.epochs):
        for batch in torch.as_tensor(rng.permutation(len(values))).split(settings.batch_size):
            ratio = (policy.actions(observations[batch]).log_prob(actions[batch]).sum(-1) - log_probs[batch]).exp()
            gain = (advantages[batch] - advantages[batch].mean()) / (advantages[batch].std(correction=0) + 1e-8)
            clipped = ratio.clamp(1.0 - settings.clip, 1.0 + settings.clip)
            surprise = policy.value(observations[batch]) - targets[batch]
            loss = -torch.minimum(ratio * gain, clipped * gain).mean() + 0.5 * surprise.square().mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(policy.parameters(), settings.max_grad_norm)
            optimizer.step()

print(f"mean return of the last {len(returns)} of {episodes} episodes: {np.mean(returns) if returns else np.nan:.1f}")
print(f"violating steps: {violations:.0f}; actions overridden: {interventions}")
