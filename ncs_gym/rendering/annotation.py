"""What a wrapper wants to see in the picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ncs_gym.uncertainty.ellipsoid import Ellipsoid


@dataclass(frozen=True, eq=False, kw_only=True)
class Annotation:
    """What a shield knows about the step it is about to take.

    Attributes:
        safe_set: S.
        label: The shield's mode, for the header.
        proposed: The agent's input, shape (m,) [physical units]; None at reset.
        intervened: Whether the shield overrides it.
        interventions: Running number in this episode, this step's included.
        protects: False for a shield that only watches.
    """

    safe_set: Ellipsoid
    label: str
    proposed: np.ndarray | None = None
    intervened: bool = False
    interventions: int = 0
    protects: bool = True
