"""The texts and bars of a frame: the header on top, and the panel with inputs, tracked output and legend."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, log10

import numpy as np

from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.episode_record import Annotation, EpisodeRecord, TrackedOutput
from ncs_gym.validation import counted

# The largest number of inputs that are drawn, and the height of a row [pixels].
_MAX_INPUTS, ROW = 3, 42.0


def draw_header(canvas: Canvas, episode: EpisodeRecord) -> None:
    """Draws step and time at the left, and the shield and the violations at the right."""
    y, dt = theme.HEADER.h / 2, episode.plant.dt
    decimals = 0 if dt == int(dt) else min(max(1, ceil(-log10(dt))), 6)
    canvas.text(f"step {episode.step}", (16, y), theme.INK, theme.BODY, bold=True)
    canvas.text(f"{episode.step * dt:.{decimals}f} s", (172, y), theme.MUTED, theme.BODY, align=1.0)
    count = int(episode.info["episode_violations"])
    text = counted(count, "violation") if count else "no violation"
    color, fill = (theme.DANGER, theme.DANGER_FILL) if count else (theme.SAFE, theme.SAFE_FILL)
    left = _draw_label(canvas, theme.WIDTH - 16, text, color, fill, filled=episode.violated)
    color, fill = (theme.SHIELD, theme.SHIELD_FILL) if episode.annotation else (theme.INK, theme.GRID)
    _draw_label(canvas, left - 10, _shield_text(episode.annotation), color, fill, filled=episode.intervened)


def draw_panel(canvas: Canvas, episode: EpisodeRecord) -> None:
    """Draws inputs, tracked output and the legend."""
    inputs = min(episode.plant.m, _MAX_INPUTS)
    for i in range(inputs):
        _draw_input(canvas, episode, i, theme.PANEL.y + ROW * i)
    if (tracked := episode.tracked) is not None:
        _draw_tracked_output(canvas, tracked, theme.PANEL.y + ROW * inputs)
    if episode.info.get("downlink_broken"):
        canvas.text("downlink broken: zero input", (theme.PANEL.x, 412), theme.DANGER, bold=True)
    _draw_legend(canvas, episode.annotation)


def _shield_text(note: Annotation | None) -> str:
    if note is None:
        return "no shield"
    count = f"{note.interventions}\N{MULTIPLICATION SIGN}"
    if not note.protects:
        return f"shield only watches: would act {count}"
    return f"SHIELD ACTS {count}" if note.intervened else f"shield ({note.label}): acted {count}"


def _draw_label(
    canvas: Canvas, right: float, text: str, color: theme.Color, fill: theme.Color, *, filled: bool
) -> float:
    """Draws a label of the header that ends at `right`; returns where it begins."""
    width = canvas.text_width(text, theme.BODY, bold=True) + 22
    canvas.rect(theme.Rect(right - width, 7, width, theme.HEADER.h - 14), color if filled else fill, radius=13)
    place = right - width + 11, theme.HEADER.h / 2
    canvas.text(text, place, theme.PAPER if filled else color, theme.BODY, bold=True)
    return right - width


def draw_bar(
    canvas: Canvas,
    place: tuple[float, float],
    name: str,
    text: str,
    colors: tuple[theme.Color, theme.Color],
    ends: np.ndarray,
    values: Sequence[float],
) -> tuple[theme.Rect, list[float]]:
    """Draws a row at a place, its upper left corner: name, text, and below a bar from a zero to a value.

    `colors` are those of text and bar, `ends` the values at both ends of the bar, `values` the zero, the value and
    others. Returns the bar's rectangle and where the others are on it, or its end if they are beyond [pixels].
    """
    x, y = place
    width = canvas.text(text, (x + theme.PANEL.w, y + 6), colors[0], align=1.0, bold=True)
    canvas.text(name, (x, y + 6), theme.INK, max_width=theme.PANEL.w - width - 8)
    bar = theme.Rect(x, y + 18, theme.PANEL.w, 12)
    canvas.rect(bar, theme.GRID, radius=4)
    loads = np.clip((np.array(values) - ends[0]) / (ends[1] - ends[0]), 0.0, 1.0)
    zero, end, *others = (bar.x + 6 + (bar.w - 12) * loads).tolist()
    canvas.rect(theme.Rect(min(zero, end), bar.y + 2, abs(end - zero), bar.h - 4), colors[1])
    canvas.line([(zero, bar.y - 2), (zero, bar.bottom + 2)], theme.MUTED, 1.0)
    return bar, others


def _draw_input(canvas: Canvas, episode: EpisodeRecord, index: int, y: float) -> None:
    """Draws an input between its limits; where the shield acts, also an arrow from the proposed input."""
    plant, info, note = episode.plant, episode.info, episode.annotation
    limit, value = float(plant.largest_input[index]), float(info["input"][index])
    color = theme.SHIELD if episode.intervened else theme.STEEL
    text = theme.value_label(value + float(plant.operating_input[index]), limit, plant.input_units[index])
    proposed = None if note is None or not note.intervened else note.proposed
    arrow = (
        [] if proposed is None else [proposed[index], episode.info.get("input_committed", episode.info["input"])[index]]
    )
    place, ends, values = (theme.PANEL.x, y), plant.input_ends[:, index], [0.0, value, *arrow]
    bar, arrow = draw_bar(canvas, place, plant.input_names[index], text, (color, color), ends, values)
    if not arrow:
        return
    (start, end), height, side = arrow, bar.y + bar.h / 2, np.sign(arrow[1] - arrow[0])
    canvas.circle((start, height), 5.0, theme.PAPER)
    canvas.circle((start, height), 5.0, theme.SHIELD, width=2.0)
    if abs(end - start) > 14:
        canvas.line([(start + 6 * side, height), (end - 8 * side, height)], theme.SHIELD, 2.0)
        canvas.polygon([(end, height), (end - 10 * side, height - 6), (end - 10 * side, height + 6)], theme.SHIELD)


def _draw_tracked_output(canvas: Canvas, tracked: TrackedOutput, y: float) -> None:
    low, high = tracked.low, tracked.high
    numbers = [theme.value_label(value, max(abs(low), abs(high))).removeprefix("+") for value in tracked[2:4]]
    text = f"{numbers[0]} \N{RIGHTWARDS ARROW} {numbers[1]} {theme.unit_label(tracked.unit)}".strip()
    place, colors, values = (theme.PANEL.x, y), (theme.SAFE, theme.STEEL), (max(low, 0.0), *tracked[2:4])
    bar, (target,) = draw_bar(canvas, place, f"{tracked.name}, target", text, colors, np.array([low, high]), values)
    canvas.line([(target, bar.y - 2), (target, bar.bottom + 2)], theme.SAFE, 3.0)
    canvas.polygon([(target, bar.y + 4), (target - 5, bar.y - 3), (target + 5, bar.y - 3)], theme.SAFE)


def _draw_legend(canvas: Canvas, note: Annotation | None) -> None:
    """Names the marks of the phase plane."""
    marks = [("true state", theme.INK, 0.0), ("estimate", theme.ESTIMATE, 1.5), ("error bound", theme.LATE, 1.5)]
    if note is not None:
        marks += [("safe set", theme.SAFE, 2.0), ("shield acted", theme.SHIELD, 0.0)]
        marks += [("stored plan", theme.PLAN, 0.0)] * (note.plan is not None)
    for i, (name, color, width) in enumerate(marks):
        x, y = theme.PANEL.x + 7 + 143 * (i // 3), theme.PANEL.bottom - 42 + 17 * (i % 3)
        canvas.circle((x, y), 4.0 + 0.5 * width, color, width=width)
        canvas.text(name, (x + 14, y), theme.INK)
