"""What network does a position servo need? Saves the plant for `ncs requirements`, and asks a first question here.

Takes about nine seconds on one core.
"""

import shields
from ncs_gym import Bounds, Limits, LinearPlant, Model

# Angle and rate of a geared motor; the input is a voltage. With python-control: Model.of(control.ss(A, B, C, 0), dt).
servo = LinearPlant(
    Model.sampled([[0.0, 1.0], [0.0, -20.0]], [[0.0], [40.0]], [[1.0, 0.0]], dt=0.002),
    Limits(state=[0.2, 4.0], input=12.0),
    Bounds(
        disturbance=[0.0, 0.1],  # a load torque that changes the rate by 50 rad/s^2 [rad, rad/s per step]
        sensor=5e-4,  # encoder [rad]
        first_error=[1e-3, 0.05],
    ),
    {"states": {"angle": "rad", "rate": "rad/s"}},
)
servo.save("servo.json")
for sampled in (servo.resampled(0.005), servo.resampled(0.02)):
    found = shields.requirements(sampled, ages=[0, 1, 3, 6])
    print(f"a step of {sampled.dt:g} s: the newest sample may be {found.largest_age()} steps old")
