"""Shows stable-baselines3's SubprocVecEnv: shielded environments in processes of their own, for slow plants.

Takes about ten seconds on one core. `agents.SB3VecEnv` is faster for the environments of this package.
"""

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from shields import SafetyShield

if __name__ == "__main__":
    torch.set_num_threads(1)  # the network is small: more threads only wait for each other
    env_id = "ncs_gym:ncs_gym/TruckTrailerCruise-v0"
    keywords = {"info_keywords": ("episode_violations", "is_success")}
    envs = make_vec_env(
        env_id, n_envs=2, wrapper_class=SafetyShield, vec_env_cls=SubprocVecEnv, monitor_kwargs=keywords
    )
    model = PPO("MlpPolicy", envs, n_steps=256, seed=0, device="cpu").learn(2048)
    violating = sum(episode["episode_violations"] for episode in model.ep_info_buffer)
    print(f"{len(model.ep_info_buffer)} episodes, violating steps: {violating:.0f}")
    envs.close()
