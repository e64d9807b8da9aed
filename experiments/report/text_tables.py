"""The tables of results on a terminal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import floor, log10
from typing import Any

from experiments.runs.loops import losses_text
from experiments.terminal import text_table, wrapped
from ncs_gym.validation import counted
from shields import Certificate, Report
from shields.certificate_text import size_of

_MOST_DECIMALS = 4
# Arms and points whose proof did not hold that are listed.
_MOST_LOST = 6
# Two lines of the header of what a point of a sweep fixes, by its key.
_SIDES = {
    "loss": ("", "loss"),
    "downlink_loss": ("commands", "lost"),
    "delay": ("", "delay"),
    "quantization_step": ("quanti-", "zation"),
    "burst_length": ("", "burst"),
    "mass_factor": ("", "mass"),
}
# Those that not every environment has.
_OF_SOME = ("downlink_loss", "mass_factor")
_OUTCOMES = (
    ("", "arm"),
    ("violating", "episodes"),
    ("violating", "training"),
    ("over-", "ridden"),
    ("", "return"),
)


_Arms = dict[str, dict[str, Any]]


def summary_text(arms: _Arms, baselines: _Arms) -> str:
    """Returns the tables of training and evaluation for a terminal; baselines stand below a rule.

    Violating episodes have their exact interval, the return has Student's (`experiments.analysis.episodes`). "Outside
    S" counts episodes in which the true state was outside the safe set at some step, be it the first one, "from a plan"
    the steps after whose decision the shield of mode "lookahead" had inputs of a certified plan in store. The training
    of those that were trained has a table of its own.
    """
    everything = arms | baselines
    trained = {name: arm for name, arm in everything.items() if arm["train_steps"]}
    evaluated = _text(everything, len(arms), _EVALUATION)
    return f"{_text(trained, len(trained), _TRAINING)}\n\n{evaluated}" if trained else evaluated


def scenario_text(scenario: str, arms: _Arms, baselines: _Arms) -> str:
    """Returns the table of the evaluation in a scenario, with its name in the corner."""
    played = {name: arm | arm["conditions"][scenario] for name, arm in (arms | baselines).items()}
    return _text(played, len(arms), _EVALUATION, f"{scenario}:")


def _text(arms: _Arms, above: int, columns: list[_Column], corner: str = "") -> str:
    """Returns a table, with a rule below so many arms, and a column of plans if an arm looks ahead."""
    if columns is _EVALUATION and any(arm["mode"] == "lookahead" for arm in arms.values()):
        columns = [*columns[:-1], _PLANNED, columns[-1]]
    titles = list(zip(*(header for header, _ in columns), strict=True))
    first = ["" if corner and title.endswith(":") else title for title in titles[0]]
    rows = [[corner, *first], *(["", *line] for line in titles[1:])]
    rows += [[name, *(show(arm) for _, show in columns)] for name, arm in arms.items()]
    return text_table(rows, rules=(len(titles), len(titles) + above))


def _overridden(arm: dict[str, Any], key: str = "intervention_rate", mode: str = "mode") -> str:
    """Returns a rate of interventions; in brackets what a monitor would have done."""
    text = f"{100 * arm[key]:.1f}"
    return {"monitor": f"({text})", None: "-"}.get(arm[mode], text)


def _violating(arm: dict[str, Any]) -> str:
    low, high = arm["eval_violation_rate_ci95"]
    return f"{100 * arm['eval_violation_rate']:.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def _return_text(arm: dict[str, Any]) -> str:
    """Returns mean and half-width of Student's interval, which is symmetric."""
    interval, mean = arm["eval_return_ci95"], arm["eval_return_mean"]
    if interval is None:
        return f"{mean:z.{decimals_of(mean)}f} [n/a]"
    half = 0.5 * (interval[1] - interval[0])
    decimals = decimals_of(mean, half)
    return f"{mean:z.{decimals}f} +-{half:.{decimals}f}"


