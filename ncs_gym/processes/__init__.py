"""What really moves: the equations of the linear plant, of a member of its family, a function, or other environments.

The certified model stays a linear plant (`linear_model` finds one); what a process does beyond it has to lie in the
plant's disturbance bound.
"""

from ncs_gym.processes.cart_pole_process import CartPoleProcess, nonlinear_cart_pole
from ncs_gym.processes.gym_pendulum import PendulumProcess, pendulum
from ncs_gym.processes.gym_process import GymProcess
from ncs_gym.processes.linearization import linear_model
from ncs_gym.processes.mujoco_pendulum import InvertedPendulumProcess, inverted_pendulum
from ncs_gym.processes.process import FamilyProcess, FunctionProcess, LinearProcess, Process

__all__ = [
    "CartPoleProcess",
    "FamilyProcess",
    "FunctionProcess",
    "GymProcess",
    "InvertedPendulumProcess",
    "LinearProcess",
    "PendulumProcess",
    "Process",
    "inverted_pendulum",
    "linear_model",
    "nonlinear_cart_pole",
    "pendulum",
]
