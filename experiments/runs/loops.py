"""The control loop that a command's settings ask for: a registered environment, with changes of its channel by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from typing import Any

from agents.loop import LoopConfig
from experiments.runs.environments import module_and_id, registered_env
from ncs_gym import Channel, GilbertElliott
from ncs_gym.envs.env import ncs_env


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
    return with_channel(LoopConfig(env=module_and_id(env_id)[1], kwargs=kwargs), channel or {})


def with_channel(loop: LoopConfig, changes: Mapping[str, Any]) -> LoopConfig:
    """Returns a control loop with changes of its channel; for arguments and errors see `changed_channel`."""
    changed = changed_channel(ncs_env(loop.single()).channel, changes)
    return loop if changed is None else loop.with_kwargs(channel=asdict(changed))


def changed_channel(own: Channel, changes: Mapping[str, Any], flag: str = "--channel") -> Channel | None:
    """Returns an environment's own channel with changes; None for no changes.

    Args:
        own: The environment's own channel.
        changes: Fields of `Channel` by name; None keeps a value. `burst_length` is the mean number of packets lost in a
            row (Gilbert-Elliott); losses are independent without it (a mean of 1 / (1 - loss)).
        flag: What the changes were given by, for messages.

    Raises:
        ValueError: If a name is unknown or a value out of range, or bursts are asked for without a loss probability.
    """
    given = {name: value for name, value in changes.items() if value is not None}
    known = [each.name for each in fields(Channel)]
    for name in given.keys() - {*known, "burst_length"}:
        raise ValueError(f"{flag} {name}: a channel has no such setting; known are {', '.join(known)}, burst_length")
    if (length := given.pop("burst_length", None)) is not None:
        loss = given.get("loss", own.loss)
        if isinstance(loss, GilbertElliott):
            raise ValueError(f"{flag} burst_length needs loss, too: the environment's own losses come in bursts")
        given["loss"] = _bursts(loss, length, given.get("send_period", own.send_period))
    changed = replace(own, **given)
    return None if changed == own else changed


def _bursts(loss: float, length: float, send_period: int = 1) -> GilbertElliott:
    """Returns losses of a given probability that come in bursts of a given mean length.

    In the bad state everything is lost. From one packet to the next, M = send_period steps later, it is to be left with
    probability b = 1/length and entered with a = loss b / (1 - loss); the chain moves every step, so its own
    probabilities have the same ratio and the M-th root of the eigenvalue 1 - a - b.

    Args:
        loss: Probability that a packet is lost.
        length: Mean number of packets lost in a row, >= 1; 1 / (1 - loss) if losses were independent.
        send_period: M [steps].

    Raises:
        ValueError: If no such chain exists.
    """
    usable = 0.0 <= loss < 1.0 and 1.0 <= length < float("inf")
    left = 1.0 / length if usable else 0.0
    entered = loss * left / (1.0 - loss) if usable else 2.0
    eigenvalue = 1.0 - left - entered
    if not usable or entered > 1.0 or (eigenvalue < 0.0 and send_period > 1):
        raise ValueError(f"no losses of probability {loss} come in bursts of mean length {length}: try a longer one")
    if send_period > 1:
        factor = (1.0 - eigenvalue ** (1.0 / send_period)) / (left + entered)
        left, entered = factor * left, factor * entered
    return GilbertElliott(p_good_to_bad=entered, p_bad_to_good=left)
