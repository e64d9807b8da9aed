"""Tasks: what an agent is rewarded for, and the perfectly known states that belong to it.

`base_task` has the base class of tasks of your own; the others are regulation, speed tracking and set-point tracking.
"""

from ncs_gym.tasks.base_task import Task
from ncs_gym.tasks.regulation import Regulation
from ncs_gym.tasks.setpoint_tracking import SetpointTracking
from ncs_gym.tasks.speed_tracking import SpeedTracking

# Settings of these are JSON values.
TASKS = (Regulation, SpeedTracking, SetpointTracking)

__all__ = ["TASKS", "Regulation", "SetpointTracking", "SpeedTracking", "Task"]
