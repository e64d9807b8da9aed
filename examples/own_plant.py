"""Shows all steps for a plant of your own: its model, a certificate, a shield, and training behind the shield.

Takes about 17 seconds on one core.
"""

import argparse

import gymnasium as gym
from stable_baselines3 import PPO

from agents import SB3VecEnv
from ncs_gym import Ball, Bounds, Channel, Gaussian, Limits, LinearPlant, Model
from shields import VectorSafetyShield, synthesize

parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=50_000)
options = parser.parse_args()

# The plant is a damped pendulum in discrete time, with the state (angle [rad], rate [rad/s]) and a torque as input.
# The angle has to stay within 0.5 rad and the rate within 2 rad/s.
plant = LinearPlant(
    Model(A=[[0.98, 0.095], [-0.38, 0.90]], B=[[0.005], [0.095]], H=None, dt=0.1),
    Limits(state=[0.5, 2.0], input=3.0),
    Bounds(
        disturbance=Ball(0.003),
        sensor=Gaussian([[1e-5, 0.0], [0.0, 1e-4]], delta=0.05),  # Truncated so that 95 % of it count.
        first_error=0.0,  # The first state is known.
    ),
    {"states": {"angle": "rad", "rate": "rad/s"}},
)
certificate = synthesize(plant)
print(f"largest angle in the safe set: {certificate.safe_set.support([1.0, 0.0]):.3f} rad")

envs = gym.make_vec("ncs_gym/LinearNCS-v0", num_envs=64, plant=plant, channel=Channel(loss=0.4, delay=1))
model = PPO("MlpPolicy", SB3VecEnv(VectorSafetyShield(envs, certificate)), n_steps=64, batch_size=2048, seed=0)
model.learn(options.steps)
successes = [episode["is_success"] for episode in model.ep_info_buffer]
print(f"episodes without a violation: {sum(successes):.0f} of {len(successes)}")
