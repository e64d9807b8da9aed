"""A ROS 2 node around `SafeLoop`. Not tested here: it needs rclpy.

Messages are JSON in `std_msgs/String`, as in `examples/udp_loop.py`, whose `run_plant` is the other side: "samples" are
[step, measurement, steps, missing, digest], the last three from the actuator's echo, "commands" [step, inputs]. Both
sides count steps from the time `start`, by clocks that agree (PTP). Use the profile for sensor data (best effort,
volatile): a reliable topic would deliver old packets late, which is what a control loop has no use for.
"""

import json
import time

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from std_msgs.msg import String

from ncs_gym import Channel, Echo, Packet, truck_trailer
from shields import Certificate, SafeLoop


class SafeController(Node):
    """Decides at every step, and makes up for those that its timer was late for."""

    def __init__(self) -> None:
        super().__init__("safe_controller")
        self.declare_parameter("start", time.time())
        self.begin, self.number, self.waiting = self.get_parameter("start").value, 0, []
        self.plant, network = truck_trailer(mass=4000.0), Channel(delay=1, jitter=2)
        self.loop = SafeLoop(Certificate.load("truck.json"), self.plant, network, downlink=network, echo_age=20)
        self.loop.start(np.zeros(self.plant.n))  # known at step 0
        self.commands = self.create_publisher(String, "commands", qos_profile_sensor_data)
        self.create_subscription(String, "samples", self.hear, qos_profile_sensor_data)
        self.create_timer(self.plant.dt / 20, self.act)

    def hear(self, message: String) -> None:
        """Keeps a sample until its step."""
        self.waiting.append(json.loads(message.data))

    def act(self) -> None:
        """Takes all steps that have begun."""
        while time.time() >= self.begin + self.number * self.plant.dt:
            due = [each for each in self.waiting if each[0] <= self.number]
            self.waiting = [each for each in self.waiting if each[0] > self.number]
            echoes = [Echo(steps, missing, bytes.fromhex(digest)) for *_, steps, missing, digest in due]
            estimate = self.loop.receive([Packet(stamp, y) for stamp, y, *_ in due], echoes=echoes)
            self.loop.decide(np.array([2.0]) - estimate[:1])  # yours
            command = self.loop.command()
            self.commands.publish(String(data=json.dumps([command.stamp, command.inputs.tolist()])))
            self.number += 1
            self.get_logger().debug(self.loop.reason or "proved")


def main() -> None:
    """Runs the node."""
    rclpy.init()
    rclpy.spin(SafeController())


if __name__ == "__main__":
    main()
