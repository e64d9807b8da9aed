"""A ROS 2 node around `ControllerNode`: how the same loop runs over topics. Not tested here: it needs rclpy.

Datagrams travel as they are, in `std_msgs/UInt8MultiArray`: "to_controller" from sensor and actuator, "from_controller"
to both, each of which uses what is addressed to it. Use the profile for sensor data (best effort, volatile): a reliable
topic would deliver old packets late, which is what a control loop has no use for. Steps come from a steady timer; ROS
time may jump, and no stamp is taken from it.
"""

import time
from collections import deque

import numpy as np
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from std_msgs.msg import UInt8MultiArray

from ncs_gym import Channel, truck_trailer
from ncs_gym.network.wire import LARGEST_DATAGRAM, Wire
from shields import Certificate, ControllerNode, SafeLoop
from shields.nodes import Datagram, StepClock


class TopicTransport:
    """The `Transport` of a node over two topics."""

    def __init__(self, node: Node, hears: str, says: str) -> None:
        self._waiting: deque[Datagram] = deque(maxlen=512)
        self._publisher = node.create_publisher(UInt8MultiArray, says, qos_profile_sensor_data)
        node.create_subscription(UInt8MultiArray, hears, self._hear, qos_profile_sensor_data)

    def _hear(self, message: UInt8MultiArray) -> None:
        self._waiting.append(Datagram(time.monotonic(), bytes(message.data[: LARGEST_DATAGRAM + 1]), None))

    def send(self, data: bytes, to: object = None) -> None:
        """Publishes a datagram."""
        self._publisher.publish(UInt8MultiArray(data=list(data)))

    def received(self) -> list[Datagram]:
        """Returns what arrived since the last call."""
        arrived = list(self._waiting)
        self._waiting.clear()
        return arrived

    def close(self) -> None:
        """Is left to rclpy."""


class SafeController(Node):
    """Decides at every step of a steady timer."""

    def __init__(self) -> None:
        super().__init__("safe_controller")
        plant = truck_trailer(mass=4000.0)
        network = Channel(delay=1, jitter=2)
        loop = SafeLoop(Certificate.load("truck.json"), plant, network, downlink=network, echo_age=20)
        with open("key", "rb") as file:
            wire = Wire(plant, loop.input_delay, file.read())
        transport = TopicTransport(self, "to_controller", "from_controller")
        self.node = ControllerNode(loop, wire, transport, StepClock(plant.dt), np.zeros(plant.n), known=False)
        self.create_timer(plant.dt, self.step, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def step(self) -> None:
        """One step; a timer that was late is noticed by the node's own clock."""
        estimate = self.node.receive(time.monotonic())
        if estimate is not None:
            self.node.decide(np.array([2.0]) - estimate[:1])  # yours
            self.get_logger().debug(self.node.loop.reason or "proved")


def main() -> None:
    """Runs the node."""
    rclpy.init()
    rclpy.spin(SafeController())


if __name__ == "__main__":
    main()
