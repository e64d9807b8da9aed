"""Shows all steps for a plant of your own: its model, a certificate, a shield, and training behind the shield.

Takes about 17 seconds on one core.
"""

import argparse

import gymnasium as gym
from stable_baselines3 import PPO

import ncs_gym
from agents import SB3VecEnv
from shields import VectorSafetyShield, synthesize

parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=50_000)
options = parser.parse_args()

# The plant is a damped pendulum in discrete time, with the state (angle [rad], rate [rad/s]) and a torque as input.
# The angle has to stay within 0.5 rad and the rate within 2 rad/s.
plant = ncs_gym.LinearPlant(
    A=[[0.98, 0.095], [-0.38, 0.90]],
    B=[[0.005], [0.095]],
    box=[0.5, 2.0],
    u_max=3.0,
    dt=0.1,
    gamma=1e-5,  # The disturbance d satisfies |d|^2 <= gamma.
    measurement_noise_cov=[[1e-5, 0.0], [0.0, 1e-4]],  # Gaussian, truncated at 1 - delta = 95 %.
    initial_bound=0.0,  # The first state is known.
    state_names=("angle", "rate"),
    state_units=("rad", "rad/s"),
)
certificate = synthesize(plant)
print(f"largest angle in the safe set: {certificate.safe_set.support([1.0, 0.0]):.3f} rad")

envs = gym.make_vec("ncs_gym/LinearNCS-v0", num_envs=64, plant=plant, channel=ncs_gym.Channel(loss=0.4, delay=1))
model = PPO("MlpPolicy", SB3VecEnv(VectorSafetyShield(envs, certificate)), n_steps=64, batch_size=2048, seed=0)
model.learn(options.steps)
successes = [episode["is_success"] for episode in model.ep_info_buffer]
print(f"episodes without a violation: {sum(successes):.0f} of {len(successes)}")
