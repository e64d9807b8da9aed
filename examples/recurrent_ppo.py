"""Shows sb3-contrib's RecurrentPPO, a policy with a memory, behind a channel with long outages.

The observation does not say how old the estimate is, which a recurrent policy can find out from earlier observations.

Takes about 40 seconds on one core.
"""

import argparse

import gymnasium as gym
import torch
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.env_util import make_vec_env

from ncs_gym import Channel, GilbertElliott
from shields import SafetyShield

parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=10_000)
options = parser.parse_args()
torch.set_num_threads(1)  # the network is small: more threads only wait for each other


def make_env() -> gym.Env:
    """Returns the shielded cruise environment behind a channel whose outages last ten steps on average."""
    channel = Channel(loss=GilbertElliott(p_good_to_bad=0.05, p_bad_to_good=0.1), delay=1, quantization_step=0.05)
    return SafetyShield(gym.make("ncs_gym:ncs_gym/TruckTrailerCruise-v0", channel=channel))


envs = make_vec_env(make_env, n_envs=4, seed=0, monitor_kwargs={"info_keywords": ("episode_violations",)})
model = RecurrentPPO("MlpLstmPolicy", envs, n_steps=128, batch_size=128, n_epochs=4, seed=0, device="cpu")
model.learn(options.steps)

episodes = model.ep_info_buffer
print(f"mean return of the last {len(episodes)} episodes: {sum(each['r'] for each in episodes) / len(episodes):.1f}")
print(f"violating steps: {sum(each['episode_violations'] for each in episodes):.0f}")
