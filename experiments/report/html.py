"""Pages with tables and figures; everything that a template inserts is escaped."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from experiments.analysis.statistics import CONFIDENCE, RESAMPLES
from experiments.plots.figure_style import arm_styles
from experiments.runs.arms import Arm
from shields import Report

# Pixels of a figure per pixel of the page: the widest figures then fill it, and letters have the same size in all.
_PIXEL_RATIO = 2.1
# Bytes of a PNG file that hold the width of the image.
_PNG_WIDTH = slice(16, 20)


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
        shown_settings={name: _text(value) for name, value in _flat(settings).items()},
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
        loader=PackageLoader("experiments.report"),
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


def _text(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(map(str, value)) or "none"
    return "none" if value is None else str(value)


def _decimal(value: float, sign: str = "") -> str:
    return _with_minus(f"{value:{sign}z,.1f}")


def _interval(interval: list[float] | None, sign: str = "") -> str:
    return f"[{_decimal(interval[0], sign)}, {_decimal(interval[1], sign)}]" if interval else "none: one run"


def _with_minus(text: str) -> str:
    return text.replace("-", "\N{MINUS SIGN}")
