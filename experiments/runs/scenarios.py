"""The scenarios under which agents are evaluated, by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace

from agents.loop import LoopConfig
from ncs_gym import Channel, ChannelContract, GilbertElliott
from ncs_gym.envs.env import ncs_env
from ncs_gym.network import contract_of

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

    Args:
        scenario: A name that `scenario_named` returns.
        loop: The control loop as it was in training.

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
