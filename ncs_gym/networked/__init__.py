"""The network around any Gymnasium environment, single or vectorized: no model, no estimator, no proof."""

from ncs_gym.networked.wrapper import Networked, VectorNetworked

__all__ = ["Networked", "VectorNetworked"]
