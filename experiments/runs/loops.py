"""The control loop that settings ask for: a registered environment, its channel, and scenarios of evaluation."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym

from agents.loop import LoopConfig
from experiments.settings import id_alone
from ncs_gym import Channel, ChannelContract, GilbertElliott, LinearPlant, NCSEnv
from ncs_gym.envs.env import ncs_env
from ncs_gym.network.channel import contract_of
from ncs_gym.registration import needing_extras, registered_ids
from ncs_gym.validation import warn_caller
from shields import Certificate, certificate_for
from shields.verification import require_valid

# Shares of packets that differ by less are the same.
_SHARE = 1e-3


def registered_env(env_id: str) -> NCSEnv:
    """Returns a registered environment; raises ValueError if there is none of that id with a plant of its own.

    The id may be "module:id", which imports the module: only for ids that the user gave.
    """
    module, _, name = env_id.rpartition(":")
    if module:
        import_module(module)
        if name not in gym.registry:
            raise ValueError(f"module {module!r} registers no environment {name!r}")
    elif name not in registered_ids() and name not in needing_extras():
        if name in gym.registry:
            raise ValueError(
                f"{env_id} has no plant of its own: register_plant makes an id of yours (--env module:id), some "
                "commands take the file of a plant (--plant), and ncs_gym.Networked puts a network without a shield "
                "around any environment"
            )
        raise ValueError(
            f"unknown environment {env_id!r}; known are {', '.join(registered_ids())}, and --env module:id imports the "
            "module that registers one of your own"
        )
    return ncs_env(gym.make(name))


def import_module(module: str) -> None:
    """Imports a module of the user's, also of the working directory; raises ValueError if there is none."""
    if not all(part.isidentifier() for part in module.split(".")):
        raise ValueError(f"--env module:id needs the name of a module, got {module!r}")
    folder = os.getcwd()
    if folder not in sys.path:
        sys.path.append(folder)  # last, so that no file there stands in for an installed module
    try:
        importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # something that the module itself imports is missing
        raise ValueError(f"there is no module {module!r}, neither installed nor in {folder}") from error


class PlantInUse(NamedTuple):
    """A plant, and what is known of the environment that it is in, if it is in one."""

    origin: str  # id of the environment, or the plant's file
    plant: LinearPlant
    contract: ChannelContract | None = None  # of the environment's certificates
    input_delay: int = 0  # steps by which inputs are committed ahead
    asks: bool = False  # whether samples are taken on request


def plant_in_use(env_id: str, file: Path | None) -> PlantInUse:
    """Returns the plant of a file, otherwise that of an environment; for errors see `registered_env`."""
    if file is not None:
        return PlantInUse(str(file), LinearPlant.load(file))
    env = registered_env(env_id)
    delay = env.downlink_protocol.input_delay
    return PlantInUse(env_id, env.plant, env.certificate_contract, delay, env.channel.on_request)


def loop_config(env_id: str, channel: Mapping[str, Any] | None = None, **kwargs: Any) -> LoopConfig:
    """Returns the bare control loop of a registered environment with changes of its channel and its keyword arguments.

    None keeps the environment's own. For errors see `registered_env` and `changed_channel`.
    """
    registered_env(env_id)
    return with_channel(LoopConfig(env=id_alone(env_id), kwargs=kwargs), channel or {})


def with_channel(loop: LoopConfig, changes: Mapping[str, Any]) -> LoopConfig:
    """Returns a control loop with changes of its channel; see `changed_channel`."""
    changed = changed_channel(ncs_env(loop.single()).channel, changes)
    return loop if changed is None else _on(loop, changed)


def changed_channel(own: Channel, changes: Mapping[str, Any]) -> Channel | None:
    """Returns an environment's own channel with changes of its fields, of which None changes nothing; else None.

    Raises:
        ValueError: If a name is unknown or a value out of range.
    """
    given = {name: value for name, value in changes.items() if value is not None}
    known = [each.name for each in fields(Channel)]
    for name in given.keys() - set(known):
        raise ValueError(f"--channel {name}: a channel has no such setting; known are {', '.join(known)}")
    changed = replace(own, **given)
    most, wanted = changed.max_consecutive_losses, replace(changed, max_consecutive_losses=None).mean_loss
    is_asked = "loss" in given and "max_consecutive_losses" not in given
    if is_asked and most is not None and changed.mean_loss < wanted - _SHARE:
        warn_caller(
            f"{changed.mean_loss:.3g} of the packets are lost in the long run, not {wanted:.3g}: the channel loses at "
            f"most {most} in a row",
            UserWarning,
        )
    return None if changed == own else changed


