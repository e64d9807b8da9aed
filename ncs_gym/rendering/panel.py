"""The texts and bars of a frame: the header on top, and the panel with inputs, tracked output and legend."""

from __future__ import annotations

from math import ceil, log10

import numpy as np

from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.episode_record import Annotation, EpisodeRecord, TrackedOutput
from ncs_gym.validation import counted

# The largest number of inputs that are drawn, and the height of a row [pixels].
_MAX_INPUTS, _ROW = 3, 42.0


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
    if (note := episode.annotation) is None:
        _draw_label(canvas, left - 10, "no shield", theme.INK, theme.GRID, filled=False)
    else:
        _draw_label(canvas, left - 10, _shield_text(note), theme.SHIELD, theme.SHIELD_FILL, filled=episode.intervened)


def draw_panel(canvas: Canvas, episode: EpisodeRecord) -> None:
    """Draws inputs, tracked output and the legend."""
    inputs, tracked, y = min(episode.plant.m, _MAX_INPUTS), episode.tracked, theme.PANEL.y
    for i in range(inputs):
        _draw_input(canvas, episode, i, y + _ROW * i)
    y += _ROW * inputs
    if tracked is not None:
        _draw_tracked_output(canvas, tracked, y)
        y += _ROW
    if hidden := episode.plant.m - inputs:
        canvas.text(f"and {counted(hidden, 'more input')}", (theme.PANEL.right, y), theme.MUTED, align=1.0)
    _draw_legend(canvas, episode.annotation)


def draw_plan(canvas: Canvas, points: np.ndarray) -> None:
    """Draws where a stored plan leads as a dotted tail with a dot at each step; nothing without a plan."""
    if len(points) > 1:
        canvas.dashed(points, theme.PLAN, 1.5, dash=2.0)
    for point in points[1:]:
        canvas.circle(point, 2.5, theme.PLAN)


def _shield_text(note: Annotation) -> str:
    count = f"{note.interventions}\N{MULTIPLICATION SIGN}"
    if not note.protects:
        return f"shield only watches: would act {count}"
    if note.intervened:
        return f"SHIELD ACTS {count}"
    ahead = 0 if note.plan is None else len(note.plan)  # for as long the box is kept in any case
    return f"shield ({f'{ahead} steps ahead' if ahead else note.label}): acted {count}"


def _draw_label(
    canvas: Canvas, right: float, text: str, color: theme.Color, fill: theme.Color, *, filled: bool
) -> float:
    """Draws a label of the header that ends at `right`; returns where it begins."""
    width = canvas.text_width(text, theme.BODY, bold=True) + 22
    canvas.rect(theme.Rect(right - width, 7, width, theme.HEADER.h - 14), color if filled else fill, radius=13)
    place = right - width + 11, theme.HEADER.h / 2
    canvas.text(text, place, theme.PAPER if filled else color, theme.BODY, bold=True)
    return right - width


def _draw_row(canvas: Canvas, y: float, name: str, value: str, color: theme.Color) -> theme.Rect:
    """Draws the name and the value of a row of the panel and its empty bar; returns where the bar is."""
    width = canvas.text(value, (theme.PANEL.right, y + 6), color, align=1.0, bold=True)
    canvas.text(name, (theme.PANEL.x, y + 6), theme.INK, max_width=theme.PANEL.w - width - 8)
    bar = theme.Rect(theme.PANEL.x, y + 18, theme.PANEL.w, 12)
    canvas.rect(bar, theme.MIST, radius=4)
    return bar


def places_on(bar: theme.Rect, ends: np.ndarray, *values: float) -> list[float]:
    """Returns where values are on a bar from the first to the second end, or at its ends if beyond [pixels]."""
    loads = np.clip((np.array(values) - ends[0]) / (ends[1] - ends[0]), 0.0, 1.0)
    return (bar.x + 6 + (bar.w - 12) * loads).tolist()


def fill(canvas: Canvas, bar: theme.Rect, start: float, end: float, color: theme.Color) -> None:
    """Fills a bar between two places."""
    canvas.rect(theme.Rect(min(start, end), bar.y + 2, abs(end - start), bar.h - 4), color)


