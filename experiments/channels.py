"""Channels from the command line."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ncs_gym import Channel, GilbertElliott


@dataclass(frozen=True, kw_only=True)
class ChannelSettings:
    """What to change of the environment's own channel.

    Attributes:
        loss: Probability that a packet is lost.
        burst_length: Mean number of packets lost in a row (Gilbert-Elliott); losses are independent without it.
        delay: Steps that every packet is late.
        jitter: Largest extra random delay, in steps.
        send_period: A sample is sent every so many steps.
        quantization_step: Measurements are rounded to multiples of it.
        max_consecutive_losses: Never lose more packets in a row.
    """

    loss: float | None = None
    burst_length: float | None = None
    delay: int | None = None
    jitter: int | None = None
    send_period: int | None = None
    quantization_step: float | None = None
    max_consecutive_losses: int | None = None


def channel_of(settings: ChannelSettings, own: Channel) -> Channel | None:
    """Returns the environment's `own` channel with the changes asked for; None for no changes.

    Raises:
        ValueError: If a value is out of range, or bursts are asked for without a loss probability.
    """
    names = ("delay", "jitter", "send_period", "quantization_step", "max_consecutive_losses")
    changes = {name: getattr(settings, name) for name in names if getattr(settings, name) is not None}
    loss = own.loss if settings.loss is None else settings.loss
    if settings.burst_length is not None:
        if isinstance(loss, GilbertElliott):
            raise ValueError("--channel.burst-length needs --channel.loss: the environment's own losses come in bursts")
        loss = bursts(loss, settings.burst_length)
    if loss != own.loss:
        changes["loss"] = loss
    return replace(own, **changes) if changes else None


def bursts(loss: float, length: float) -> GilbertElliott:
    """Returns losses of a given probability that come in bursts of a given mean length.

    In the bad state everything is lost; it is left with probability 1/length and entered so often that its share is
    `loss`.

    Raises:
        ValueError: If no such chain exists.
    """
    if not 0.0 <= loss < 1.0 or not length >= 1.0 or loss > length * (1.0 - loss):
        raise ValueError(f"no losses of probability {loss} come in bursts of mean length {length}")
    return GilbertElliott(p_good_to_bad=loss / (length * (1.0 - loss)), p_bad_to_good=1.0 / length)