# Three lines of the header of a column, and its text of the summary of an arm.
_Column = tuple[tuple[str, str, str], Callable[[dict[str, Any]], str]]
_TRAINING: list[_Column] = [
    (("training:", "violating", "steps"), lambda arm: f"{arm['train_violation_steps']:,}"),
    (("over-", "ridden", "[%]"), lambda arm: _overridden(arm, "train_intervention_rate", "train_mode")),
]
_EVALUATION: list[_Column] = [
    (("evaluation:", "violating:", "episodes [%]"), _violating),
    (("", "", "steps"), lambda arm: f"{arm['eval_violation_steps']:,}"),
    (("out-", "side", "S"), lambda arm: f"{arm['eval_episodes_outside_set']:,}"),
    (("over-", "ridden", "[%]"), _overridden),
    (("", "return", "[95 % CI]"), _return_text),
]
_PLANNED: _Column = (
    ("from a", "plan", "[%]"),
    lambda arm: f"{100 * arm['plan_rate']:.1f}" if arm["mode"] == "lookahead" else "-",
)


def decimals_of(*numbers: float) -> int:
    """Returns how many decimals to print of numbers that belong together: one, more if the largest is below one."""
    largest = max(map(abs, numbers))
    if largest >= 1.0 or largest == 0.0:
        return 1
    return min(1 - floor(log10(largest)), _MOST_DECIMALS)


def sweep_table(cells: list[dict[str, Any]]) -> str:
    """Returns a row per point of the grid and arm, below a line that says what all points have in common."""
    swept = [side for side in _SIDES if len({cell[side] for cell in cells}) > 1]
    fixed = [side for side in _SIDES if side not in swept and (side not in _OF_SOME or cells[0][side] is not None)]
    common = [f"{_name(side)} {_side_text(side, cells[0][side])}" for side in fixed]
    if steps := max(arm["train_steps"] for cell in cells for arm in cell["arms"].values()):
        common.append(f"{steps:,} training steps per arm")
    rows = [list(line) for line in zip(*(_SIDES[side] for side in swept), *_OUTCOMES, strict=True)]
    for cell in cells:
        point = [_side_text(side, cell[side]) for side in swept]
        rows += [[*point, name, *_outcome(arm)] for name, arm in cell["arms"].items()]
    table = text_table(rows, rules=(2,), left_columns=0, keys=len(swept) + 1)
    above = [f"in all rows: {', '.join(common)}"] if common else []
    below = [text for text in (proofs_text(cells), losses_text(cells)) if text]
    return "\n\n".join([*map(wrapped, above), table, *map(wrapped, below)])


def proofs_text(cells: Sequence[dict[str, Any]]) -> str:
    """Returns where the proof of a shield did not hold in all evaluation episodes, in a sentence; nothing if it did."""
    swept = [side for side in _SIDES if len({cell.get(side) for cell in cells}) > 1]
    lost = []
    for cell in cells:
        point = ", ".join(f"{_name(side)} {_side_text(side, cell[side])}" for side in swept)
        for name, arm in cell["arms"].items():
            held, played = arm["guaranteed_episodes"], arm["eval_episodes"]
            if arm["shielded"] and held < played:
                lost.append(f"{name}{' at ' + point if point else ''} ({held:,} of {played:,})")
    if not lost:
        return ""
    more = f" and {counted(len(lost) - _MOST_LOST, 'other')}" if len(lost) > _MOST_LOST else ""
    return f"The proof held in some evaluation episodes only: {'; '.join(lost[:_MOST_LOST])}{more}."


def _name(side: str) -> str:
    first, second = _SIDES[side]
    return f"{first.removesuffix('-')}{'' if first.endswith('-') else ' '}{second}".strip()


def _side_text(side: str, value: float | None) -> str:
    """Returns what a point fixes as text; without a value it is the environment's own."""
    if value is None:
        return "own"
    return "none" if side == "burst_length" and not value else f"{value:g}"


def _outcome(arm: dict[str, Any]) -> list[str]:
    return [
        f"{arm['eval_violating_episodes']:,} of {arm['eval_episodes']:,}",
        f"{arm['train_violation_steps']:,}" if arm["train_steps"] else "-",
        "-" if arm["mode"] is None else f"{100 * arm['intervention_rate']:.1f} %",
        f"{arm['eval_return_mean']:z.1f}",
    ]


def certificate_line(certificate: Certificate, verification: Report) -> str:
    """Returns one line about a certificate and its exact verification."""
    size = size_of(certificate)
    conditions = f"certificate: {len(verification.conditions)} conditions hold in exact arithmetic"
    return f"{conditions} ({size})" if size else conditions
