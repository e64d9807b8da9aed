"""A task of your own: the coupling is to oscillate, and the agent is told the phase."""

from dataclasses import dataclass

import gymnasium as gym
import numpy as np

from ncs_gym import Task


@dataclass(frozen=True, eq=False, kw_only=True)
class Oscillation(Task):
    """Follow a sine with the first state; the phase is drawn anew in each episode.

    Attributes:
        amplitude: Of the sine, in the units of the state.
        period: [steps].
    """

    amplitude: float = 1.0
    period: int = 40

    def begin(self, rng, plant):
        """Returns the state of the task: the phase [rad]."""
        return rng.uniform(0.0, 2.0 * np.pi)

    def advance(self, rng, plant, task_state, u):
        """Returns the phase one step on."""
        return (task_state + 2.0 * np.pi / self.period) % (2.0 * np.pi)

    def observe(self, task_state):
        """Returns what the agent sees besides the estimate."""
        return np.array([np.sin(task_state), np.cos(task_state)])

    def observation_bound(self, plant, horizon):
        """Returns how large these entries can become."""
        return np.ones(2)

    def reward(self, plant, task_state, state, u):
        """Returns how near the state is."""
        return -float((state[0] - self.amplitude * np.sin(task_state)) ** 2)


env = gym.make("ncs_gym:ncs_gym/TruckTrailer-v0", task=Oscillation())
env.reset(seed=0, options={"state": [0.0, 0.0]})
rewards = [env.step(np.zeros(1, np.float32))[1] for _ in range(200)]
print(f"return of doing nothing: {sum(rewards):.1f}")
