"""A control loop over a real network: sensor, actuator and controller as nodes that talk in datagrams.

`nodes` has the three of them, `step_clock` how they agree on steps, `transport` what carries their datagrams.
"""

from shields.nodes.nodes import ActuatorNode, ControllerNode, SensorNode, run_controller, run_plant_side
from shields.nodes.step_clock import StepClock
from shields.nodes.transport import Datagram, Transport, UdpTransport

__all__ = [
    "ActuatorNode",
    "ControllerNode",
    "Datagram",
    "SensorNode",
    "StepClock",
    "Transport",
    "UdpTransport",
    "run_controller",
    "run_plant_side",
]
