"""The texts and bars of a frame: the header on top, and the panel with inputs, tracked output, packets and legend."""

from __future__ import annotations

from math import ceil, log10

import numpy as np

from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.episode_record import RECENT_STEPS, FrameRecord
from ncs_gym.validation import counted

# The largest number of inputs that are drawn.
_MAX_INPUTS = 3
# Height of a bar, and space between the ends of a label in the header and its text [pixels].
_BAR_HEIGHT, _PADDING = 12.0, 11.0


def draw_header(canvas: Canvas, frame: FrameRecord) -> None:
    """Draws step and time at the left, and the shield and the violations at the right."""
    y = theme.HEADER.h / 2
    dt = frame.plant.dt
    decimals = 0 if dt == int(dt) else min(max(1, ceil(-log10(dt))), 6)
    canvas.text(f"step {frame.step}", (16, y), theme.INK, theme.BODY, bold=True)
    canvas.text(f"{frame.step * dt:.{decimals}f} s", (172, y), theme.MUTED, theme.BODY, align=1.0)
    count = frame.violations
    text = "no violation" if count == 0 else counted(count, "violation")
    color, fill = (theme.DANGER, theme.DANGER_FILL) if count else (theme.SAFE, theme.SAFE_FILL)
    left = _draw_label(canvas, theme.WIDTH - 16, text, color, fill, filled=frame.violated)
    _draw_shield(canvas, frame, left - 10)
    if text := frame.broken_elsewhere:
        place, width = (theme.WIDTH - 16, theme.HEADER.h + 13), theme.WIDTH - 32
        canvas.text(text, place, theme.DANGER, theme.BODY, align=1.0, bold=True, max_width=width)
    if frame.missing_inputs:
        text = f"downlink broken {frame.missing_inputs}\N{MULTIPLICATION SIGN}: zero applied"
        canvas.text(text, (16, theme.HEADER.h + 13), theme.DANGER, theme.BODY, bold=frame.input_missing)


def draw_panel(canvas: Canvas, frame: FrameRecord) -> None:
    """Draws the rows of the panel that change from step to step."""
    inputs = min(frame.plant.m, _MAX_INPUTS)
    spacing = min(52.0, 172.0 / (inputs + (frame.tracked is not None) + 1))
    y = theme.PANEL.y
    for i in range(inputs):
        _draw_input(canvas, frame, i, y)
        y += spacing
    if frame.tracked is not None:
        _draw_tracked_output(canvas, frame, y)
        y += spacing
    _draw_packets(canvas, frame, y)
    if hidden := frame.plant.m - inputs:
        place = theme.PANEL.right, y + 18 + _BAR_HEIGHT + 11
        canvas.text(f"and {counted(hidden, 'more input')}", place, theme.MUTED, align=1.0)


def draw_legend(canvas: Canvas, *, shielded: bool, plans: bool) -> None:
    """Draws what the marks of the phase plane and of the packets mean.

    Args:
        canvas: Where it is drawn.
        shielded: Whether there is a safe set.
        plans: Whether the shield stores plans.
    """
    rows = [theme.PANEL.bottom - 8 - 17 * i for i in reversed(range(4))]
    first, second, third = (theme.PANEL.x + offset for offset in (7.0, 115.0, 221.0))
    canvas.circle((first, rows[0]), 4.0, theme.INK)
    canvas.circle((first, rows[1]), 5.0, theme.ESTIMATE, width=1.5)
    _draw_disc(canvas, (first, rows[2]), theme.ERROR_FILL, theme.LATE)
    states = ["true state", "estimate", "error bound"]
    canvas.dashed([(second - 7, rows[0]), (second + 8, rows[0])], theme.DANGER, 1.5, dash=3.0)
    marks = ["safe box"]
    if plans:
        draw_plan(canvas, [(first - 8, rows[3]), (first, rows[3]), (first + 8, rows[3])])
        states += ["stored plan"]
    if shielded:
        _draw_disc(canvas, (second, rows[1]), theme.SAFE_FILL, theme.SAFE)
        canvas.circle((second, rows[2]), 3.5, theme.SHIELD)
        _draw_correction(canvas, second + 4.0, second - 12.0, rows[3])
        marks += ["safe set", "shield acted", "overridden"]
    canvas.circle((third, rows[0]), 3.5, theme.ESTIMATE)
    canvas.circle((third, rows[1]), 3.5, theme.LATE)
    canvas.circle((third, rows[2]), 3.5, theme.LATE, width=1.5)
    canvas.cross((third, rows[3]), 3.5, theme.DANGER, 2.0)
    columns = (first, states), (second, marks), (third, ["on time", "late", "on the way", "lost"])
    for x, names in columns:
        for name, y in zip(names, rows, strict=False):
            canvas.text(name, (x + 12, y), theme.INK)


