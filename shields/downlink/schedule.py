"""What the actuator applies is compared with what a shield decided for that step."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym.envs.info import Known


def as_decided(known: Known, decided: np.ndarray, due: np.ndarray | None) -> tuple[np.ndarray, Any]:
    """Returns where the input taken is the one decided and, behind a downlink, the one applied the one that was due.

    Args:
        known: Of the innermost environment, after the step.
        decided: Inputs decided in this step, shape (m, N).
        due: Inputs decided for this step, shape (m, N); None without a downlink, where True stands for the second.
    """
    if due is None:
        return (known.applied == decided).all(axis=0), True
    return (known.committed == decided).all(axis=0), (known.applied == due).all(axis=0)
