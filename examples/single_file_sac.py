"""Shows SAC in one file, written with torch and gymnasium alone, with or without a shield.

Compare `python examples/single_file_sac.py` with `python examples/single_file_sac.py --shield none`.

Takes about 35 seconds on one core.
"""

from collections import deque
from copy import deepcopy
from dataclasses import dataclass
from typing import Literal

import gymnasium as gym
import numpy as np
import torch
import tyro
from gymnasium.wrappers import RecordEpisodeStatistics, RescaleObservation
from torch import nn
from torch.distributions import Normal

from shields import SafetyShield


@dataclass(frozen=True)
class Settings:
    """Settings of a training run."""

    env_id: str = "ncs_gym:ncs_gym/TruckTrailerCruise-v0"
    """Id of any environment whose actions are a Box between -1 and 1."""
    shield: Literal["none", "project", "switch", "boundary", "monitor"] = "project"
    """Mode of the shield; "none" trains without one."""
    penalty: float = 0.0
    """Subtracted from the reward for every intervention of the shield."""
    total_timesteps: int = 6000
    """Number of environment steps."""
    learning_starts: int = 1000
    """Steps of random actions before the first update."""
    batch_size: int = 128
    """Transitions per gradient step."""
    learning_rate: float = 1e-3
    """Learning rate of the three Adam optimizers."""
    discount: float = 0.98
    """Discount factor gamma per step."""
    averaging: float = 0.01
    """Fraction by which the target networks move towards the critics after each update."""
    seed: int = 0
    """Seed of environment, networks and sampling."""


def network(inputs: int, outputs: int) -> nn.Sequential:
    """Returns a network with two hidden layers."""
    return nn.Sequential(nn.Linear(inputs, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU(), nn.Linear(128, outputs))


class Actor(nn.Module):
    """A Gaussian distribution, mapped into the box of actions by tanh."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.body = network(inputs, 2 * outputs)

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns actions and the logarithm of their density."""
        mean, log_std = self.body(observation).chunk(2, dim=-1)
        gaussian = Normal(mean, log_std.clamp(-5.0, 2.0).exp())
        raw = gaussian.rsample()
        slope = 2.0 * (np.log(2.0) - raw - nn.functional.softplus(-2.0 * raw))  # This is log(1 - tanh(raw)^2).
        return raw.tanh(), (gaussian.log_prob(raw) - slope).sum(-1)


class Critic(nn.Module):
    """Two estimates of the return from an observation and an action."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.both = nn.ModuleList([network(inputs, 1), network(inputs, 1)])

    def forward(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Returns both estimates, shape (2, N)."""
        together = torch.cat([observation, action], dim=-1)
        return torch.stack([each(together).squeeze(-1) for each in self.both])


settings = tyro.cli(Settings)
torch.manual_seed(settings.seed)
torch.set_num_threads(1)
rng = np.random.default_rng(settings.seed)

env = gym.make(settings.env_id)
if settings.shield != "none":
    env = SafetyShield(env, mode=settings.shield, penalty=settings.penalty)
env = RecordEpisodeStatistics(RescaleObservation(env, np.float32(-1.0), np.float32(1.0)))
entries, inputs = env.observation_space.shape[0], env.action_space.shape[0]

actor, critic = Actor(entries, inputs), Critic(entries + inputs)
target = deepcopy(critic)
log_temperature = torch.zeros(1, requires_grad=True)
actor_step, critic_step, temperature_step = (
    torch.optim.Adam(parameters, settings.learning_rate)
    for parameters in (actor.parameters(), critic.parameters(), [log_temperature])
)
# Each row is a transition: observation, action, reward, next observation, and whether the episode terminated there.
buffer = torch.zeros(settings.total_timesteps, 2 * entries + inputs + 2)
returns, episodes, violations, interventions = deque(maxlen=20), 0, 0.0, 0

observation, _ = env.reset(seed=settings.seed)
env.action_space.seed(settings.seed)
for step in range(settings.total_timesteps):
    if step < settings.learning_starts:
        action = env.action_space.sample()
    else:
        with torch.no_grad():
            action = actor(torch.as_tensor(observation))[0].numpy()
    following, reward, terminated, truncated, info = env.step(action)
    buffer[step] = torch.as_tensor(np.concatenate([observation, action, [reward], following, [terminated]]))
    observation = following
    if terminated or truncated:
        returns.append(info["episode"]["r"])
        episodes += 1
        violations += info["episode_violations"]
        interventions += info.get("episode_interventions", 0)
        observation, _ = env.reset()
    if step < settings.learning_starts:
        continue

    batch = buffer[torch.as_tensor(rng.integers(step + 1, size=settings.batch_size))]
    now, taken, paid, then, ended = batch.split([entries, inputs, 1, entries, 1], dim=-1)
    temperature = log_temperature.exp().detach()
    with torch.no_grad():
        next_action, log_prob = actor(then)
        worth = target(then, next_action).min(dim=0).values - temperature * log_prob
        goal = paid.squeeze(-1) + settings.discount * (1.0 - ended.squeeze(-1)) * worth
    critic_loss = (critic(now, taken) - goal).square().mean()
    critic_step.zero_grad()
    critic_loss.backward()
    critic_step.step()

    action_now, log_prob = actor(now)
    actor_loss = (temperature * log_prob - critic(now, action_now).min(dim=0).values).mean()
    actor_step.zero_grad()
    actor_loss.backward()
    actor_step.step()

    temperature_loss = -(log_temperature.exp() * (log_prob.detach() - inputs)).mean()
    temperature_step.zero_grad()
    temperature_loss.backward()
    temperature_step.step()
    with torch.no_grad():
        for slow, fast in zip(target.parameters(), critic.parameters(), strict=True):
            slow.lerp_(fast, settings.averaging)

print(f"mean return of the last {len(returns)} of {episodes} episodes: {np.mean(returns) if returns else np.nan:.1f}")
print(f"violating steps: {violations:.0f}; actions overridden: {interventions}")
