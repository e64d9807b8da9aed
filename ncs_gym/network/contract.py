"""What a channel promises: how old the newest sample in use may become."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import overload

from ncs_gym.network.channel import Channel
from ncs_gym.validation import ReadOnlyArrays, as_count, as_number, counted, warn_caller

# There is an error set for every age.
MAX_AGE = 1000


class BrokenContractWarning(UserWarning):
    """The channels cannot keep the contract that a certificate assumes, so that its guarantee is likely to be lost."""


@dataclass(frozen=True)
class ChannelContract(ReadOnlyArrays):
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
        self._check(as_count, "max_age", low=0, high=MAX_AGE)
        self._check(as_number, "quantization_step", low=0.0)

    def follows_from(self, other: ChannelContract | None) -> bool:
        """Returns whether whatever keeps another contract keeps this one, too."""
        if other is None:
            return False
        return other.max_age <= self.max_age and other.quantization_step <= self.quantization_step

    def is_kept_by(self, channel: Channel) -> bool:
        """Returns whether a channel can never break this contract."""
        return self.follows_from(contract_of(channel))

    def is_fine_enough_for(self, channel: Channel) -> bool:
        """Returns whether a channel rounds no more coarsely than promised."""
        return channel.quantization_step <= self.quantization_step


def contract_of(channel: Channel) -> ChannelContract | None:
    """Returns the contract that a channel keeps by its settings; None if its age has no limit or exceeds `MAX_AGE`."""
    age = channel.oldest_age
    return None if age is None or age > MAX_AGE else ChannelContract(age, channel.quantization_step)


@overload
def largest_age(contract: ChannelContract | None, without: int) -> int: ...


@overload
def largest_age(contract: ChannelContract | None, without: float = inf) -> float: ...


def largest_age(contract: ChannelContract | None, without: float = inf) -> float:
    """Returns the largest age of the newest sample that a contract allows; without one, another number [steps]."""
    return without if contract is None else contract.max_age


def warn_of_broken_contract(
    contract: ChannelContract | None,
    channel: Channel,
    input_delay: int,
    *,
    counts_losses: bool = False,
) -> None:
    """Warns the caller if a channel cannot keep the contract that a certificate assumes.

    Args:
        contract: That of the certificate; None for none.
        channel: The channel of the samples.
        input_delay: c, the number of steps from a decision to its effect.
        counts_losses: Whether losses and jitter count, as of a real channel. Without them it is warned only of what
            breaks the contract although no packet is lost, rounding included.
    """
    if contract is None:
        return
    if counts_losses and channel.most_consecutive_losses is None:
        warn_caller(
            "the channel may lose any number of packets in a row, but the certificate's contract allows the newest "
            f"sample to be {counted(contract.max_age, 'step')} old in all, so that the guarantee is likely to be "
            "lost",
            BrokenContractWarning,
        )
        return
    kept = contract_of(channel)
    age = kept.max_age if counts_losses and kept is not None else channel.send_period - 1 + channel.delay
    broken = []
    if age + input_delay > contract.max_age:
        later = f", and what is decided takes effect {counted(input_delay, 'step')} later" if input_delay else ""
        allowed = f"but the certificate's contract allows {counted(contract.max_age, 'step')} in all"
        broken.append(f"lets the newest sample become {counted(age, 'step')} old{later}, {allowed}")
    if not contract.is_fine_enough_for(channel):
        allowed = f"but the certificate's contract allows {contract.quantization_step:g}"
        broken.append(f"rounds measurements to {channel.quantization_step:g}, {allowed}")
    if not broken:
        return
    warn_caller(
        f"the channel {', and it '.join(broken)}, so that the guarantee is likely to be lost", BrokenContractWarning
    )
