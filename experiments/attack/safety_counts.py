"""What a campaign counts; sums of counts do not depend on how the work was split."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any

from experiments.analysis.statistics import clopper_pearson


@dataclass(frozen=True, kw_only=True)
class Tally:
    """Counts of some episodes.

    Attributes:
        steps: Taken.
        episodes: Taken.
        exits: Steps whose true state lay outside S.
        violations: Steps whose true state lay outside the safe box.
        broken_episodes: With an exit or a violation.
        interventions: Steps in which the shield intervened.
        unproved: Steps at which the shield's proof did not hold.
        level: Largest sqrt(x'Mx) of a true state, from the step on that `block.SETTLED` says.
    """

    steps: int = 0
    episodes: int = 0
    exits: int = 0
    violations: int = 0
    broken_episodes: int = 0
    interventions: int = 0
    unproved: int = 0
    level: float = 0.0

    def __add__(self, other: Tally) -> Tally:
        """Returns the tally of both."""
        sums: dict[str, Any] = {
            each.name: getattr(self, each.name) + getattr(other, each.name) for each in fields(self)
        }
        sums["level"] = max(self.level, other.level)
        return Tally(**sums)

    @property
    def margin(self) -> float:
        """The smallest 1 - sqrt(x'Mx): how far from the boundary of S, in its own units, states stayed."""
        return 1.0 - self.level

    @property
    def bound(self) -> float:
        """Upper end of the exact 95 % interval of the probability that an episode leaves S or the box."""
        return clopper_pearson(self.broken_episodes, self.episodes)[1]

    def counts(self) -> dict[str, float]:
        """Returns the counts as JSON values."""
        return asdict(self)

    def document(self) -> dict[str, float]:
        """Returns everything as JSON values."""
        return self.counts() | {"margin": self.margin, "bound": self.bound}
