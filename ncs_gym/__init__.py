"""Imperfect networks around any Gymnasium environment, and plants behind them; importing registers the ids."""

from typing import Any

from ncs_gym.bounds import Ball, Bounds, Box, Gaussian, Sum, Through
from ncs_gym.disturbances import (
    AdversarialDisturbance,
    BoxDisturbance,
    Disturbance,
    SinusoidDisturbance,
)
from ncs_gym.ellipsoid import Ellipsoid
from ncs_gym.envs.env import NCSEnv
from ncs_gym.envs.episode_channels import RandomChannel, VectorRandomChannel
from ncs_gym.envs.request_actions import RequestActions, VectorRequestActions
from ncs_gym.envs.vector_env import NCSVectorEnv
from ncs_gym.estimation.error_bound import ErrorSetError, UnstablePlantError
from ncs_gym.limits import Limits
from ncs_gym.model import Model
from ncs_gym.network.channel import (
    BrokenContractWarning,
    Channel,
    ChannelContract,
    GilbertElliott,
    Packet,
    TraceChannel,
    contract_of,
)
from ncs_gym.network.downlink import Actuator, Echo
from ncs_gym.network.packet_log import PacketLog
from ncs_gym.networked import Networked, VectorNetworked
from ncs_gym.plants.family import family
from ncs_gym.plants.library import cart_pole, truck_trailer
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes.gym_process import GymProcess
from ncs_gym.processes.linearization import linear_model
from ncs_gym.processes.process import FunctionProcess
from ncs_gym.recording import bounds_from_recording
from ncs_gym.registration import register_all, register_plant
from ncs_gym.tasks import Regulation, SetpointTracking, SpeedTracking, Task

__version__ = "0.1.0"


def _renderer(*values: Any) -> Any:
    from ncs_gym.rendering import Renderer  # imported here: most environments draw nothing

    return Renderer(*values)


NCSEnv.renderer_of = staticmethod(_renderer)

register_all()

__all__ = [
    "Actuator",
    "AdversarialDisturbance",
    "Ball",
    "Bounds",
    "Box",
    "BoxDisturbance",
    "BrokenContractWarning",
    "Channel",
    "ChannelContract",
    "Disturbance",
    "Echo",
    "Ellipsoid",
    "ErrorSetError",
    "FunctionProcess",
    "Gaussian",
    "GilbertElliott",
    "GymProcess",
    "Limits",
    "LinearPlant",
    "Model",
    "NCSEnv",
    "NCSVectorEnv",
    "Networked",
    "Packet",
    "PacketLog",
    "RandomChannel",
    "Regulation",
    "RequestActions",
    "SetpointTracking",
    "SinusoidDisturbance",
    "SpeedTracking",
    "Sum",
    "Task",
    "Through",
    "TraceChannel",
    "UnstablePlantError",
    "VectorNetworked",
    "VectorRandomChannel",
    "VectorRequestActions",
    "bounds_from_recording",
    "cart_pole",
    "contract_of",
    "family",
    "linear_model",
    "register_plant",
    "truck_trailer",
]
