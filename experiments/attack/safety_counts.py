"""What a campaign counts, the tables of it, and whether it is what the shield, or the bound on Gaussian noise, claims.

Sums of counts do not depend on how the work was split.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar

from experiments.analysis.statistics import clopper_pearson, rounded_up
from experiments.errors import SafetyBroken
from experiments.terminal import text_table, wrapped
from ncs_gym.validation import counted

# Episodes start on the boundary of S; the largest level is taken from this step on.
SETTLING_STEPS = 20


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
        level: Largest sqrt(x'Mx) of a true state after `SETTLING_STEPS`, without lapsed steps; in
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

    @classmethod
    def of_json(cls, values: dict[str, Any]) -> SafetyCounts:
        """Returns the counts of what `dataclasses.asdict` made of them."""
        return cls(**values)

    def __add__(self, other: SafetyCounts) -> SafetyCounts:
        sums: dict[str, Any] = {
            each.name: getattr(self, each.name) + getattr(other, each.name) for each in fields(self)
        }
        sums["level"] = max(self.level, other.level)
        return SafetyCounts(**sums)

    @property
    def outcome(self) -> str:
        """How many episodes were broken, in one line; empty if none was."""
        broken = self.broken_episodes
        return f"{broken:,} of {counted(self.episodes, 'episode')} left the set or the box" if broken else ""

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


# Two lines of the header of a column, the tables that have it, and its text.
_Column = tuple[str, str, str, Callable[[SafetyCounts], str]]
_COLUMNS: tuple[_Column, ...] = (
    ("", "episodes", "set box", lambda counts: f"{counts.episodes:,}"),
    ("began", "outside", "box", lambda counts: f"{counts.outside_starts:,}"),
    ("out of", "S", "set", lambda counts: f"{counts.exits:,}"),
    ("out of", "S", "box", lambda counts: f"{counts.exits / counts.steps:.1%}"),
    ("out of", "box", "set box", lambda counts: f"{counts.violations:,}"),
    ("", "failed", "set box", lambda counts: f"{counts.broken_episodes:,}"),
    ("", "p <", "set box", lambda counts: f"{counts.bound:.1e}"),
    ("", "margin", "set box", lambda counts: f"{counts.margin:.1e}" if counts.level > 0.0 else "-"),
    ("", "planned", "box", lambda counts: f"{counts.planned / counts.steps:.1%}"),
    ("over-", "ridden", "set box", lambda counts: f"{counts.interventions / counts.steps:.1%}"),
    ("no", "claim", "lapsed", lambda counts: f"{counts.lapsed / counts.steps:.1%}"),
    ("out of", "box then", "lapsed", lambda counts: f"{counts.lapsed_violations:,}"),
    ("sent", "a step", "requests", lambda counts: f"{counts.packets / counts.steps:.2f}"),
    ("", "forced", "requests", lambda counts: f"{counts.forced / counts.steps:.1%}" if counts.forced else "-"),
)
_OVERRIDDEN = "overridden: steps that the shield changed"
_PROBABILITY = "p <: upper end of the exact 95 % interval of their probability"
_LEGENDS = {
    "set": (
        "out of S, out of box: steps with a true state there",
        "failed: episodes that left S or the box",
        _PROBABILITY,
        f"margin: smallest 1 - level from step {SETTLING_STEPS} on (episodes start on the boundary); the level in S is "
        "max |g x| over the rows g of a polytope, sqrt(x'Mx) in an ellipsoid",
        f"{_OVERRIDDEN} or, unshielded, would have changed",
    ),
    "box": (
        "began outside: episodes that began outside S with a certified plan",
        "out of S: steps there, which lookahead allows; out of box: steps there",
        "failed: episodes that left the box",
        _PROBABILITY,
        f"margin: smallest 1 - |c_j x| from step {SETTLING_STEPS} on",
        "planned: steps with inputs of a certified plan in store",
        _OVERRIDDEN,
    ),
    "lapsed": (
        "no claim: steps from a broken contract on, until the proof holds again, which no failure counts",
        "out of box then: such steps outside the box",
    ),
    "requests": (
        "sent a step: samples",
        "forced: steps in which the contract forced a request that nobody made",
    ),
}
_GAUSSIAN_LEGEND = (
    "failed: episodes that left S or the box",
    "interval: the exact 95 % interval of their probability",
    "bound: the union bound on it over all draws of noise, for the shielded loop; a bound of 1 says nothing (--delta "
    "makes it small)",
)

# What the channels of `attack_cases` do.
_CHANNELS = {
    "its channel": "the environment's own",
    "late": "the oldest sample that the contract allows, at every step",
    "rare": "the longest gap that it allows, every time",
    "on request": "samples where hostile policies ask, seeing the true state, or the contract forces one",
    "perfect": "loses and delays nothing",
    "blackout": "no packet at all",
    "bursts": "losses in a row",
    "overtaking": "packets overtake one another",
}


def counts_table(counts: Mapping[str, SafetyCounts], *, looks_ahead: bool) -> str:
    """Returns the counts as text, with a legend; the sum of all rows stands below a rule.

    Args:
        counts: Counts by the name of their case, "plant, channel"; the rows of a plant stand together.
        looks_ahead: Whether the shield was that of mode "lookahead".
    """
    total = sum(counts.values(), SafetyCounts())
    is_shown = {"set": not looks_ahead, "box": looks_ahead, "lapsed": total.lapsed, "requests": total.forced}
    columns = [column for column in _COLUMNS if any(is_shown[table] for table in column[2].split())]
    rows = [["", *(column[0] for column in columns)], ["case", *(column[1] for column in columns)]]
    plants = {name: name.rpartition(", ")[0] for name in counts}
    for plant in dict.fromkeys(plants.values()):
        rows.append([plant])
        rows += [
            _row(" " + name.rpartition(", ")[2], counts[name], columns) for name in counts if plants[name] == plant
        ]
    rows.append(_row("all", total, columns))
    steps = f"{counted(total.steps, 'step')}, {total.steps // total.episodes} in each episode"
    seen = dict.fromkeys(name.rpartition(", ")[2] for name in counts)
    legend = [f"{kind}: {_CHANNELS[kind]}" for kind in seen if kind in _CHANNELS]
    legend += [text for name, texts in _LEGENDS.items() if is_shown[name] for text in texts]
    if total.forced:
        legend.append(
            f"{counted(total.overdue, 'step')} had a sample older than the contract allows of a channel that keeps it"
        )
    return "\n".join([f"{steps}\n", text_table(rows, rules=(2, len(rows) - 1)), *map(wrapped, legend)])


def _row(name: str, counts: SafetyCounts, columns: Sequence[_Column]) -> list[str]:
    return [name, *(text_of(counts) for *_, text_of in columns)]


def gaussian_table(counts: Mapping[str, SafetyCounts], limits: Mapping[str, float]) -> str:
    """Returns the observed exits of each case, their exact interval and the bound on their probability, as text.

    A legend stands below.
    """
    rows = [["case", "episodes", "failed", "interval", "bound"]]
    for name, case in counts.items():
        low, high = case.interval
        numbers = f"{case.episodes:,}", f"{case.broken_episodes:,}"
        rows.append([name, *numbers, f"[{low:.1e}, {high:.1e}]", rounded_up(limits[name])])
    return "\n".join([text_table(rows), *map(wrapped, _GAUSSIAN_LEGEND)])


def require_within(counts: Mapping[str, SafetyCounts], limits: Mapping[str, float]) -> None:
    """Raises unless no case's exact interval lies above its bound.

    Raises:
        SafetyBroken: If one does: then the bound does not hold, or there is an error of one in forty per case.
    """
    for name, case in counts.items():
        if case.interval[0] > limits[name]:
            raise SafetyBroken(
                f"{name}: {case.broken_episodes:,} of {counted(case.episodes, 'episode')} left S, more than the bound "
                f"{rounded_up(limits[name])} on their probability allows"
            )


def require_safe(total: SafetyCounts, *, looks_ahead: bool) -> None:
    """Raises unless the shield kept what it claims in every step.

    Raises:
        SafetyBroken: If it did not.
    """
    exits = 0 if looks_ahead else total.exits
    if total.overdue:
        raise SafetyBroken(
            f"at {counted(total.overdue, 'step')} the newest sample was older than a contract that was kept"
        )
    if exits or total.violations or total.unproved:
        outside_set = "" if looks_ahead else f"{counted(exits, 'step')} outside S, "
        raise SafetyBroken(f"{outside_set}{total.violations:,} outside the box, {total.unproved:,} without a proof")
