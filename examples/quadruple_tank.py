"""The quadruple tank with the limits that Johansson (2000) published: levels of 0 to 20 cm, pumps of 0 to 10 V.

Neither is symmetric about the operating point. An agent that does harm drives all pumps to one end and then to the
other; the shield keeps every level.

Takes about ten seconds on one core.
"""

import gymnasium as gym
import numpy as np
from scipy.signal import cont2discrete

import ncs_gym  # noqa: F401
from ncs_gym import Channel, LinearPlant, contract_of
from shields import SafetyShield, synthesize

# Deviations of the levels [cm] from the operating point, by the voltages of two pumps [V]; two levels are measured.
A = np.array([[-0.0159, 0, 0.0419, 0], [0, -0.0111, 0, 0.0333], [0, 0, -0.0419, 0], [0, 0, 0, -0.0333]])
B = np.array([[0.0833, 0], [0, 0.0628], [0, 0.0479], [0.0312, 0]])
C = np.eye(2, 4)
dt = 3.0
pump_error = cont2discrete((A, B, C, np.zeros((2, 2))), dt)[1]  # what 1 V more adds to the levels in a step

plant = LinearPlant.from_statespace(
    (A, B, C, 0),
    dt,
    operating_state=[12.4, 12.7, 1.8, 1.4],
    operating_input=[3.0, 3.0],
    state_limits=(0.0, 20.0),
    input_limits=(0.0, 10.0),
    disturbance_bound=(pump_error, 0.1),
    sensor_bound=0.1,
    initial_bound=0.2,
    state_names=["level 1", "level 2", "level 3", "level 4"],
    state_units=["cm"] * 4,
    input_names=["pump 1", "pump 2"],
    input_units=["V"] * 2,
)
channel = Channel(loss=0.3, send_period=2, max_consecutive_losses=2)  # LoRa, every 6 s
contract = contract_of(channel)
certificate = synthesize(plant, contract=contract)
print(plant)
print(certificate)

env = gym.make("ncs_gym/LinearNCS-v0", plant=plant, channel=channel, contract=contract, max_episode_steps=400)
for name, loop in (("without a shield", env), ("with a shield", SafetyShield(env, certificate))):
    loop.reset(seed=0)
    violations, lowest, highest = 0, np.full(4, np.inf), np.full(4, -np.inf)
    for step in range(400):
        action = np.full(2, 1.0 if step // 100 % 2 == 0 else -1.0, np.float32)
        _, _, _, _, info = loop.step(action)
        levels = plant.from_deviation(info["state"])
        lowest, highest = np.minimum(lowest, levels), np.maximum(highest, levels)
        violations += int(info["cost"])
    reached = ", ".join(f"{low:.1f} to {high:.1f}" for low, high in zip(lowest, highest, strict=True))
    print(f"{name}: {violations} of 400 steps outside, levels [cm] {reached}")
