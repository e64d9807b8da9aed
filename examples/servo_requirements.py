"""What network does a position servo need? Saves the plant for `ncs requirements`, and asks a first question here.

Takes about nine seconds on one core.
"""

import shields
from ncs_gym import Bounds, Limits, LinearPlant, Model, Through


def servo(dt: float) -> LinearPlant:
    """Angle and rate of a geared motor, sampled every dt seconds; the input is a voltage."""
    # With python-control: Model.of(control.ss(A, B, C, 0), dt).
    model = Model.sampled([[0.0, 1.0], [0.0, -20.0]], [[0.0], [40.0]], [[1.0, 0.0]], dt)
    return LinearPlant(
        model,
        Limits(state=[0.2, 4.0], input=12.0),
        Bounds(
            disturbance=Through(model.held([[0.0], [1.0]]), 50.0),  # what a load torque does to the rate [rad/s^2]
            sensor=5e-4,  # encoder [rad]
            first_error=[1e-3, 0.05],
        ),
        {"states": {"angle": "rad", "rate": "rad/s"}},
    )


servo(0.005).save("servo.json")
for dt in (0.005, 0.02):
    found = shields.requirements(servo(dt), ages=[0, 1, 3, 6, 9])
    print(f"a step of {dt:g} s: max_age = {found.largest_age()}")
