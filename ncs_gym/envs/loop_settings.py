"""What callers give, checked: settings of the control loop, the contracts that they amount to, options of `reset`."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

from ncs_gym import exact
from ncs_gym.ellipsoid import Ellipsoid
from ncs_gym.estimation.error_bound import UnstablePlantError
from ncs_gym.network.channel import Channel, ChannelContract, contract_of
from ncs_gym.network.downlink import DownlinkProtocol, downlink_protocol
from ncs_gym.plants.linear_plant import LinearPlant, weight_of
from ncs_gym.tasks import Task
from ncs_gym.validation import as_numbers, as_vector, shown

T = TypeVar("T")

# Options of `reset` that give channels.
CHANNELS = "channel", "downlink"
# The default start covers this fraction of the half-width of the safe box in every direction.
START_FRACTION = 0.1


def loop_contracts(
    plant: LinearPlant, channel: Channel, contract: Any, downlink: Any, downlink_contract: Any
) -> tuple[ChannelContract | None, DownlinkProtocol, ChannelContract | None]:
    """Returns the contract of the uplink, the protocol of the downlink and the contract of a certificate for both.

    Raises:
        UnstablePlantError: If an unstable plant has neither a contract nor a channel that keeps one.
        ValueError: If the channel rounds more coarsely than the contract allows, or a setting is wrong.
    """
    if contract is None and plant.spectral_radius >= 1.0:
        contract = contract_of(channel)
        if contract is None:
            raise UnstablePlantError(
                f"the plant is unstable (spectral radius {plant.spectral_radius:.6g}), the channel promises nothing: "
                "give it max_consecutive_losses, or the environment contract=ChannelContract(max_age=...)"
            )
    if contract is not None and not expect(contract, ChannelContract, "contract").is_fine_enough_for(channel):
        raise ValueError(
            f"the channel rounds to {channel.quantization_step}, the contract allows {contract.quantization_step}"
        )
    protocol = downlink_protocol(downlink, downlink_contract)
    return contract, protocol, protocol.behind(contract)


def starting_set(initial_set: Ellipsoid | None, plant: LinearPlant) -> Ellipsoid:
    """Returns the ellipsoid that states start in, by default {x : |C x|^2 <= 0.1^2}, and nowhere in what C leaves free.

    C are the rows of the largest symmetric box inside the plant's. States that are past inputs start at the operating
    one.

    Raises:
        ValueError: If it is none, or of another dimension than the plant.
    """
    if initial_set is None:
        nearest = np.abs(plant.box_ends).min(axis=0)
        box = plant.box / np.where(nearest > 0.0, nearest, 1.0)[:, None]  # past inputs that rest at an end start there
        is_bounded, widths = exact.rank(box) == plant.n, plant.half_widths
        gram = (box * widths).T @ (box * widths)
        shape = START_FRACTION**2 * (
            np.linalg.inv(weight_of(box, plant.reach_from_rest))
            if is_bounded
            else np.linalg.pinv(gram) * np.outer(widths, widths)
        )
        past = plant.n - plant.past
        shape[past:], shape[:, past:] = 0.0, 0.0
        return Ellipsoid(shape)
    if expect(initial_set, Ellipsoid, "initial_set").dim != plant.n:
        raise ValueError(f"initial_set must have dimension {plant.n}, got {initial_set.dim}")
    return initial_set


def require_suitable(task: Task, plant: LinearPlant) -> None:
    """Raises ValueError unless a task suits the plant."""
    if problem := task.check(plant):
        raise ValueError(f"{type(task).__name__}: {problem}")
    kind = type(task)
    if kind.observe is not Task.observe and kind.observation_bound is Task.observation_bound:
        raise ValueError(
            f"{kind.__name__}: observe is defined, observation_bound is not: it must return the largest absolute value "
            "of each of these entries within the horizon"
        )


def expect(value: Any, kind: type[T], name: str) -> T:
    """Returns a setting that is of the right kind; raises ValueError if it is not."""
    if not isinstance(value, kind):
        raise ValueError(f"{name} must be of type {kind.__name__}, got {type(value).__name__}")
    return value


def start_option(options: dict[str, Any] | None, plant: LinearPlant) -> np.ndarray | None:
    """Returns options["state"] as a finite array of shape (n,), or None without one; raises ValueError if wrong."""
    options = _known_options(options, {"state", "parameters", *CHANNELS})
    if "state" not in options:
        return None
    return as_vector(options["state"], plant.n, "options['state']")


def vector_reset_options(
    options: dict[str, Any] | None, count: int, plant: LinearPlant
) -> tuple[np.ndarray, np.ndarray | None]:
    """Returns which environments to reset, shape (count,), and where they start, (count, n) or None.

    Raises:
        ValueError: If an option is unknown, has a wrong shape or is not finite.
    """
    options = _known_options(options, {"state", "parameters", "reset_mask", *CHANNELS})
    given = options.get("reset_mask", np.ones(count, np.bool_))
    mask = np.zeros(0, np.bool_) if as_numbers(given) is None else np.array(given)
    if mask.shape != (count,) or mask.dtype != np.bool_ or not mask.any():
        raise ValueError(f"options['reset_mask'] must be bool with shape ({count},), some True, got {shown(given)}")
    if "state" not in options:
        return mask, None
    starts, n = as_numbers(options["state"]), plant.n
    starts = None if starts is None else starts.copy()
    if starts is None or starts.shape not in {(n,), (count, n)} or not np.isfinite(starts).all():
        raise ValueError(f"options['state'] must be finite with shape ({n},) or ({count}, {n}), got {shown(starts)}")
    return mask, np.broadcast_to(starts, (count, n))


def _known_options(options: Any, known: set[str]) -> dict[str, Any]:
    """Returns the options of a reset; an empty dict for None."""
    if options is not None and not isinstance(options, dict):
        raise ValueError(f"the options of reset must be a dict, got {shown(options)}")
    if unknown := [key for key in options or {} if key not in known]:
        raise ValueError(f"reset knows the options {sorted(known)} only, got {shown(unknown)}")
    return options or {}
