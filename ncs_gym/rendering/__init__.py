"""Pictures of an environment: the plant, the packets in the network, the phase plane and what the shield does.

An environment with a render mode records every step with a `Renderer`, which reads what happened in loop and guard.
"""

from ncs_gym.rendering.episode_record import Annotation
from ncs_gym.rendering.renderer import Renderer

__all__ = ["Annotation", "Renderer"]
