"""Shows how to write a task: the coupling is to follow a sine, and the observation contains the phase of the sine.

Takes about one second on one core.
"""

from dataclasses import dataclass

import gymnasium as gym
import numpy as np

from ncs_gym import Task


@dataclass(frozen=True, eq=False, kw_only=True)
class Oscillation(Task):
    """The first state is to follow a sine, which starts with a random phase in each episode.

    Attributes:
        amplitude: Amplitude of the sine, in the units of the state.
        period: Period of the sine [steps].
    """

    amplitude: float = 1.0
    period: int = 40

    def begin(self, rng, plant):
        """Returns the state of the task, which is the phase [rad]."""
        return rng.uniform(0.0, 2.0 * np.pi)

    def advance(self, rng, plant, task_state, u):
        """Returns the phase after one more step."""
        return (task_state + 2.0 * np.pi / self.period) % (2.0 * np.pi)

    def observe(self, task_state):
        """Returns the entries of the observation that follow the estimate."""
        return np.array([np.sin(task_state), np.cos(task_state)])

    def observation_bound(self, plant, horizon):
        """Returns the largest absolute values of these entries."""
        return np.ones(2)

    def reward(self, plant, task_state, state, u):
        """Returns minus the squared distance of the state from the sine."""
        return -float((state[0] - self.amplitude * np.sin(task_state)) ** 2)


env = gym.make("ncs_gym:ncs_gym/TruckTrailer-v0", task=Oscillation())
env.reset(seed=0, options={"state": [0.0, 0.0]})
rewards = [env.step(np.zeros(1, np.float32))[1] for _ in range(200)]
print(f"return of doing nothing: {sum(rewards):.1f}")
