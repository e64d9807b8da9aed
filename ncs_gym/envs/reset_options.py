"""The options of `reset`, checked."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym.validation import as_numbers, as_vector, shown

CHANNELS = "channel", "downlink"


def start_option(options: dict[str, Any] | None, n: int) -> np.ndarray | None:
    """Returns options["state"] as a finite array of shape (n,), or None without one.

    Raises:
        ValueError: If an option is unknown, has a wrong shape or is not finite.
    """
    options = _known_options(options, {"state", *CHANNELS})
    if "state" not in options:
        return None
    return as_vector(options["state"], n, "options['state']")


def vector_reset_options(options: dict[str, Any] | None, count: int, n: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Returns which environments to reset, shape (count,), and where they start, (count, n) or None.

    Raises:
        ValueError: If an option is unknown, has a wrong shape or is not finite.
    """
    options = _known_options(options, {"state", "reset_mask", *CHANNELS})
    given = options.get("reset_mask", np.ones(count, np.bool_))
    mask = np.zeros(0, np.bool_) if as_numbers(given) is None else np.array(given)
    if mask.shape != (count,) or mask.dtype != np.bool_ or not mask.any():
        raise ValueError(f"options['reset_mask'] must be bool with shape ({count},), some True, got {shown(given)}")
    if "state" not in options:
        return mask, None
    starts = as_numbers(options["state"])
    starts = None if starts is None else starts.copy()
    if starts is None or starts.shape not in {(n,), (count, n)} or not np.isfinite(starts).all():
        raise ValueError(f"options['state'] must be finite with shape ({n},) or ({count}, {n}), got {shown(starts)}")
    return mask, np.broadcast_to(starts, (count, n))


def _known_options(options: Any, known: set[str]) -> dict[str, Any]:
    """Returns the options of a reset; an empty dict for None.

    Raises:
        ValueError: If they are no dict, or have other keys.
    """
    if options is not None and not isinstance(options, dict):
        raise ValueError(f"the options of reset must be a dict, got {shown(options)}")
    if unknown := [key for key in options or {} if key not in known]:
        raise ValueError(f"reset knows the options {sorted(known)} only, got {shown(unknown)}")
    return options or {}
