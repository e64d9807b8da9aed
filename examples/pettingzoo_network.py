"""Agents of a PettingZoo environment, each behind a network of its own.

    python examples/pettingzoo_network.py

Takes about one second on one core. PettingZoo's parallel API is not Gymnasium's: `Together` makes one environment of
all agents, whose observations and actions are dictionaries, so that `Networked` gives each of them a channel. It takes any
object with that API whose agents all stay until the end; this program brings a small one of its own, so that it runs
without PettingZoo.
"""

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete

from ncs_gym import Channel, Networked


class Together(gym.Env):
    """All agents of a parallel environment as one: dictionaries of observations and actions, the sum of the rewards.

    Args:
        parallel: An environment with PettingZoo's parallel API.
    """

    def __init__(self, parallel):
        self.parallel = parallel
        self.observation_space = Dict({name: parallel.observation_space(name) for name in parallel.possible_agents})
        self.action_space = Dict({name: parallel.action_space(name) for name in parallel.possible_agents})

    def reset(self, *, seed=None, options=None):
        """Starts an episode of all agents."""
        super().reset(seed=seed)
        observations, infos = self.parallel.reset(seed=seed, options=options)
        return observations, {"agents": infos}

    def step(self, action):
        """Steps all agents; the episode ends with the first of them."""
        observations, rewards, terminated, truncated, infos = self.parallel.step(action)
        ends = any(terminated.values()), any(truncated.values())
        return observations, sum(rewards.values()), *ends, {"agents": infos, "rewards": rewards}


class Meeting:
    """Two agents on a line that want to stay together in the wind; each sees both positions."""

    possible_agents = ("left", "right")

    def observation_space(self, agent):
        """Both positions."""
        return Box(-10.0, 10.0, (2,), np.float32)

    def action_space(self, agent):
        """Left, stay, right."""
        return Discrete(3)

    def reset(self, seed=None, options=None):
        """Starts at both ends."""
        self.rng = np.random.default_rng(seed)
        self.positions, self.steps = np.array([-10.0, 10.0], np.float32), 0
        return {name: self.positions.copy() for name in self.possible_agents}, {
            name: {} for name in self.possible_agents
        }

    def step(self, actions):
        """Moves both by their actions, and each by the wind."""
        moves = np.array([actions[name] - 1.0 for name in self.possible_agents])
        self.positions = np.clip(self.positions + moves + self.rng.integers(-1, 2, 2), -10.0, 10.0)
        self.positions, self.steps = self.positions.astype(np.float32), self.steps + 1
        apart = float(abs(np.diff(self.positions)[0]))
        seen, over = self.positions, self.steps >= 200

        def each(value):
            return dict.fromkeys(self.possible_agents, value)

        return {name: seen.copy() for name in self.possible_agents}, each(-apart), each(False), each(over), each({})


def mean_distance(channel):
    """Returns how far apart two agents are on average that go to where they see the other one."""
    env = Networked(Together(Meeting()), channel)
    seen, _ = env.reset(seed=0)
    distances, over = [], False
    while not over:
        toward = {"left": np.sign(np.diff(seen["left"])[0]), "right": -np.sign(np.diff(seen["right"])[0])}
        seen, reward, *ends, _ = env.step({name: int(way) + 1 for name, way in toward.items()})
        distances.append(-reward / 2.0)
        over = any(ends)
    return np.mean(distances)


if __name__ == "__main__":
    late = Channel(delay=3)
    print(f"both see at once: {mean_distance(None):.2f} apart on average")
    print(f"one sees three steps late: {mean_distance({'right': late}):.2f}")
    print(f"both see three steps late: {mean_distance({'left': late, 'right': late}):.2f}")
