"""The panel beside the phase plane: inputs, goal, recent packets and legend."""

from __future__ import annotations

import numpy as np

from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.history import RECENT
from ncs_gym.rendering.limits import reading, unit_text
from ncs_gym.rendering.scene import Scene

# Inputs drawn.
MOST_INPUTS = 3
TRACK = 12.0


def draw_panel(canvas: Canvas, scene: Scene) -> None:
    """Draws the rows that move."""
    rect = theme.PANEL
    rows = min(scene.plant.m, MOST_INPUTS) + (scene.goal is not None) + 1
    spacing = min(52.0, 172.0 / rows)
    y = rect.y
    for i in range(min(scene.plant.m, MOST_INPUTS)):
        _draw_input(canvas, scene, i, y)
        y += spacing
    if scene.goal is not None:
        _draw_goal(canvas, scene, y)
        y += spacing
    _draw_packets(canvas, scene, y)


def draw_legend(canvas: Canvas, *, shielded: bool) -> None:
    """Draws what the marks of the phase plane and of the packets mean."""
    top = theme.PANEL.bottom - 48
    first, second, third = (theme.PANEL.x + offset for offset in (7.0, 112.0, 229.0))
    canvas.circle((first, top), 4.0, theme.INK)
    canvas.circle((first, top + 20), 5.0, theme.ESTIMATE, width=1.5)
    _draw_disc(canvas, (first, top + 40), theme.ERROR_FILL, theme.LATE)
    canvas.dashed([(second - 7, top), (second + 8, top)], theme.DANGER, 1.5, dash=3.0)
    if shielded:
        _draw_disc(canvas, (second, top + 20), theme.SAFE_FILL, theme.SAFE)
        canvas.circle((second, top + 40), 3.5, theme.SHIELD)
    canvas.circle((third, top), 3.5, theme.ESTIMATE)
    canvas.circle((third, top + 20), 3.5, theme.LATE)
    canvas.cross((third, top + 40), 3.5, theme.DANGER, 2.0)
    columns = (
        (first, ("true state", "estimate", "error bound")),
        (second, ("safe box", "safe set S", "shield acted") if shielded else ("safe box",)),
        (third, ("on time", "late", "lost")),
    )
    for x, names in columns:
        for i, name in enumerate(names):
            canvas.text(name, (x + 14, top + 20 * i), theme.INK)


def _draw_disc(canvas: Canvas, center: tuple[float, float], fill: theme.Color, edge: theme.Color) -> None:
    canvas.circle(center, 6.5, fill)
    canvas.circle(center, 6.5, edge, width=1.5)


def _draw_title(canvas: Canvas, y: float, name: str, value: str, color: theme.Color) -> None:
    width = canvas.text(value, (theme.PANEL.right, y + 6), color, align=1.0, bold=True)
    canvas.text(name, (theme.PANEL.x, y + 6), theme.INK, most=theme.PANEL.w - width - 8)


def _draw_input(canvas: Canvas, scene: Scene, index: int, y: float) -> None:
    """Draws an input between its limits; where the shield acts, the way from what was proposed."""
    plant = scene.plant
    limit = float(plant.u_max[index])
    value = 0.0 if scene.input is None else float(scene.input[index])
    unit = unit_text(plant.input_units[index])
    color = theme.SHIELD if scene.intervened else theme.STEEL
    _draw_title(canvas, y, plant.input_names[index], f"{reading(value, limit)} {unit}".strip(), color)
    track = theme.Rect(theme.PANEL.x, y + 18, theme.PANEL.w, TRACK)
    middle = track.x + track.w / 2

    def x_of(u: float) -> float:
        return middle + (track.w / 2 - 6) * float(np.clip(u / limit, -1.0, 1.0))

    canvas.rect(track, theme.MIST, radius=4)
    x = x_of(value)
    canvas.rect(theme.Rect(min(x, middle), track.y + 2, abs(x - middle), TRACK - 4), color)
    canvas.line([(middle, track.y - 2), (middle, track.bottom + 2)], theme.MUTED, 1.0)
    note = scene.annotation
    if note is not None and note.intervened and note.proposed is not None:
        _draw_correction(canvas, x_of(float(note.proposed[index])), x, track.y + TRACK / 2)


def _draw_correction(canvas: Canvas, start: float, end: float, y: float) -> None:
    """Draws an arrow from the proposed input to the applied one."""
    canvas.circle((start, y), 5.0, theme.PAPER)
    canvas.circle((start, y), 5.0, theme.SHIELD, width=2.0)
    if abs(end - start) > 14:
        side = np.sign(end - start)
        canvas.line([(start + 6 * side, y), (end - 8 * side, y)], theme.SHIELD, 2.0)
        canvas.polygon([(end, y), (end - 10 * side, y - 6), (end - 10 * side, y + 6)], theme.SHIELD)


def _draw_goal(canvas: Canvas, scene: Scene, y: float) -> None:
    """Draws a quantity and its target."""
    goal = scene.goal
    assert goal is not None
    span = max(abs(goal.low), abs(goal.high))
    unit = unit_text(goal.unit)
    signed = goal.low < 0.0
    numbers = [reading(value, span) if signed else f"{value:.1f}" for value in (goal.value, goal.target)]
    text = f"{numbers[0]} \N{RIGHTWARDS ARROW} {numbers[1]} {unit}".strip()
    _draw_title(canvas, y, f"{goal.name}, target", text, theme.SAFE)
    track = theme.Rect(theme.PANEL.x, y + 18, theme.PANEL.w, TRACK)
    canvas.rect(track, theme.MIST, radius=4)

    def x_of(value: float) -> float:
        share = (value - goal.low) / (goal.high - goal.low)
        return track.x + 6 + (track.w - 12) * float(np.clip(share, 0.0, 1.0))

    base = x_of(max(goal.low, 0.0))
    x, target = x_of(goal.value), x_of(goal.target)
    canvas.rect(theme.Rect(min(x, base), track.y + 2, abs(x - base), TRACK - 4), theme.STEEL)
    canvas.line([(target, track.y - 2), (target, track.bottom + 2)], theme.SAFE, 3.0)
    canvas.polygon([(target, track.y + 4), (target - 5, track.y - 3), (target + 5, track.y - 3)], theme.SAFE)


def _draw_packets(canvas: Canvas, scene: Scene, y: float) -> None:
    """Draws the fate of the packets sent in the last steps, the newest at the right."""
    old = scene.age
    text = "newest used: now" if old == 0 else f"newest used: {old} step{'s' if old > 1 else ''} old"
    _draw_title(canvas, y, "packets sent", text, theme.LATE_TEXT if old else theme.ESTIMATE)
    track = theme.Rect(theme.PANEL.x, y + 18, theme.PANEL.w, TRACK)
    canvas.rect(track, theme.MIST, radius=4)
    spacing = (track.w - 14) / (RECENT - 1)
    for flight in scene.flights:
        back = scene.step - flight.stamp
        if back >= RECENT:
            continue
        place = track.right - 7 - spacing * back, track.y + TRACK / 2
        if flight.arrival is None:
            canvas.cross(place, 3.5, theme.DANGER, 2.0)
        elif flight.arrival > scene.step:
            canvas.circle(place, 3.5, theme.LATE, width=1.5)
        else:
            canvas.circle(place, 3.5, theme.ESTIMATE if flight.arrival == flight.stamp else theme.LATE)
