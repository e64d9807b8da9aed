"""What really moves: the equations of the linear plant, a function, or another Gymnasium environment.

The certified model stays the linear plant; what a process does beyond it has to lie in the plant's disturbance bound.
"""

from ncs_gym.processes.function_process import FunctionProcess
from ncs_gym.processes.gym_process import GymProcess
from ncs_gym.processes.linear_model import linear_model
from ncs_gym.processes.process import LinearProcess, Process

__all__ = ["FunctionProcess", "GymProcess", "LinearProcess", "Process", "linear_model"]
