"""The figures of a study, from the numbers that pages show."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from experiments.plots.arm_style import ArmStyle
from experiments.plots.figure_style import STYLE, CaptionedFigure, label, legend_below, thousands
from experiments.study.channel_sweep import FILTERS_BY_COUNT

# Axis labels of the sides of the sweep of channels.
_SIDES = {"loss": "packet loss probability", "delay": "delay [steps]", "quantization_step": "quantization step"}
# What the rows of its figures count, and what acts there.
_COUNTS = {"outside_set": "episodes that left S [%]", "violating": "episodes outside the box [%]"}
_ROWS = {"outside_set": "behind the one-step filter", "violating": "behind lookahead"}
# Color of what stands for all arms in a legend.
_ANY_ARM = "#222222"
# What stands before the filter in the names of the arms of each figure.
_REGULATOR, _AGENTS = "lqr+", ""


def study_figures(summary: dict[str, Any]) -> dict[str, tuple[str, bytes]]:
    """Returns caption and PNG file of every figure by name.

    Args:
        summary: What `page_summary` returns, with the rows of the sweep under "channels" by environment.
    """
    figures = {}
    for name, rows in summary["channels"].items():
        of_agents = [row for row in rows if not row["arm"].startswith(_REGULATOR)]
        figures[f"trusting-{name}"] = sweep_figure(name, [row for row in rows if row not in of_agents])
        if of_agents:
            figures[f"trusting-agents-{name}"] = sweep_figure(name, of_agents)
    figures |= {"return": return_figure(summary), "training": training_figure(summary)}
    return {name: (figure.caption, figure.png) for name, figure in figures.items()}


def sweep_figure(name: str, rows: list[dict[str, Any]]) -> CaptionedFigure:
    """Returns how often policies leave set and box behind filters, against the channel.

    Args:
        name: Name of the environment.
        rows: Those rows of `channel_sweep` that are about the regulator, or those about trained agents.
    """
    policy = _REGULATOR if rows[0]["arm"].startswith(_REGULATOR) else _AGENTS
    sides = list(dict.fromkeys(row["side"] for row in rows))
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure((3.7 * len(sides), 6.2), _sweep_caption(name, rows))
        grid = figure.subplots(len(FILTERS_BY_COUNT), len(sides), sharey=True, squeeze=False)
        handles = {}
        for axes, (count, filters) in zip(grid, FILTERS_BY_COUNT.items(), strict=True):
            arms = [arm for each in filters if (arm := policy + each) in {row["arm"] for row in rows}]
            for axis, side in zip(axes, sides, strict=True):
                for arm in arms:
                    _draw_sweep(axis, [r for r in rows if r["side"] == side and r["arm"] == arm], count, arm)
                label(axis, _SIDES[side], _COUNTS[count] if axis is axes[0] else "")
                axis.set_ylim(-5.0, 105.0)
                axis.xaxis.set_major_locator(MaxNLocator(4, integer=side == "delay"))
                axis.xaxis.set_major_formatter("{x:g}")
            axes[0].set_title(_ROWS[count], loc="left")
            handles |= {arm: ArmStyle.of(arm).handle(line=False, points=True) for arm in arms}
        conditions = {"own disturbance": "-", "worst case": "--"}
        handles |= {name: Line2D([], [], color=_ANY_ARM, ls=dashes) for name, dashes in conditions.items()}
        legend_below(figure, handles)
        return figure


def return_figure(summary: dict[str, Any]) -> CaptionedFigure:
    """Returns the mean return against violating episodes, a panel per environment.

    Args:
        summary: What `page_summary` returns.
    """
    environments = summary["environments"]
    with matplotlib.rc_context(STYLE):
        caption = (
            "Violating evaluation episodes and return, better to the upper left. Bars are 95 % intervals: exact ones "
            "of violating episodes given the policies, Student's of the mean return (over runs for trained agents, "
            "over episodes for fixed policies). What lies below all trained arms is cut off."
        )
        figure = CaptionedFigure((4.1 * len(environments), 5.0), caption)
        handles = {}
        axes = figure.subplots(1, len(environments), squeeze=False)[0]
        for axis, (name, env) in zip(axes, environments.items(), strict=True):
            lows = []
            for arm_name, arm in env["arms"].items():
                style = ArmStyle.of(arm_name)
                _draw_point(axis, style, arm)
                lows += [arm["eval_return_mean"]] * (arm_name in env["trained"])
                handles[arm_name] = style.handle(line=False, points=True)
            label(axis, "violating episodes [%]", "mean return" if axis is axes[0] else "", name)
            axis.set_xlim(-5.0, 105.0)
            low, high = min(lows), axis.dataLim.y1
            axis.set_ylim(low - 0.15 * (high - low), high + 0.05 * (high - low))
            axis.yaxis.set_major_formatter(thousands)
        legend_below(figure, handles)
        return figure


def training_figure(summary: dict[str, Any]) -> CaptionedFigure:
    """Returns the violating steps of every training run, a panel per environment.

    Args:
        summary: What `page_summary` returns.
    """
    environments = summary["environments"]
    with matplotlib.rc_context(STYLE):
        caption = (
            "Violating steps while the agents learned, on a scale that is linear up to 1 and logarithmic beyond. Small "
            "dots are runs, markers their mean. These violations do not appear in the evaluation."
        )
        figure = CaptionedFigure((4.1 * len(environments), 3.6), caption)
        axes = figure.subplots(1, len(environments), squeeze=False, sharey=True)[0]
        names = list(dict.fromkeys(name for env in environments.values() for name in env["trained"]))
        for axis, (title, env) in zip(axes, environments.items(), strict=True):
            for name in env["trained"]:
                style, by_run = ArmStyle.of(name), env["arms"][name]["train_violation_steps_by_run"]
                height = len(names) - names.index(name)
                axis.plot(by_run, [height] * len(by_run), "o", ms=4.0, mfc=style.color, mec="white", mew=0.5)
                axis.plot(np.mean(by_run), height, ls="none", **style.points)
            axis.set_xscale("symlog", linthresh=1.0)
            axis.set_xlim(-0.3, max(1.0, axis.dataLim.x1) * 2.0)
            axis.set_yticks(range(len(names), 0, -1), names)
            label(axis, "violating training steps", "", title)
        return figure


def _draw_sweep(axis: Axes, rows: list[dict[str, Any]], count: str, arm: str) -> None:
    """Draws an arm's curve for each disturbance, with exact intervals as bars."""
    style = ArmStyle.of(arm)
    for condition in dict.fromkeys(row["condition"] for row in rows):
        shown = [row for row in rows if row["condition"] == condition]
        values = [row["value"] for row in shown]
        rates = [100.0 * row[count] / row["episodes"] for row in shown]
        worst = condition != rows[0]["condition"]
        axis.plot(values, rates, color=style.color, ls="--" if worst else "-", lw=1.4, **style.points)
        for value, row in zip(values, shown, strict=True):
            axis.plot([value] * 2, [100.0 * end for end in row[f"{count}_ci95"]], "-", color=style.color, lw=1.0)


