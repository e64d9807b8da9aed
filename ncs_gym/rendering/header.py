"""The line on top: time, shield and violations."""

from __future__ import annotations

from math import ceil, log10

from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.scene import Scene

PADDING = 11.0


def draw_header(canvas: Canvas, scene: Scene) -> None:
    """Draws time at the left, then the shield, and the violations at the right."""
    y = theme.HEADER.h / 2
    time = f"{scene.step * scene.plant.dt:.{_decimals(scene.plant.dt)}f} s"
    canvas.text(f"step {scene.step}", (16, y), theme.INK, theme.BODY, bold=True)
    canvas.text(time, (148, y), theme.MUTED, theme.BODY, align=1.0)
    count = scene.violations
    text = "no violation" if count == 0 else f"{count} violation{'s' if count > 1 else ''}"
    color, fill = (theme.DANGER, theme.DANGER_FILL) if count else (theme.SAFE, theme.SAFE_FILL)
    left = _draw_chip(canvas, theme.WIDTH - 16, text, color, fill, filled=scene.violated)
    _draw_shield(canvas, scene, left - 10)


def _draw_shield(canvas: Canvas, scene: Scene, right: float) -> None:
    note = scene.annotation
    if note is None:
        _draw_chip(canvas, right, "no shield", theme.INK, theme.GRID, filled=False)
        return
    if not note.protects:
        text = f"shield only watches: would act {note.interventions}\N{MULTIPLICATION SIGN}"
    elif note.intervened:
        text = f"SHIELD ACTS {note.interventions}\N{MULTIPLICATION SIGN}"
    else:
        text = f"shield ({note.label}): acted {note.interventions}\N{MULTIPLICATION SIGN}"
    _draw_chip(canvas, right, text, theme.SHIELD, theme.SHIELD_FILL, filled=scene.intervened)


def _draw_chip(
    canvas: Canvas, right: float, text: str, color: theme.Color, fill: theme.Color, *, filled: bool
) -> float:
    """Draws a label that ends at `right`; returns where it begins."""
    width = canvas.text_width(text, theme.BODY, bold=True) + 2 * PADDING
    chip = theme.Rect(right - width, 7, width, theme.HEADER.h - 14)
    canvas.rect(chip, color if filled else fill, radius=13)
    middle = chip.x + PADDING, theme.HEADER.h / 2
    canvas.text(text, middle, theme.PAPER if filled else color, theme.BODY, bold=True)
    return chip.x


def _decimals(dt: float) -> int:
    """Returns how many decimals of a second a step of dt needs."""
    return min(max(1, ceil(-log10(dt))), 6)
