"""A control loop with another downlink than its environment's own."""

from agents.control_loop import ControlLoop
from ncs_gym import Channel


def test_control_loop_replaces_the_downlink():
    env = "ncs_gym/TruckTrailerCruiseTwoWay-v0"
    assert ControlLoop(env=env).single().unwrapped.downlink_protocol.lead == 3
    loop = ControlLoop(env=env, downlink=Channel(delay=1))
    assert loop.single().unwrapped.downlink_protocol.lead == loop.vector(2).unwrapped.downlink_protocol.lead == 1
