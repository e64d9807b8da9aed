"""What network does a position servo need? Saves the plant for `ncs requirements`, and asks a first question here.

Takes about nine seconds on one core.
"""

import shields
from ncs_gym import LinearPlant

# Angle and rate of a geared motor; the input is a voltage. With python-control: control.ss(A, B, C, 0).
A, B, C, D = [[0.0, 1.0], [0.0, -20.0]], [[0.0], [40.0]], [[1.0, 0.0]], [[0.0]]
servo = LinearPlant.from_statespace(
    (A, B, C, D),
    dt=0.002,
    box=[0.2, 4.0],  # rad, rad/s
    u_max=12.0,  # V
    disturbance_bound=[0.0, 0.1],  # a load torque that changes the rate by 50 rad/s^2 [rad, rad/s per step]
    sensor_bound=5e-4,  # encoder [rad]
    initial_bound=[1e-3, 0.05],
    state_names=["angle", "rate"],
    state_units=["rad", "rad/s"],
)
servo.save("servo.json")
for sampled in (servo.resampled(0.005), servo.resampled(0.02)):
    found = shields.requirements(sampled, ages=[0, 1, 3, 6])
    print(f"a step of {sampled.dt:g} s: the newest sample may be {found.largest_age()} steps old")