def draw_plan(canvas: Canvas, points: list) -> None:
    """Draws where a stored plan leads as a dotted tail with a dot at each step; nothing without a plan."""
    if len(points) > 1:
        canvas.dashed(points, theme.PLAN, 1.5, dash=2.0)
    for point in points[1:]:
        canvas.circle(point, 2.5, theme.PLAN)


def _draw_shield(canvas: Canvas, frame: FrameRecord, right: float) -> None:
    """Writes into the header whether there is a shield and what it does."""
    annotation = frame.annotation
    if annotation is None:
        _draw_label(canvas, right, "no shield", theme.INK, theme.GRID, filled=False)
        return
    count = f"{annotation.interventions}\N{MULTIPLICATION SIGN}"
    if not annotation.protects:
        text = f"shield only watches: would act {count}"
    elif annotation.intervened:
        text = f"SHIELD ACTS {count}"
    else:
        ahead = 0 if annotation.plan is None else len(annotation.plan)  # for as long the box is kept in any case
        label = f"{counted(ahead, 'step')} ahead" if ahead else annotation.label
        text = f"shield ({label}): acted {count}"
    _draw_label(canvas, right, text, theme.SHIELD, theme.SHIELD_FILL, filled=frame.intervened)


def _draw_label(
    canvas: Canvas, right: float, text: str, color: theme.Color, fill: theme.Color, *, filled: bool
) -> float:
    """Draws a label of the header that ends at `right`; returns where it begins."""
    width = canvas.text_width(text, theme.BODY, bold=True) + 2 * _PADDING
    label = theme.Rect(right - width, 7, width, theme.HEADER.h - 14)
    canvas.rect(label, color if filled else fill, radius=13)
    place = label.x + _PADDING, theme.HEADER.h / 2
    canvas.text(text, place, theme.PAPER if filled else color, theme.BODY, bold=True)
    return label.x


def _draw_disc(canvas: Canvas, center: tuple[float, float], fill: theme.Color, edge: theme.Color) -> None:
    canvas.circle(center, 6.5, fill)
    canvas.circle(center, 6.5, edge, width=1.5)


def _draw_row(canvas: Canvas, y: float, name: str, value: str, color: theme.Color) -> theme.Rect:
    """Draws the name and the value of a row of the panel and its empty bar; returns where the bar is."""
    width = canvas.text(value, (theme.PANEL.right, y + 6), color, align=1.0, bold=True)
    canvas.text(name, (theme.PANEL.x, y + 6), theme.INK, max_width=theme.PANEL.w - width - 8)
    bar = theme.Rect(theme.PANEL.x, y + 18, theme.PANEL.w, _BAR_HEIGHT)
    canvas.rect(bar, theme.MIST, radius=4)
    return bar


