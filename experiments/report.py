"""The results as a reader sees them: tables on a terminal, and a page, into which every text is inserted escaped."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping
from functools import cache
from math import floor, log10
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from experiments.analysis.statistics import CONFIDENCE, RESAMPLES
from experiments.figures import arm_styles
from experiments.runs.arms import Arm
from experiments.runs.loops import AS_TRAINED
from experiments.terminal import text_table, wrapped
from ncs_gym.validation import counted
from shields import Report

# Pixels of a figure per pixel of the page: the widest figures then fill it, and letters have the same size in all.
_PIXEL_RATIO = 2.1
# Bytes of a PNG file that hold the width of the image.
_PNG_WIDTH = slice(16, 20)
_MOST_DECIMALS = 4
# Arms and points whose proof did not hold that are listed.
_MOST_LOST = 6
_Arms = dict[str, dict[str, Any]]


def summary_text(arms: _Arms, baselines: _Arms) -> str:
    """Returns the tables of training and evaluation for a terminal; baselines stand below a rule.

    Violating episodes have their exact interval, the return has Student's (`experiments.analysis.episodes`). "Outside
    S" counts episodes. Scenarios are parts of the table of the evaluation.
    """
    everything = arms | baselines
    trained = {name: arm for name, arm in everything.items() if arm["train_steps"]}
    scenarios = next(iter(arms.values()))["conditions"]
    parts = {AS_TRAINED if scenarios else "": everything}
    parts |= {name: {key: arm | arm["conditions"][name] for key, arm in everything.items()} for name in scenarios}
    columns = _EVALUATION
    if any(arm["mode"] == "lookahead" for arm in everything.values()):
        columns = [*columns[:-1], _PLANNED, columns[-1]]
    evaluated = _text("evaluation", parts, columns, len(arms))
    return f"{_text('training', {'': trained}, _TRAINING)}\n\n{evaluated}" if trained else evaluated


def _text(corner: str, parts: dict[str, _Arms], columns: list[_Column], above: int = 0) -> str:
    """Returns a table with a part per scenario, in which a rule follows `above` arms."""
    first, second = zip(*(header for header, _ in columns), strict=True)
    rows, rules = [[corner, *first], ["", *second]], []
    for title, arms in parts.items():
        rules.append(len(rows))
        rows += [[title]] * bool(title)
        rules.append(len(rows) + above)
        rows += [[name, *(show(arm) for _, show in columns)] for name, arm in arms.items()]
    return text_table(rows, rules)


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


# Two lines of the header of a column, and its text of the summary of an arm.
_Column = tuple[tuple[str, str], Callable[[dict[str, Any]], str]]
_TRAINING: list[_Column] = [
    (("violating", "steps"), lambda arm: f"{arm['train_violation_steps']:,}"),
    (("overridden", "[%]"), lambda arm: _overridden(arm, "train_intervention_rate", "train_mode")),
]
_EVALUATION: list[_Column] = [
    (("violating:", "episodes [%]"), _violating),
    (("", "steps"), lambda arm: f"{arm['eval_violation_steps']:,}"),
    (("outside", "S"), lambda arm: f"{arm['eval_episodes_outside_set']:,}"),
    (("overridden", "[%]"), _overridden),
    (("return", "[95 % CI]"), _return_text),
]
_PLANNED: _Column = (
    ("from a", "plan [%]"),
    lambda arm: f"{100 * arm['plan_rate']:.1f}" if arm["mode"] == "lookahead" else "-",
)


def decimals_of(*numbers: float) -> int:
    """Returns how many decimals to print of numbers that belong together: one, more if the largest is below one."""
    largest = max(map(abs, numbers))
    if largest >= 1.0 or largest == 0.0:
        return 1
    return min(1 - floor(log10(largest)), _MOST_DECIMALS)


def sweep_table(cells: list[dict[str, Any]]) -> str:
    """Returns a row per point of the grid and arm, and below it where proofs did not hold."""
    rows = [["", "", "", "violating", "violating", "", ""]]
    rows += [["loss", "delay", "arm", "episodes", "training", "overridden", "return"]]
    lost = []
    for cell in cells:
        for name, arm in cell["arms"].items():
            rows.append(
                [
                    f"{cell['loss']:g}",
                    f"{cell['delay']}",
                    name,
                    f"{arm['eval_violating_episodes']:,} of {arm['eval_episodes']:,}",
                    f"{arm['train_violation_steps']:,}" if arm["train_steps"] else "-",
                    "-" if arm["mode"] is None else f"{100 * arm['intervention_rate']:.1f} %",
                    f"{arm['eval_return_mean']:z.1f}",
                ]
            )
            held, played = arm["guaranteed_episodes"], arm["eval_episodes"]
            if arm["shielded"] and held < played:
                lost.append(f"{name} at loss {cell['loss']:g}, delay {cell['delay']} ({held:,} of {played:,})")
    table = text_table(rows, rules=(2,), left_columns=0)
    if not lost:
        return table
    more = f" and {counted(len(lost) - _MOST_LOST, 'other')}" if len(lost) > _MOST_LOST else ""
    text = f"The proof held in some evaluation episodes only: {'; '.join(lost[:_MOST_LOST])}{more}."
    return f"{table}\n\n{wrapped(text)}"


def comparison_report(
    summary: dict[str, Any], verification: Report, figures: Mapping[str, tuple[str, bytes]], findings: list[str]
) -> str:
    """Returns the page of `ncs compare`, which opens offline."""
    settings, arms = summary["settings"], summary["arms"] | summary["references"]
    images = {name: _image(caption, png) for name, (caption, png) in figures.items()}
    return _template().render(
        images=images,
        colors={name: style.color for name, style in arm_styles(summary["arms"]).items()},
        percent=f"{100 * CONFIDENCE:.0f}\N{NO-BREAK SPACE}%",
        resamples=RESAMPLES,
        title=f"Safe learning on {settings['env']}",
        runs=max(arm["runs"] for arm in summary["arms"].values()),
        trains=any(arm["train_steps"] for arm in arms.values()),
        findings=findings,
        summary=summary,
        settings=settings,
        shown_settings={name: _setting_text(value) for name, value in _flat(settings).items()},
        verification=verification,
    )


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Returns JSON values by their dotted names, without the objects that hold others."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        found |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return found


@cache
def _template() -> Template:
    environment = Environment(
        loader=PackageLoader("experiments"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "arm_of": Arm.of,
        "combined": lambda first, second: first | second,
        "decimal": _decimal,
        "interval": _interval,
        "signed_count": lambda count: _with_minus(f"{count:+,}"),
        "thousands": lambda count: f"{count:,}",
    }
    return environment.get_template("comparison.html.j2")


def _image(caption: str, png: bytes) -> dict[str, Any]:
    """Returns a figure as a template inserts it; the first sentence of its caption is its title."""
    width = round(int.from_bytes(png[_PNG_WIDTH]) / _PIXEL_RATIO)
    title, data = caption.partition(". ")[0], base64.b64encode(png).decode()
    return {"caption": caption, "title": title, "width": width, "data": data}


def _setting_text(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(map(str, value)) or "none"
    return "none" if value is None else str(value)


def _decimal(value: float, sign: str = "") -> str:
    return _with_minus(f"{value:{sign}z,.1f}")


def _interval(interval: list[float] | None, sign: str = "") -> str:
    return f"[{_decimal(interval[0], sign)}, {_decimal(interval[1], sign)}]" if interval else "none: one run"


def _with_minus(text: str) -> str:
    return text.replace("-", "\N{MINUS SIGN}")
