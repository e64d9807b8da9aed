"""What a channel promises: how old the newest sample in use may become."""

from __future__ import annotations

from dataclasses import dataclass

from ncs_gym.network.channel import Channel
from ncs_gym.validation import as_count, as_number

# There is an error set for every age.
MAX_AGE = 1000


@dataclass(frozen=True)
class ChannelContract:
    """At every step the newest sample used is at most `max_age` steps old (docs/contracts.md).

    The first estimate counts as a sample at step 0. For an unstable plant an error bound exists only under such a
    promise; for a stable one it makes the bound smaller.

    Attributes:
        max_age: h, 0 to 1000 [steps].
        quantization_step: The coarsest rounding of a measurement, in the units of y.

    Raises:
        ValueError: If a value is out of range.
    """

    max_age: int
    quantization_step: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "max_age", as_count(self.max_age, "max_age", low=0, high=MAX_AGE))
        step = as_number(self.quantization_step, "quantization_step", low=0.0)
        object.__setattr__(self, "quantization_step", step)

    def is_kept_by(self, channel: Channel) -> bool:
        """Returns whether a channel can never break this contract."""
        promised = contract_of(channel)
        return promised is not None and promised.max_age <= self.max_age and self.is_fine_enough_for(channel)

    def is_fine_enough_for(self, channel: Channel) -> bool:
        """Returns whether a channel rounds no more coarsely than promised."""
        return channel.quantization_step <= self.quantization_step


def contract_of(channel: Channel) -> ChannelContract | None:
    """Returns the contract a channel keeps by its settings: h = (l+1) M + delay - 1.

    None if it may lose for ever, or for so long that it is as good as that.

    With a sample every M steps, at most l losses in a row and a longest delay of `delay` steps: among l+1 consecutive
    samples one arrives, so at every step a sample at most (l+1) M - 1 + delay steps old has arrived.
    """
    losses = channel.most_consecutive_losses
    if losses is None:
        return None
    age = (losses + 1) * channel.send_period + channel.longest_delay - 1
    return ChannelContract(age, channel.quantization_step) if age <= MAX_AGE else None
