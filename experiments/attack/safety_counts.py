"""What a campaign counts; sums of counts do not depend on how the work was split."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar

from experiments.analysis.statistics import clopper_pearson


@dataclass(frozen=True, kw_only=True)
class SafetyCounts:
    """Counts of some episodes.

    The claim of mode "lookahead" is the safe box alone: there only violations break an episode. After a channel has
    broken its contract nothing is claimed until the proof holds again; such steps are *lapsed* and counted apart.

    Attributes:
        steps: Number of simulated steps.
        episodes: Number of episodes.
        exits: Number of steps whose true state lay outside S, without lapsed ones.
        violations: Number of steps whose true state lay outside the safe box, without lapsed ones.
        broken_episodes: Number of episodes with an exit or a violation; in mode "lookahead" with a violation.
        interventions: Number of steps in which the shield intervened.
        unproved: Number of steps at which the shield's proof did not hold though the channels kept their contracts.
        level: Largest sqrt(x'Mx) of a true state after `monte_carlo_batch.SETTLING_STEPS`, without lapsed steps; in
            mode "lookahead" the largest |c_j x|.
        planned: Number of steps after whose decision inputs of a certified plan were in store.
        outside_starts: Number of episodes that began outside S, with a certified plan.
        lapsed: Number of lapsed steps.
        lapsed_violations: Number of lapsed steps whose true state lay outside the safe box.
        packets: Number of samples sent.
        forced: Number of steps in which the contract forced a request.
        overdue: Number of steps at which the newest sample was older than a contract allows that the channel keeps.
    """

    files: ClassVar[dict[str, bytes]] = {}  # a batch leaves none
    steps: int = 0
    episodes: int = 0
    exits: int = 0
    violations: int = 0
    broken_episodes: int = 0
    interventions: int = 0
    unproved: int = 0
    level: float = 0.0
    planned: int = 0
    outside_starts: int = 0
    lapsed: int = 0
    lapsed_violations: int = 0
    packets: int = 0
    forced: int = 0
    overdue: int = 0

    def __add__(self, other: SafetyCounts) -> SafetyCounts:
        """Returns the counts of both."""
        sums: dict[str, Any] = {
            each.name: getattr(self, each.name) + getattr(other, each.name) for each in fields(self)
        }
        sums["level"] = max(self.level, other.level)
        return SafetyCounts(**sums)

    @property
    def outcome(self) -> str:
        """How many episodes were broken, in one line; empty if none was."""
        broken = self.broken_episodes
        return f"{broken:,} of {self.episodes:,} episodes left the set or the box" if broken else ""

    @property
    def margin(self) -> float:
        """Smallest 1 - sqrt(x'Mx), or in mode "lookahead" 1 - |c_j x|: the distance from the boundary."""
        return 1.0 - self.level

    @property
    def bound(self) -> float:
        """Upper end of `interval`."""
        return self.interval[1]

    @property
    def interval(self) -> list[float]:
        """Exact 95 % interval of the probability that an episode is broken."""
        return clopper_pearson(self.broken_episodes, self.episodes)

    def document(self) -> dict[str, float]:
        """Returns counts, margin and bound as JSON values."""
        return asdict(self) | {"margin": self.margin, "bound": self.bound}
