"""Linear plants behind imperfect networks as Gymnasium environments; importing registers the ids."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ncs_gym.envs.env import NCSEnv
from ncs_gym.estimation.error_bound import ErrorSet, ErrorSetError, UnstablePlantError, certified_error_set
from ncs_gym.estimation.estimator import Estimator
from ncs_gym.network.channel import Channel, GilbertElliott, Packet
from ncs_gym.network.contract import ChannelContract, contract_of
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.plants.truck_trailer import truck_trailer
from ncs_gym.plants.unstable import batch_reactor, cart_pole
from ncs_gym.registration import register_all
from ncs_gym.rendering import Annotation
from ncs_gym.tasks.task import Regulation, SetpointTracking, SpeedTracking, Task
from ncs_gym.uncertainty.disturbance import (
    AdversarialDisturbance,
    BallDisturbance,
    BoxDisturbance,
    Disturbance,
    SinusoidDisturbance,
    SphereDisturbance,
)
from ncs_gym.uncertainty.ellipsoid import Ellipsoid

if TYPE_CHECKING:
    from ncs_gym.envs.vector_env import NCSVectorEnv

register_all()

__all__ = [
    "AdversarialDisturbance",
    "Annotation",
    "BallDisturbance",
    "BoxDisturbance",
    "Channel",
    "ChannelContract",
    "Disturbance",
    "Ellipsoid",
    "ErrorSet",
    "ErrorSetError",
    "Estimator",
    "GilbertElliott",
    "LinearPlant",
    "NCSEnv",
    "NCSVectorEnv",
    "Packet",
    "Regulation",
    "SetpointTracking",
    "SinusoidDisturbance",
    "SpeedTracking",
    "SphereDisturbance",
    "Task",
    "UnstablePlantError",
    "batch_reactor",
    "cart_pole",
    "certified_error_set",
    "contract_of",
    "truck_trailer",
]


def __getattr__(name: str) -> Any:
    """Imports what needs the compiler only when it is asked for."""
    if name == "NCSVectorEnv":
        return import_module("ncs_gym.envs.vector_env").NCSVectorEnv
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
