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
found = shields.requirements(servo, sampling_periods=[0.005, 0.02], losses=[0, 3, 10])
for point in found.points:
    network = point.network
    share = "none found" if point.certificate is None else f"{point.share:.2f} of the box"
    print(f"a sample every {network.sampling_period:g} s, {network.losses} lost in a row: {share}")