def _draw_input(canvas: Canvas, frame: FrameRecord, index: int, y: float) -> None:
    """Draws an input between its limits; where the shield acts, also an arrow from the proposed input."""
    plant = frame.plant
    limit = float(plant.largest_input[index])
    value = 0.0 if frame.input is None else float(frame.input[index])
    color = theme.SHIELD if frame.intervened else theme.STEEL
    text = theme.value_label(value + float(plant.operating_input[index]), limit, plant.input_units[index])
    bar = _draw_row(canvas, y, plant.input_names[index], text, color)
    middle, half = float(plant.input_middle[index]), float(plant.input_half[index])

    def x_of(u: float) -> float:
        return bar.x + bar.w / 2 + (bar.w / 2 - 6) * float(np.clip((u - middle) / half, -1.0, 1.0))

    x, zero = x_of(value), x_of(0.0)
    canvas.rect(theme.Rect(min(x, zero), bar.y + 2, abs(x - zero), bar.h - 4), color)
    canvas.line([(zero, bar.y - 2), (zero, bar.bottom + 2)], theme.MUTED, 1.0)
    annotation = frame.annotation
    if annotation is not None and annotation.intervened and annotation.proposed is not None:
        decided = x if frame.committed is None else x_of(float(frame.committed[index]))
        _draw_correction(canvas, x_of(float(annotation.proposed[index])), decided, bar.y + bar.h / 2)


def _draw_correction(canvas: Canvas, start: float, end: float, y: float) -> None:
    canvas.circle((start, y), 5.0, theme.PAPER)
    canvas.circle((start, y), 5.0, theme.SHIELD, width=2.0)
    if abs(end - start) > 14:
        side = np.sign(end - start)
        canvas.line([(start + 6 * side, y), (end - 8 * side, y)], theme.SHIELD, 2.0)
        canvas.polygon([(end, y), (end - 10 * side, y - 6), (end - 10 * side, y + 6)], theme.SHIELD)


def _draw_tracked_output(canvas: Canvas, frame: FrameRecord, y: float) -> None:
    tracked = frame.tracked
    assert tracked is not None
    low, high = tracked.low, tracked.high
    limit = max(abs(low), abs(high))
    numbers = [theme.value_label(value, limit) for value in (tracked.value, tracked.target)]
    if low >= 0.0:
        numbers = [number.removeprefix("+") for number in numbers]
    text = f"{numbers[0]} \N{RIGHTWARDS ARROW} {numbers[1]} {theme.unit_label(tracked.unit)}".strip()
    bar = _draw_row(canvas, y, f"{tracked.name}, target", text, theme.SAFE)

    def x_of(value: float) -> float:
        return bar.x + 6 + (bar.w - 12) * float(np.clip((value - low) / (high - low), 0.0, 1.0))

    zero, x, target = x_of(max(low, 0.0)), x_of(tracked.value), x_of(tracked.target)
    canvas.rect(theme.Rect(min(x, zero), bar.y + 2, abs(x - zero), bar.h - 4), theme.STEEL)
    canvas.line([(target, bar.y - 2), (target, bar.bottom + 2)], theme.SAFE, 3.0)
    canvas.polygon([(target, bar.y + 4), (target - 5, bar.y - 3), (target + 5, bar.y - 3)], theme.SAFE)


def _draw_packets(canvas: Canvas, frame: FrameRecord, y: float) -> None:
    """Draws what became of the packets sent in the recent steps, the newest at the right.

    A tick below marks a step in which nobody asked for a sample, but the contract needed one.
    """
    age = frame.measurement_age
    text = "newest used: now" if age == 0 else f"newest used: {counted(age, 'step')} old"
    bar = _draw_row(canvas, y, "packets sent", text, theme.LATE_TEXT if age else theme.ESTIMATE)
    spacing = (bar.w - 14) / (RECENT_STEPS - 1)
    for back, forced in enumerate(frame.forced[::-1].tolist()):
        if forced:
            x = bar.right - 7 - spacing * back
            canvas.line([(x, bar.bottom - 2), (x, bar.bottom + 4)], theme.SHIELD, 2.5)
    for packet in frame.packets:
        back = frame.step - packet.stamp
        if back >= RECENT_STEPS:
            continue
        place = bar.right - 7 - spacing * back, bar.y + bar.h / 2
        if packet.arrival is None:
            canvas.cross(place, 3.5, theme.DANGER, 2.0)
        elif packet.arrival > frame.step:
            canvas.circle(place, 3.5, theme.LATE, width=1.5)
        else:
            canvas.circle(place, 3.5, theme.ESTIMATE if packet.arrival == packet.stamp else theme.LATE)
