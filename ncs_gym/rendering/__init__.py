"""The picture of an environment; pygame is imported when the first frame is drawn, not before."""

from ncs_gym.rendering.annotation import Annotation
from ncs_gym.rendering.film import Film
from ncs_gym.rendering.picture import Picture
from ncs_gym.rendering.scene import Scene, scene_of

__all__ = ["Annotation", "Film", "Picture", "Scene", "scene_of"]
