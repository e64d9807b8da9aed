"""Shows how to choose the network: the estimation error of the same plant, input and seed behind six channels.

Takes about one second on one core.
"""

import gymnasium as gym
import numpy as np

from ncs_gym import Channel, GilbertElliott

CHANNELS = {
    "perfect": Channel(),
    "30 % lost, 2 steps late": Channel(loss=0.3, delay=2),
    "the same in bursts": Channel(loss=GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.25), delay=2),
    "every 5th step, up to 4 late": Channel(send_period=5, jitter=4),
    "rounded to 0.2": Channel(quantization_step=0.2),
    "blackout": Channel(loss=1.0),
}
# The input is zero in every step; the estimate differs from the state by sensor noise and by what the channel does.
for name, channel in CHANNELS.items():
    env = gym.make("ncs_gym:ncs_gym/TruckTrailer-v0", channel=channel)
    env.reset(seed=0)
    errors = [env.step(np.zeros(1, np.float32))[4]["estimation_error"] for _ in range(200)]
    print(f"{name:30s} root mean square error {np.sqrt(np.mean(np.square(errors))):.4f}")
