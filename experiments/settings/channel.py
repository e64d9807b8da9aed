"""Settings of the channel: changes of an environment's own channel."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ncs_gym import Channel, GilbertElliott


@dataclass(frozen=True, kw_only=True)
class ChannelSettings:
    """Changes of the environment's own channel; None keeps a value.

    Attributes:
        loss: Probability that a packet is lost.
        burst_length: Mean number of packets lost in a row (Gilbert-Elliott); losses are independent without it
            (a mean of 1 / (1 - loss)).
        delay: Delay of every packet [steps].
        jitter: Largest extra random delay [steps].
        send_period: Transmission period [steps].
        quantization_step: Measurements are quantized to multiples of this step.
        max_consecutive_losses: Longest run of lost packets that the channel allows.
    """

    loss: float | None = None
    burst_length: float | None = None
    delay: int | None = None
    jitter: int | None = None
    send_period: int | None = None
    quantization_step: float | None = None
    max_consecutive_losses: int | None = None

    def applied_to(self, own: Channel) -> Channel | None:
        """Returns the environment's own channel with the changes; None for no changes.

        Raises:
            ValueError: If a value is out of range, or bursts are asked for without a loss probability.
        """
        names = ("delay", "jitter", "send_period", "quantization_step", "max_consecutive_losses")
        changes = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        loss = own.loss if self.loss is None else self.loss
        if self.burst_length is not None:
            if isinstance(loss, GilbertElliott):
                raise ValueError(
                    "--channel.burst-length needs --channel.loss: the environment's own losses come in bursts"
                )
            period = own.send_period if self.send_period is None else self.send_period
            loss = _bursts(loss, self.burst_length, period)
        if loss != own.loss:
            changes["loss"] = loss
        return replace(own, **changes) if changes else None


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
