"""The control loops that a campaign attacks: plants behind channels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import gymnasium as gym
import numpy as np

from experiments.runs.loops import registered_env
from experiments.settings.arguments import id_alone
from ncs_gym import (
    Channel,
    ChannelContract,
    GilbertElliott,
    LinearPlant,
    NCSEnv,
    Process,
    bound_violation_probability,
    exact,
    truck_trailer,
)
from ncs_gym.envs.env import ncs_env
from ncs_gym.network import downlink_protocol
from ncs_gym.registration import ENVIRONMENTS, EPISODE_STEPS, loaded_truck_trailer
from shields import Certificate, certificate_for

# One channel of each kind: no loss, no packet at all, losses in bursts, and packets that overtake one another.
_CHANNELS = {
    "perfect": Channel(),
    "blackout": Channel(loss=1.0),
    "bursts": Channel(loss=GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.1), send_period=2, quantization_step=0.01),
    "overtaking": Channel(loss=0.2, quantization_step=0.01, send_period=2, delay=1, jitter=3),
}
# Left out unless one is asked for: the first has no plant of its own, other environments are stepped one by one in the
# others.
_LEFT_OUT = tuple(f"ncs_gym/{name}-v0" for name in ("LinearNCS", "Pendulum", "InvertedPendulum"))
# Numbers of states, inputs and measurements of the random plants, in turn.
_SIZES = ((2, 1, 2), (2, 2, 1), (3, 2, 3), (4, 1, 4))


@dataclass(frozen=True, eq=False)
class AttackCase:
    """A plant behind a channel.

    Attributes:
        plant: The plant.
        channel: The channel between sensor and estimator.
        contract: Channel contract that the estimator assumes; None for a stable plant.
        process: What really moves; None for the plant's own equations, or those of its family's members.
        downlink: The channel between controller and actuator; None for an ideal one.
        downlink_contract: What is assumed of the downlink; None for nothing.
    """

    plant: LinearPlant
    channel: Channel
    contract: ChannelContract | None = None
    process: Process | None = None
    downlink: Channel | None = None
    downlink_contract: ChannelContract | None = None

    def with_delta(self, delta: float | None) -> AttackCase:
        """Returns the case with a plant whose bounds hold for Gaussian noise at another level; None keeps it."""
        return self if delta is None else replace(self, plant=replace(self.plant, delta=delta))

    def bound_violation_probability(self) -> float:
        """Returns the bound on the probability that Gaussian noise drives an episode out of S."""
        return bound_violation_probability(self.plant, self.channel, EPISODE_STEPS)

    @property
    def certificate_contract(self) -> ChannelContract | None:
        """Contract that the certificate rests on, which counts the steps of both channels; None for a stable plant."""
        return downlink_protocol(self.downlink, self.downlink_contract).behind(self.contract)

    @property
    def keeps_contract(self) -> bool:
        """Whether there is a contract that the channel can never break."""
        return self.contract is not None and self.contract.is_kept_by(self.channel)

    def certificate(self, safe_set: str | None = None) -> Certificate:
        """Returns a certificate for the plant under the contract, synthesized once per process.

        Args:
            safe_set: "polytope", "ellipsoid" or None; see `shields.synthesize`.
        """
        return certificate_for(self.plant, self.certificate_contract, safe_set=safe_set)


@cache
def attack_cases(seed: int, random_plants: int, env_id: str | None = None) -> dict[str, AttackCase]:
    """Returns the cases by name: registered environments, and all kinds of channels for some and random plants.

    Raises:
        ValueError: If there is no environment of that id.
    """
    if env_id is not None:
        env = registered_env(env_id)
        return _env_cases(id_alone(env_id), env, all_channels=env.contract is None)
    found = {}
    for registered in ENVIRONMENTS:
        if registered not in _LEFT_OUT:
            found |= _env_cases(registered.removeprefix("ncs_gym/"), ncs_env(gym.make(registered)))
    plants = {"TruckTrailer-v0": truck_trailer(), "TruckTrailerCruise-v0": loaded_truck_trailer()}
    plants |= {f"random plant {index}": _random_plant(seed, index) for index in range(random_plants)}
    for name, plant in plants.items():
        found |= {f"{name}, {kind}": AttackCase(plant, channel) for kind, channel in _CHANNELS.items()}
    return found


def plant_cases(file: Path, contract: ChannelContract | None) -> dict[str, AttackCase]:
    """Returns the cases of a plant that `LinearPlant.save` wrote: channels that use its contract up, or all kinds.

    Raises:
        ValueError: If the file cannot be read.
    """
    plant, channels = LinearPlant.load(file), _CHANNELS if contract is None else _extremes(contract)
    return {f"{file.name}, {kind}": AttackCase(plant, channel, contract) for kind, channel in channels.items()}


def _env_cases(name: str, env: NCSEnv, *, all_channels: bool = False) -> dict[str, AttackCase]:
    """Returns the cases of an environment: its own channel, those that use its contract up, and all kinds if asked."""
    channels = {"its channel": env.channel} | ({} if env.contract is None else _extremes(env.contract))
    channels |= _CHANNELS if all_channels else {}
    downlink = env.downlink, env.downlink_contract
    cases = {
        kind: AttackCase(env.plant, channel, env.contract, env.process, *downlink) for kind, channel in channels.items()
    }
    return {f"{name}, {kind}": case for kind, case in cases.items()}


def _extremes(contract: ChannelContract) -> dict[str, Channel]:
    """Returns channels that reach the limits of a contract: by delays, by losses, by samples left out."""
    age, step = contract.max_age, contract.quantization_step
    longest_gap = Channel(loss=1.0, max_consecutive_losses=age, quantization_step=step)
    third = {"max_consecutive_losses": age // 3, "delay": age // 3}  # the rest are samples that nobody asks for
    on_request = Channel(loss=1.0, **third, quantization_step=step, on_request=True)
    return {"late": Channel(delay=age, quantization_step=step), "rare": longest_gap, "on request": on_request}


def _random_plant(seed: int, index: int) -> LinearPlant:
    """Returns a stable plant in the unit box whose inputs are so weak that a shield lets some of them through."""
    rng = np.random.default_rng([seed, index])
    n, m, p = _SIZES[index % len(_SIZES)]
    A = rng.standard_normal((n, n))
    A *= rng.uniform(0.4, 0.9) / exact.rounded(np.abs(np.linalg.eigvals(A)).max(), 6)
    return LinearPlant(
        A=A,
        B=rng.standard_normal((n, m)),
        box=np.eye(n),
        u_max=rng.uniform(0.1, 0.5, m),
        dt=0.1,
        gamma=1e-3,
        H=rng.standard_normal((p, n)),
        process_noise_cov=1e-5 * np.eye(n),
        measurement_noise_cov=1e-4 * np.eye(p),
        initial_cov=1e-5 * np.eye(n),
    )
