"""The control loop as a Gymnasium environment: `env` for one loop, `vector_env` for many at once.

Both compose the same parts; spaces, reset options and the keys of `info` are written once.
"""

from ncs_gym.envs.env import NCSEnv
from ncs_gym.envs.vector_env import NCSVectorEnv

__all__ = ["NCSEnv", "NCSVectorEnv"]
