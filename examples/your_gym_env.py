"""Shows delay, loss and a shield for another Gymnasium environment: `Pendulum-v1`, held near upright while it learns.

Takes about 25 seconds on one core.
"""

import argparse

import gymnasium as gym
from stable_baselines3 import PPO

from agents import SB3VecEnv
from ncs_gym import Bounds, Channel, GymProcess, Limits, Regulation, contract_of, linear_model
from shields import VectorSafetyShield, synthesize

parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=30_000)
options = parser.parse_args()


def write_state(env, state):
    """Puts the pendulum into a state."""
    env.unwrapped.state = state


process = GymProcess(lambda: gym.make("Pendulum-v1"), lambda env: env.unwrapped.state, write_state)
# The limits: angle [rad] and rate [rad/s], and the torque. What the sensors and the first estimate are off by is
# declared; what the linear model leaves out is bounded by sampling.
limits = Limits(state=[0.25, 1.5], input=2.0)
plant = linear_model(process, limits, Bounds(disturbance=0.0, sensor=[0.002, 0.01], first_error=[0.005, 0.03]), dt=0.05)
channel = Channel(loss=0.3, max_consecutive_losses=2)
certificate = synthesize(plant, contract=contract_of(channel))
print(plant.remainder.sentence)

loop = {"plant": plant, "process": process, "channel": channel, "task": Regulation()}
envs = gym.make_vec("ncs_gym:ncs_gym/LinearNCS-v0", num_envs=16, **loop)
model = PPO("MlpPolicy", SB3VecEnv(VectorSafetyShield(envs, certificate)), n_steps=64, batch_size=256, seed=0)
model.learn(options.steps)
episodes = list(model.ep_info_buffer)
safe, mean = sum(each["is_success"] for each in episodes), sum(each["r"] for each in episodes) / len(episodes)
print(f"episodes without a violation: {safe:.0f} of {len(episodes)}; mean return {mean:.1f}")
