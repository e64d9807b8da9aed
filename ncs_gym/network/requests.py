"""Samples that are asked for, and those that a contract needs although nobody asked (docs/requests.md)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ncs_gym.network.channel import Channel, ChannelContract, largest_age
from ncs_gym.validation import shown


def spare_samples(channel: Channel, contract: ChannelContract | None) -> int | None:
    """Returns how many of the samples newer than the newest that arrived may be left out; None for any number.

    It is h - L - delta, with L the longest run of losses and delta the longest delay; zero, so that every sample is
    requested, where the channel keeps no such contract.

    Raises:
        ValueError: If a contract is to be kept by a channel that may lose any number of packets in a row.
    """
    if contract is None:
        return None
    losses = channel.most_consecutive_losses
    if losses is None:
        raise ValueError(
            "samples on request need a channel that promises something: if any number of packets may be lost in a row, "
            f"no rule of requests keeps max_age = {contract.max_age}; give it max_consecutive_losses"
        )
    return max(contract.max_age - losses - channel.longest_delay, 0)


class Requests:
    """The requests of one control loop, or of N: asked for, or forced so that the contract holds for every policy.

    At step k the request of sample k + c + 1 is decided. It is forced if of the samples that are newer than the newest
    that arrived `spare_samples` were left out: n <= age + c + L + delta - h (docs/requests.md, "The rule"). A contract
    that is broken although the samples were requested forces one in every step, until one arrives.

    Args:
        channel: The channel.
        contract: What is to be kept; None if nothing is promised and nothing is forced.
        input_delay: c; the samples of the first c steps are requested by agreement.
        size: N; None for one control loop, whose values are no arrays but numbers.

    Attributes:
        requested: Whether the last decision requests a sample, a bool or shape (N,); False at the start of an episode.
        forced: Whether it does so only because the contract needs it, likewise.

    Raises:
        ValueError: If a contract is to be kept by a channel that may lose any number of packets in a row.
    """

    def __init__(
        self, channel: Channel, contract: ChannelContract | None, input_delay: int = 0, size: int | None = None
    ) -> None:
        self._own_spare, self._contract, self._input_delay = spare_samples(channel, contract), contract, input_delay
        self._shape = () if size is None else (size,)
        # Without a contract it is enough to know which packets may still arrive.
        self._oldest = largest_age(contract, channel.longest_delay)
        self._back = np.arange(input_delay + self._oldest + 1).reshape(-1, *[1] * len(self._shape))
        # A sample as old as the longest delay has arrived, or never will; under a contract all of these count.
        oldest = largest_age(contract, channel.longest_delay - 1)
        self._counts = self._back <= input_delay + oldest
        self.begin()

    def begin(self, chosen: np.ndarray | None = None, channels: Sequence[Channel] | None = None) -> None:
        """Starts episodes, in all environments or in those of a mask (N,).

        One of the channels of all environments from now on, None for that of all, that loses or delays more leaves less
        to spare; one that promises nothing leaves nothing.
        """
        self._spare: Any = self._own_spare
        if self._own_spare is not None and channels is not None:
            spare = np.array([self._spare_with(channel) for channel in channels])
            self._spare = np.minimum(self._own_spare, spare if self._shape else spare.item())
        # Whether the samples of k + c, k + c - 1, ... were requested.
        first = np.zeros((len(self._back), *self._shape), np.bool_)
        first[: self._input_delay] = True
        nothing: Any = np.zeros(self._shape, np.bool_) if self._shape else False
        if chosen is None or chosen.all():
            self._flags, self.requested, self.forced, self._asked = first, nothing, nothing, nothing
        else:
            self._flags = np.where(chosen, first, self._flags)
            self.requested, self.forced, self._asked = (
                each & ~chosen for each in (self.requested, self.forced, self._asked)
            )

    def _spare_with(self, channel: Channel) -> int:
        return 0 if channel.most_consecutive_losses is None else spare_samples(channel, self._contract) or 0

    def ask(self, asked: Any) -> None:
        """Asks for the sample that is decided next, or does not: the last call before `decide` counts.

        Raises:
            ValueError: If what is given is neither a bool nor, for N environments, of shape (N,).
        """
        flags = np.asarray(asked)
        if flags.dtype != np.bool_ or flags.shape not in ((), self._shape):
            wanted = "True or False" + (f", or bool of shape {self._shape}" if self._shape else "")
            raise ValueError(f"a request is {wanted}, got {shown(asked)}")
        self._asked = np.broadcast_to(flags, self._shape).copy() if self._shape else bool(flags)

    def outstanding(self, age: Any) -> Any:
        """Returns n, the number of samples requested that are newer than the newest that arrived, or shape (N,).

        `age` is that of the newest [steps], a number or shape (N,). Without a contract those that cannot arrive any
        more do not count.
        """
        return np.count_nonzero(self._flags & self._counts & (self._back < age + self._input_delay), axis=0)

    def decide(self, age: Any) -> None:
        """Decides the request of sample k + c + 1, given the age of the newest one that arrived, or shape (N,)."""
        asked, needed = self._asked, self._asked & False
        if self._spare is not None:
            needed = (self.outstanding(age) + self._spare <= age + self._input_delay) | (age > self._oldest)
        self.requested = asked | needed if self._shape else bool(asked | needed)
        self.forced = self.requested != asked
        self._flags = np.concatenate([np.asarray(self.requested)[None], self._flags[:-1]])
        self._asked = asked & False

    @property
    def decided(self) -> np.ndarray:
        """Which of the samples k + 1 .. k + c + 1 are requested, shape (c+1,) or (c+1, N), the first is due."""
        return self._flags[self._input_delay :: -1]
