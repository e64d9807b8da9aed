"""The network: packets on their way from the sensor to the controller."""

from __future__ import annotations

from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.history import Flight
from ncs_gym.rendering.scene import Scene

# A lost packet is seen for this many steps more, each so many pixels farther on: what is below the lane stays clear.
FADE, DRIFT = 2, 27.0
# Pixels between the sensor and a packet just sent, and between one that arrives and the controller.
DEPART, ARRIVE = 40.0, 22.0
# Packets closer than this share a label, the oldest one's [pixels].
LABEL = 100.0


def draw_lane(canvas: Canvas, scene: Scene, start: float, end: float) -> None:
    """Draws the lane from the sensor at x = start to the controller at x = end, and the packets on it."""
    y = theme.LANE
    canvas.dashed([(start, y), (end, y)], theme.FAINT, 1.5, dash=3.0)
    arrived = any(flight.arrival == scene.step for flight in scene.flights)
    _draw_end(canvas, start, "sensor", 1.0, lit=any(flight.stamp == scene.step for flight in scene.flights))
    _draw_end(canvas, end, "controller", 0.0, lit=arrived)
    flying = []
    for flight in scene.flights:
        if flight.arrival is None:
            _draw_lost(canvas, 0.5 * (start + end), scene.step - flight.stamp)
        elif scene.step <= flight.arrival:
            x = start + DEPART + (end - start - DEPART - ARRIVE) * _progress(flight, scene.step)
            flying.append((scene.step - flight.stamp, x))
    for age, x in flying:
        canvas.line([(start + 10, y), (x, y)], theme.blend(_color(age), theme.PAPER, 0.6), 2.5)
    labeled = float("inf")
    for age, x in flying:
        draw_envelope(canvas, (x, y), _color(age))
        if age and abs(x - labeled) > LABEL:
            text = f"{age} step{'s' if age > 1 else ''} late"
            canvas.text(text, (x, y - 18), theme.INK, align=0.5, bold=True)
            labeled = x


def draw_envelope(canvas: Canvas, center: tuple[float, float], color: theme.Color, size: float = 1.0) -> None:
    """Draws a packet."""
    x, y = center
    w, h = 11.0 * size, 7.5 * size
    canvas.rect(theme.Rect(x - w, y - h, 2 * w, 2 * h), color, radius=2.5 * size)
    canvas.line([(x - w + 2, y - h + 2.5), (x, y + 1), (x + w - 2, y - h + 2.5)], theme.PAPER, 1.25)


def _progress(flight: Flight, step: int) -> float:
    """Returns which part of its way a packet has covered; what arrives at once has covered all of it."""
    assert flight.arrival is not None
    if flight.arrival == flight.stamp:
        return 1.0
    return (step - flight.stamp) / (flight.arrival - flight.stamp)


def _color(age: int) -> theme.Color:
    return theme.LATE if age else theme.ESTIMATE


def _draw_lost(canvas: Canvas, middle: float, age: int) -> None:
    """Draws a lost packet that fades while it drifts on."""
    if age > FADE:
        return
    center, fading = (middle + DRIFT * age, theme.LANE), 0.3 * age
    draw_envelope(canvas, center, theme.blend(theme.FAINT, theme.MIST, fading), 0.9)
    canvas.cross(center, 8.0, theme.blend(theme.DANGER, theme.MIST, fading), 3.0)
    if age == 0:
        canvas.text("lost", (middle, theme.LANE - 18), theme.DANGER, align=0.5, bold=True)


def _draw_end(canvas: Canvas, x: float, name: str, align: float, *, lit: bool) -> None:
    color = theme.ESTIMATE if lit else theme.MUTED
    canvas.circle((x, theme.LANE), 7.0, theme.PAPER)
    canvas.circle((x, theme.LANE), 7.0, color, width=2.0)
    if lit:
        canvas.circle((x, theme.LANE), 3.5, color)
    canvas.text(name, (x - 12 if align else x + 12, theme.LANE), theme.MUTED, align=align)