def _draw_point(axis: Axes, style: ArmStyle, arm: dict[str, Any]) -> None:
    """Draws the return of an arm against its violating episodes, with both intervals."""
    rate, mean = 100.0 * arm["eval_violation_rate"], arm["eval_return_mean"]
    axis.plot([100.0 * end for end in arm["eval_violation_rate_ci95"]], [mean] * 2, "-", color=style.color, lw=1.0)
    if arm["eval_return_ci95"] is not None:
        axis.plot([rate] * 2, arm["eval_return_ci95"], "-", color=style.color, lw=1.0)
    axis.plot(rate, mean, ls="none", **style.points)


def _sweep_caption(name: str, rows: list[dict[str, Any]]) -> str:
    episodes, policies = rows[0]["episodes"], rows[0].get("policies", 1)
    if rows[0]["arm"].startswith(_REGULATOR):
        title, policy, given = "", "What acts is a linear-quadratic regulator", ""
    else:
        title = ", with trained agents"
        policy = "What acts behind each filter is what was trained behind it, on the environment's own channel"
        given = f" of {policies} agents" if policies > 1 else " of one agent"
    points = f"{episodes:,} {'episode' if episodes == 1 else 'episodes'}"
    intervals = "exact 95 % intervals given the agents" if given else "exact 95 % intervals"
    return (
        f"The same filters with and without the error set on {name}, by the channel{title}. {policy}; above behind the "
        "one-step filter, which is to keep S, below behind lookahead, which is to keep the box. 'Trusting' takes the "
        "estimate for the truth. Solid: the environment's own disturbance, dashed: the worst case. Every point is "
        f"{points}{given}, bars are {intervals}; values that are not varied are the environment's own, "
        "and channels that break its contract are left out."
    )
