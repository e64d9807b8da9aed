"""Imperfect networks around any Gymnasium environment, and plants behind them; importing registers the ids."""

from ncs_gym.bounds import Ball, Bounds, Box, Gaussian, Sum, Through
from ncs_gym.envs.env import NCSEnv
from ncs_gym.envs.episode_channels import RandomChannel, VectorRandomChannel
from ncs_gym.envs.request_actions import RequestActions, VectorRequestActions
from ncs_gym.envs.spaces import ClippedObservationWarning
from ncs_gym.envs.vector_env import NCSVectorEnv
from ncs_gym.estimation.error_bound import ErrorSetError, UnstablePlantError, certified_error_set
from ncs_gym.estimation.error_sets import ErrorSet
from ncs_gym.estimation.estimator import Estimator
from ncs_gym.installation import warn_of_overwritten_packages
from ncs_gym.limits import Limits
from ncs_gym.model import Model
from ncs_gym.network.actuator import Actuator, Command, Echo
from ncs_gym.network.channel import Channel, GilbertElliott, Packet, TraceChannel
from ncs_gym.network.contract import BrokenContractWarning, ChannelContract, contract_of
from ncs_gym.network.gaussian_bound import bound_violation_probability
from ncs_gym.network.packet_log import PacketLog
from ncs_gym.network.packet_reception import UnusedPacketsWarning
from ncs_gym.networked import Networked, VectorNetworked
from ncs_gym.plants.batch_reactor import batch_reactor
from ncs_gym.plants.cart_pole import cart_pole
from ncs_gym.plants.convoy import convoy
from ncs_gym.plants.family import family
from ncs_gym.plants.lane_keeping import lane_keeping
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.plants.resting_point import MovedOperatingPointWarning
from ncs_gym.plants.stirred_tank import stirred_tank
from ncs_gym.plants.truck_trailer import truck_trailer
from ncs_gym.processes.gym_process import GymProcess
from ncs_gym.processes.linearization import NoEquilibriumWarning, linear_model
from ncs_gym.processes.process import FamilyProcess, FunctionProcess, LinearProcess, Process
from ncs_gym.recording import RecordedBounds, bounds_from_recording
from ncs_gym.registration import register_all, register_plant
from ncs_gym.rendering import Annotation
from ncs_gym.tasks.base_task import Task
from ncs_gym.tasks.regulation import Regulation
from ncs_gym.tasks.setpoint_tracking import SetpointTracking
from ncs_gym.tasks.speed_tracking import SpeedTracking
from ncs_gym.uncertainty.disturbances import (
    AdversarialDisturbance,
    BallDisturbance,
    BoxDisturbance,
    Disturbance,
    SinusoidDisturbance,
    SphereDisturbance,
)
from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.uncertainty.family import Family
from ncs_gym.uncertainty.remainder import Remainder

__version__ = "0.1.0"

warn_of_overwritten_packages()
register_all()

__all__ = [
    "Actuator",
    "AdversarialDisturbance",
    "Annotation",
    "Ball",
    "BallDisturbance",
    "Bounds",
    "Box",
    "BoxDisturbance",
    "BrokenContractWarning",
    "Channel",
    "ChannelContract",
    "ClippedObservationWarning",
    "Command",
    "Disturbance",
    "Echo",
    "Ellipsoid",
    "ErrorSet",
    "ErrorSetError",
    "Estimator",
    "Family",
    "FamilyProcess",
    "FunctionProcess",
    "Gaussian",
    "GilbertElliott",
    "GymProcess",
    "Limits",
    "LinearPlant",
    "LinearProcess",
    "Model",
    "MovedOperatingPointWarning",
    "NCSEnv",
    "NCSVectorEnv",
    "Networked",
    "NoEquilibriumWarning",
    "Packet",
    "PacketLog",
    "Process",
    "RandomChannel",
    "RecordedBounds",
    "Regulation",
    "Remainder",
    "RequestActions",
    "SetpointTracking",
    "SinusoidDisturbance",
    "SpeedTracking",
    "SphereDisturbance",
    "Sum",
    "Task",
    "Through",
    "TraceChannel",
    "UnstablePlantError",
    "UnusedPacketsWarning",
    "VectorNetworked",
    "VectorRandomChannel",
    "VectorRequestActions",
    "batch_reactor",
    "bound_violation_probability",
    "bounds_from_recording",
    "cart_pole",
    "certified_error_set",
    "contract_of",
    "convoy",
    "family",
    "lane_keeping",
    "linear_model",
    "register_plant",
    "stirred_tank",
    "truck_trailer",
]
