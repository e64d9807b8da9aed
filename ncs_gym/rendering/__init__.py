"""Pictures of an environment: the plant, the packets in the network, the phase plane and what the shield does.

An environment with a render mode records every step with a `Renderer`; a shield adds an `Annotation`.
"""

from ncs_gym.rendering.episode_record import Annotation, sent_at
from ncs_gym.rendering.renderer import Renderer

__all__ = ["Annotation", "Renderer", "sent_at"]
