"""The quadruple tank with the limits that Johansson (2000) published: levels of 0 to 20 cm, pumps of 0 to 10 V.

Neither is symmetric about the operating point. An agent that does harm drives all pumps to one end and then to the
other; the shield keeps every level.

Takes about ten seconds on one core.
"""

import gymnasium as gym
import numpy as np
from scipy.signal import cont2discrete

from ncs_gym import Bounds, Channel, Limits, LinearPlant, Model, Through, contract_of
from shields import SafetyShield, synthesize

# Deviations of the levels [cm] from the operating point, by the voltages of two pumps [V]; two levels are measured.
A = np.array([[-0.0159, 0, 0.0419, 0], [0, -0.0111, 0, 0.0333], [0, 0, -0.0419, 0], [0, 0, 0, -0.0333]])
B = np.array([[0.0833, 0], [0, 0.0628], [0, 0.0479], [0.0312, 0]])
C = np.eye(2, 4)
pump_error = cont2discrete((A, B, C, np.zeros((2, 2))), 3.0)[1]  # what 1 V more adds to the levels in a step

plant = LinearPlant(
    Model.sampled(A, B, C, dt=3.0, at=([12.4, 12.7, 1.8, 1.4], [3.0, 3.0])),
    Limits(state=(np.zeros(4), np.full(4, 20.0)), input=(np.zeros(2), np.full(2, 10.0))),
    Bounds(disturbance=Through(pump_error, 0.1), sensor=0.1, first_error=0.2),
    {
        "states": {"level 1": "cm", "level 2": "cm", "level 3": "cm", "level 4": "cm"},
        "inputs": {"pump 1": "V", "pump 2": "V"},
    },
)
channel = Channel(loss=0.3, send_period=2, max_consecutive_losses=2)  # LoRa, every 6 s
contract = contract_of(channel)
certificate = synthesize(plant, contract=contract)
print(plant)
print(certificate)

settings = {"plant": plant, "channel": channel, "contract": contract, "max_episode_steps": 400}
bare, other = (gym.make("ncs_gym/LinearNCS-v0", **settings) for _ in range(2))  # a shield guards the one it is given
for name, loop in (("without a shield", bare), ("with a shield", SafetyShield(other, certificate))):
    loop.reset(seed=0)
    violations, lowest, highest = 0, np.full(4, np.inf), np.full(4, -np.inf)
    for step in range(400):
        action = np.full(2, 1.0 if step // 100 % 2 == 0 else -1.0, np.float32)
        _, _, _, _, info = loop.step(action)
        levels = info["state"] + plant.operating_state
        lowest, highest = np.minimum(lowest, levels), np.maximum(highest, levels)
        violations += int(info["cost"])
    reached = ", ".join(f"{low:.1f} to {high:.1f}" for low, high in zip(lowest, highest, strict=True))
    print(f"{name}: {violations} of 400 steps outside, levels [cm] {reached}")
