"""The numbers of a report's tables, as text with intervals."""

from __future__ import annotations

from html import escape
from typing import Any

from experiments.analysis.statistics import CONFIDENCE
from experiments.plots.arm_style import LOOKS, style_of
from experiments.report.html import Markup, table
from experiments.runs.arms import PENALTY

# With a space that does not break.
PERCENT = f"{100 * CONFIDENCE:.0f}\N{NO-BREAK SPACE}%"

Summaries = dict[str, dict[str, Any]]


def safety_table(arms: Summaries, references: Summaries) -> str:
    """Returns violations and interventions of each arm, below a rule those of the reference policies."""
    head = [
        "",
        "violating steps in training",
        "overridden in training",
        Markup(
            f'violating episodes<br>in evaluation<br><span class="whole">[Clopper\N{EN DASH}Pearson {PERCENT}]</span>'
        ),
        "violating steps, true state",
        "violating steps, estimate",
        "overridden in evaluation",
        "episodes in which the proof held",
    ]
    rows = [[arm_name(name), *safety_cells(arm)] for name, arm in (arms | references).items()]
    return table("Violations and interventions of each arm", head, rows, rules=[len(arms)])


def return_table(arms: Summaries, references: Summaries) -> str:
    """Returns mean and interquartile mean of the return with intervals."""
    head = [
        "",
        "mean return",
        f"Student's {PERCENT}",
        f"bootstrap {PERCENT}",
        "interquartile mean",
        f"its bootstrap {PERCENT}",
        "intervals over",
        "returns of the runs",
    ]
    rows = [
        [
            arm_name(name),
            _number(arm["eval_return_mean"]),
            interval_text(arm["eval_return_ci95"]),
            interval_text(arm["eval_return_bootstrap_ci95"]),
            _number(arm["eval_return_iqm"]),
            interval_text(arm["eval_return_iqm_bootstrap_ci95"]),
            _count(arm),
            Markup(f'<span class="list">{", ".join(_number(value) for value in arm["eval_return_by_run"])}</span>'),
        ]
        for name, arm in (arms | references).items()
    ]
    return table("Return of each arm", head, rows, rules=[len(arms)])


def difference_table(paired: dict[str, Any]) -> str:
    """Returns how much more each arm has than the baseline in runs with equal numbers; nothing for a single arm."""
    if not paired["arms"]:
        return ""
    head = [
        f"minus {paired['baseline']}",
        "return, mean of differences",
        f"Student's {PERCENT}",
        f"bootstrap {PERCENT}",
        "violating episodes",
        "by run",
    ]
    rows = [
        [
            arm_name(name),
            _number(difference["return_mean"], sign="+"),
            interval_text(difference["return_ci95"], sign="+"),
            interval_text(difference["return_bootstrap_ci95"], sign="+"),
            _minus(f"{difference['violating_episodes']:+,}"),
            Markup(f'<span class="list">{_counts(difference["violating_episodes_by_run"])}</span>'),
        ]
        for name, difference in paired["arms"].items()
    ]
    return table("Paired differences", head, rows)


def safety_cells(arm: dict[str, Any]) -> list[str]:
    """Returns the cells of an arm in `safety_table`, without its name."""
    trained = arm["train_steps"]
    return [
        f"{arm['train_violation_steps']:,} of {trained:,}" if trained else "\N{EN DASH}",
        overridden_text(arm, "train_intervention_rate") if trained else "\N{EN DASH}",
        violating_text(arm),
        f"{arm['eval_violation_steps']:,}",
        f"{arm['eval_estimate_violation_steps']:,}",
        overridden_text(arm, "intervention_rate"),
        f"{arm['guaranteed_episodes']:,} of {arm['eval_episodes']:,}" if arm["shielded"] else "\N{EN DASH}",
    ]


def arm_name(name: str) -> str:
    """Returns an arm's name with the color it has in figures; other names alone."""
    if name.removesuffix(PENALTY) not in LOOKS:
        return name
    swatch = f'<span class="swatch" style="background:{style_of(name).color}"></span>'
    # Where a phone may break it.
    broken = escape(name).replace(":", ":<wbr>").replace("+", "<wbr>+")
    return Markup(f"{swatch}<strong>{broken}</strong>")


def violating_text(arm: dict[str, Any]) -> str:
    """Returns how many episodes violated, and the probability's interval; after none, what it is at most."""
    low, high = (100.0 * bound for bound in arm["eval_violation_rate_ci95"])
    rate = f"{100.0 * arm['eval_violation_rate']:.1f} % [{low:.1f}, {high:.1f}]"
    share = rate if arm["eval_violating_episodes"] else f"0 %, at most {high:.2f} %"
    count = f"{arm['eval_violating_episodes']:,} of {arm['eval_episodes']:,}"
    return Markup(f'{count}<span class="interval">{share}</span>')


def overridden_text(arm: dict[str, Any], key: str) -> str:
    """Returns a rate of interventions; in brackets what a monitor would have done."""
    text = f"{100 * arm[key]:.1f} %"
    return {"monitor": f"({text})", None: "\N{EN DASH}"}.get(arm["mode"], text)


def interval_text(interval: list[float] | None, sign: str = "") -> str:
    """Returns an interval, or that there is none."""
    return f"[{_number(interval[0], sign)}, {_number(interval[1], sign)}]" if interval else "none: one run"


def return_text(arm: dict[str, Any]) -> str:
    """Returns the mean return with Student's interval."""
    interval = interval_text(arm["eval_return_ci95"])
    return Markup(f'{_number(arm["eval_return_mean"])}<span class="interval">{escape(interval)}</span>')


def _count(arm: dict[str, Any]) -> str:
    if arm["eval_return_ci95_over"] == "episodes":
        return f"{arm['eval_episodes']:,} episodes"
    return f"{arm['runs']:,} {'run' if arm['runs'] == 1 else 'runs'}"


def _counts(values: list[int]) -> str:
    return _minus(", ".join(f"{value:+,}" for value in values))


def _number(value: float, sign: str = "") -> str:
    return _minus(f"{value:{sign},.1f}")


def _minus(text: str) -> str:
    return text.replace("-", "\N{MINUS SIGN}")