# The scenario that agents are trained under.
AS_TRAINED = "as trained"


def scenario_named(name: str) -> str:
    """Returns a scenario's name as it is printed, with spaces for hyphens; raises ValueError if it is unknown."""
    for known in (AS_TRAINED, *_CHANGES):
        if known.replace("-", " ") == name.replace("-", " "):
            return known
    raise ValueError(f"unknown scenario {name!r}; known are {', '.join((AS_TRAINED, *_CHANGES))}")


def other_scenarios(names: Sequence[str]) -> tuple[str, ...]:
    """Returns the different scenarios that are named, without that of the training; see `scenario_named`."""
    return tuple(dict.fromkeys(name for each in names if (name := scenario_named(each)) != AS_TRAINED))


def under(scenario: str, loop: LoopConfig) -> LoopConfig:
    """Returns a control loop under a scenario; raises ValueError if it is unknown or impossible there."""
    return loop if scenario == AS_TRAINED else _CHANGES[scenario_named(scenario)](loop)


def worse_channel(channel: Channel, contract: ChannelContract | None) -> Channel:
    """Returns a channel that loses half of the packets that arrived, and delays the others more.

    All are as late as the latest were, and, as far as the certificate's contract allows it, later by one transmission
    period. Without a contract every delay is allowed; with one, a channel without losses stays without.

    Raises:
        ValueError: If there is no worse channel within the contract.
    """
    later = channel.send_period
    promised = contract_of(channel)
    if contract is not None:
        later = max(0, min(later, contract.max_age - promised.max_age)) if promised is not None else 0
    loses = contract is None or channel.most_consecutive_losses != 0
    worse = replace(
        channel,
        loss=_more_loss(channel.loss) if loses else channel.loss,
        delay=channel.longest_delay + later,
        jitter=0,
    )
    if worse == channel or (contract is not None and not contract.is_kept_by(worse)):
        raise ValueError(f"no channel within the contract is worse than {channel}")
    return worse


def _more_loss(loss: float | GilbertElliott) -> float | GilbertElliott:
    if isinstance(loss, GilbertElliott):
        return replace(loss, loss_good=_more_loss(loss.loss_good), loss_bad=_more_loss(loss.loss_bad))
    return 0.5 * (1.0 + loss)


def _on(loop: LoopConfig, channel: Channel) -> LoopConfig:
    return loop.with_kwargs(channel=asdict(channel))


def _worsened(loop: LoopConfig) -> LoopConfig:
    env = ncs_env(loop.single())
    return _on(loop, worse_channel(env.channel, env.contract))


def _attacked(loop: LoopConfig) -> LoopConfig:
    """Returns a loop with the disturbance that does the most harm, noise of full size, and bursts at their longest."""
    own = ncs_env(loop.single()).channel
    worst = own if own.most_consecutive_losses == 0 else replace(own, loss=1.0)
    return _on(loop.with_kwargs(disturbance="adversarial", noise="extreme"), worst)


_CHANGES: dict[str, Callable[[LoopConfig], LoopConfig]] = {
    "worst-case disturbance": lambda loop: loop.with_kwargs(disturbance="adversarial"),
    "worse channel": _worsened,
    "gaussian": lambda loop: loop.with_kwargs(noise="gaussian"),
    "ideal channel": lambda loop: _on(loop, Channel()),
    "attacked": _attacked,
    "attacked on an ideal channel": lambda loop: _on(_attacked(loop), Channel()),
}


def certificate_of(loop: LoopConfig, file: Path | None = None, safe_set: str | None = None) -> Certificate:
    """Returns a certificate for the plant of a control loop, under the contract of its channels.

    It is read from a file and verified, or for None made with a `safe_set` (see `shields.certificate_for`).

    Raises:
        ValueError: If the environment cannot have its keyword arguments.
        CertificateError: If a given certificate is damaged or does not verify for the plant.
        Infeasible: If no certificate is found.
    """
    env = ncs_env(loop.single())
    if file is None:
        return certificate_for(env.plant, env.certificate_contract, safe_set)
    certificate = Certificate.load(file)
    require_valid(certificate, env.plant)
    return certificate
