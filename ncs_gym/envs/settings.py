"""Settings of the control loop: what they must be, and the contracts of its two channels that they amount to."""

from __future__ import annotations

from typing import Any, TypeVar

from ncs_gym.envs.spaces import default_initial_set
from ncs_gym.estimation.error_bound import UnstablePlantError
from ncs_gym.network.channel import Channel
from ncs_gym.network.contract import ChannelContract, contract_of
from ncs_gym.network.downlink import DownlinkProtocol, downlink_protocol
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes.process import LinearProcess, Process
from ncs_gym.tasks.task import Task
from ncs_gym.uncertainty.ellipsoid import Ellipsoid

T = TypeVar("T")


def _assumed_contract(plant: LinearPlant, channel: Channel, contract: ChannelContract | None) -> ChannelContract | None:
    """Returns the contract that the estimator's error sets rest on.

    Raises:
        UnstablePlantError: If an unstable plant has neither a contract nor a channel that keeps one.
        ValueError: If the channel rounds more coarsely than the contract allows.
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
    return contract


def loop_contracts(
    plant: LinearPlant, channel: Channel, contract: Any, downlink: Any, downlink_contract: Any
) -> tuple[ChannelContract | None, DownlinkProtocol | None, ChannelContract | None]:
    """Returns the contract of the uplink, the protocol of the downlink and the contract of a certificate for both.

    The certificate's also counts the steps between a decision and its effect.

    Raises:
        UnstablePlantError: If an unstable plant has neither a contract nor a channel that keeps one.
        ValueError: If the channel rounds more coarsely than the contract allows, or a setting is wrong.
    """
    assumed = _assumed_contract(plant, channel, contract)
    protocol = downlink_protocol(downlink, downlink_contract)
    return assumed, protocol, assumed if protocol is None else protocol.behind(assumed)


def starting_set(initial_set: Ellipsoid | None, plant: LinearPlant) -> Ellipsoid:
    """Returns the ellipsoid that states start in, the default one for None.

    Raises:
        ValueError: If it is none, or of another dimension than the plant.
    """
    chosen = default_initial_set(plant) if initial_set is None else expect(initial_set, Ellipsoid, "initial_set")
    if chosen.dim != plant.n:
        raise ValueError(f"initial_set must have dimension {plant.n}, got {chosen.dim}")
    return chosen


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


def require_own_equations(process: Process | None, plant: LinearPlant) -> None:
    """Raises ValueError if times between samples are to count of a process whose states there nobody knows."""
    if plant.between_samples is not None and not (process is None or isinstance(process, LinearProcess)):
        raise ValueError(
            "between_samples is about the plant's own equations: beside another process= give a plant without it"
        )


def expect(value: Any, kind: type[T], name: str) -> T:
    """Returns a setting that is of the right kind.

    Raises:
        ValueError: If it is not.
    """
    if not isinstance(value, kind):
        raise ValueError(f"{name} must be of type {kind.__name__}, got {type(value).__name__}")
    return value