def _draw_input(canvas: Canvas, episode: EpisodeRecord, index: int, y: float) -> None:
    """Draws an input between its limits; where the shield acts, also an arrow from the proposed input."""
    plant, info, note = episode.plant, episode.info, episode.annotation
    limit, value = float(plant.largest_input[index]), float(info["input"][index])
    color = theme.SHIELD if episode.intervened else theme.STEEL
    text = theme.value_label(value + float(plant.operating_input[index]), limit, plant.input_units[index])
    bar = _draw_row(canvas, y, plant.input_names[index], text, color)
    proposed = None if note is None or not note.intervened else note.proposed
    arrow = [] if proposed is None else [proposed[index], info["input_committed"][index]]
    zero, x, *arrow = places_on(bar, plant.input_ends[:, index], 0.0, value, *arrow)
    fill(canvas, bar, zero, x, color)
    canvas.line([(zero, bar.y - 2), (zero, bar.bottom + 2)], theme.MUTED, 1.0)
    if arrow:
        _draw_correction(canvas, arrow[0], arrow[1], bar.y + bar.h / 2)


def _draw_correction(canvas: Canvas, start: float, end: float, y: float) -> None:
    canvas.circle((start, y), 5.0, theme.PAPER)
    canvas.circle((start, y), 5.0, theme.SHIELD, width=2.0)
    if abs(end - start) > 14:
        side = np.sign(end - start)
        canvas.line([(start + 6 * side, y), (end - 8 * side, y)], theme.SHIELD, 2.0)
        canvas.polygon([(end, y), (end - 10 * side, y - 6), (end - 10 * side, y + 6)], theme.SHIELD)


def _draw_tracked_output(canvas: Canvas, tracked: TrackedOutput, y: float) -> None:
    low, high = tracked.low, tracked.high
    numbers = [theme.value_label(value, max(abs(low), abs(high))) for value in (tracked.value, tracked.target)]
    if low >= 0.0:
        numbers = [number.removeprefix("+") for number in numbers]
    text = f"{numbers[0]} \N{RIGHTWARDS ARROW} {numbers[1]} {theme.unit_label(tracked.unit)}".strip()
    bar = _draw_row(canvas, y, f"{tracked.name}, target", text, theme.SAFE)
    zero, x, target = places_on(bar, np.array([low, high]), max(low, 0.0), tracked.value, tracked.target)
    fill(canvas, bar, zero, x, theme.STEEL)
    canvas.line([(target, bar.y - 2), (target, bar.bottom + 2)], theme.SAFE, 3.0)
    canvas.polygon([(target, bar.y + 4), (target - 5, bar.y - 3), (target + 5, bar.y - 3)], theme.SAFE)


def _draw_legend(canvas: Canvas, note: Annotation | None) -> None:
    """Draws what the marks of the phase plane mean."""
    rows = [theme.PANEL.bottom - 59 + 17 * i for i in range(4)]
    left, right = theme.PANEL.x + 7, theme.PANEL.x + 150
    canvas.circle((left, rows[0]), 4.0, theme.INK)
    canvas.circle((left, rows[1]), 5.0, theme.ESTIMATE, width=1.5)
    discs = [((left, rows[2]), theme.ERROR_FILL, theme.LATE)]
    canvas.dashed([(right - 7, rows[0]), (right + 8, rows[0])], theme.DANGER, 1.5, dash=3.0)
    states, marks = ["true state", "estimate", "error bound"], ["limits"]
    if note is not None:
        discs.append(((right, rows[1]), theme.SAFE_FILL, theme.SAFE))
        canvas.circle((right, rows[2]), 3.5, theme.SHIELD)
        _draw_correction(canvas, right + 4.0, right - 12.0, rows[3])
        marks += ["safe set", "shield acted", "overridden"]
        if note.plan is not None:
            draw_plan(canvas, np.array([(left + x, rows[3]) for x in (-8, 0, 8)]))
            states += ["stored plan"]
    for place, color, edge in discs:
        canvas.circle(place, 6.5, color)
        canvas.circle(place, 6.5, edge, width=1.5)
    for x, names in ((left, states), (right, marks)):
        for name, y in zip(names, rows, strict=False):
            canvas.text(name, (x + 14, y), theme.INK)
