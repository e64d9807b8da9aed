"""The control loop that settings ask for: a registered environment, its channel, and scenarios of evaluation."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import gymnasium as gym

from agents.loop import LoopConfig
from experiments.settings import id_alone
from ncs_gym import Channel, ChannelContract, GilbertElliott, NCSEnv
from ncs_gym.envs.env import ncs_env
from ncs_gym.network.contract import contract_of
from ncs_gym.registration import needing_extras, registered_ids
from ncs_gym.validation import warn_caller
from shields import Certificate, certificate_for
from shields.verification import require_valid

# Shares of packets that differ by less are the same.
_SHARE = 1e-3


def registered_env(env_id: str) -> NCSEnv:
    """Returns a registered environment that has a plant of its own.

    Args:
        env_id: Id, or "module:id" as Gymnasium takes it, which imports the module: only for ids that the user gave.

    Raises:
        ValueError: If the id is not registered or has no plant of its own, or there is no such module.
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
    """Imports a module of the user's, which registers environments; it may lie in the working directory.

    Raises:
        ValueError: If there is no such module.
    """
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


def loop_config(env_id: str, channel: Mapping[str, Any] | None = None, **kwargs: Any) -> LoopConfig:
    """Returns the bare control loop of a registered environment.

    Args:
        env_id: Id, or "module:id" if the user gave it.
        channel: Changes of the environment's own channel by name; see `changed_channel`.
        **kwargs: Keyword arguments of the environment; None keeps its own.

    Raises:
        ValueError: If the environment is unknown or has no plant of its own, or cannot have the channel.
    """
    registered_env(env_id)
    return with_channel(LoopConfig(env=id_alone(env_id), kwargs=kwargs), channel or {})


def with_channel(loop: LoopConfig, changes: Mapping[str, Any]) -> LoopConfig:
    """Returns a control loop with changes of its channel; for arguments and errors see `changed_channel`."""
    changed = changed_channel(ncs_env(loop.single()).channel, changes)
    return loop if changed is None else loop.with_kwargs(channel=asdict(changed))


def changed_channel(own: Channel, changes: Mapping[str, Any]) -> Channel | None:
    """Returns an environment's own channel with changes; None for no changes.

    Args:
        own: The environment's own channel.
        changes: Fields of `Channel` by name; None keeps a value.

    Raises:
        ValueError: If a name is unknown or a value out of range.
    """
    given = {name: value for name, value in changes.items() if value is not None}
    known = [each.name for each in fields(Channel)]
    for name in given.keys() - set(known):
        raise ValueError(f"--channel {name}: a channel has no such setting; known are {', '.join(known)}")
    changed = replace(own, **given)
    if "loss" in given and "max_consecutive_losses" not in given and (text := fewer_losses(changed)):
        warn_caller(text, UserWarning)
    return None if changed == own else changed


def fewer_losses(channel: Channel) -> str:
    """Returns that a channel loses fewer packets than its losses say, since it loses so many in a row; else nothing."""
    most, wanted = channel.max_consecutive_losses, replace(channel, max_consecutive_losses=None).mean_loss
    if most is None or channel.mean_loss >= wanted - _SHARE:
        return ""
    return (
        f"{channel.mean_loss:.3g} of the packets are lost in the long run, not {wanted:.3g}: the channel loses at most "
        f"{most} in a row"
    )


# The scenario that agents are trained under.
AS_TRAINED = "as trained"


def scenario_named(name: str) -> str:
    """Returns a scenario's name as it is printed; hyphens stand for spaces.

    Raises:
        ValueError: If it is unknown.
    """
    for known in (AS_TRAINED, *_CHANGES):
        if known.replace("-", " ") == name.replace("-", " "):
            return known
    raise ValueError(f"unknown scenario {name!r}; known are {', '.join((AS_TRAINED, *_CHANGES))}")


def other_scenarios(names: Sequence[str]) -> tuple[str, ...]:
    """Returns the different scenarios that are named, without that of the training.

    Raises:
        ValueError: If one is unknown.
    """
    return tuple(dict.fromkeys(name for each in names if (name := scenario_named(each)) != AS_TRAINED))


def under(scenario: str, loop: LoopConfig) -> LoopConfig:
    """Returns a control loop under a scenario; everything else stays the same.

    Raises:
        ValueError: If the scenario is unknown, or the channel cannot be worse within the contract.
    """
    return loop if scenario == AS_TRAINED else _CHANGES[scenario_named(scenario)](loop)


def worse_channel(channel: Channel, contract: ChannelContract | None) -> Channel:
    """Returns a channel on which half of the packets that arrived are lost too, and the others are later.

    All are as late as the latest were, and, as far as a contract allows it, later by one transmission period. Without
    a contract every delay is allowed; with one, losses are where the channel loses packets at all.

    Args:
        channel: The channel that agents were trained with.
        contract: What the certificate assumes of the channel; None for nothing.

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
    """Returns losses that let half as many packets through, in each state of a bursty channel."""
    if isinstance(loss, GilbertElliott):
        return replace(loss, loss_good=_more_loss(loss.loss_good), loss_bad=_more_loss(loss.loss_bad))
    return 0.5 * (1.0 + loss)


def _on_worse_channel(loop: LoopConfig) -> LoopConfig:
    env = ncs_env(loop.single())
    return loop.with_kwargs(channel=asdict(worse_channel(env.channel, env.contract)))


def bursts_at_their_longest(channel: Channel) -> Channel:
    """Returns a channel that loses as many packets in a row as it may, each time; one without losses as it is."""
    return channel if channel.most_consecutive_losses == 0 else replace(channel, loss=1.0)


def _on_ideal_channel(loop: LoopConfig) -> LoopConfig:
    return loop.with_kwargs(channel=asdict(Channel()))


def _attacked(loop: LoopConfig) -> LoopConfig:
    """Returns a loop with the disturbance that does the most harm, noise of full size, and bursts at their longest."""
    worst = bursts_at_their_longest(ncs_env(loop.single()).channel)
    return loop.with_kwargs(disturbance="adversarial", noise="extreme", channel=asdict(worst))


_CHANGES: dict[str, Callable[[LoopConfig], LoopConfig]] = {
    "worst-case disturbance": lambda loop: loop.with_kwargs(disturbance="adversarial"),
    "worse channel": _on_worse_channel,
    "gaussian": lambda loop: loop.with_kwargs(noise="gaussian"),
    "ideal channel": _on_ideal_channel,
    "attacked": _attacked,
    "attacked on an ideal channel": lambda loop: _on_ideal_channel(_attacked(loop)),
}


def certificate_of(loop: LoopConfig, file: Path | None = None, safe_set: str | None = None) -> Certificate:
    """Returns a certificate for the plant of a control loop, under the contract of its channels.

    Args:
        loop: The control loop.
        file: File of the certificate, which is verified; None synthesizes one.
        safe_set: Of one that is synthesized: "polytope", "ellipsoid" or None; see `shields.synthesize`.

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
