"""Packets on their way through the network, from the sensor to the controller."""

from __future__ import annotations

from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.episode_record import FrameRecord, PacketRecord
from ncs_gym.validation import counted

# A lost packet is drawn for this many more steps, and drifts this many pixels along the line in each of them.
_FADE_STEPS, _DRIFT = 2, 27.0
# Pixels between the sensor and a packet just sent, and between an arriving packet and the controller.
_DEPARTURE_GAP, _ARRIVAL_GAP = 40.0, 22.0
# Of several packets closer together than this only one is labeled, that lost at this step or the oldest [pixels].
_LABEL_SPACING = 100.0


def draw_packets(canvas: Canvas, frame: FrameRecord, start: float, end: float) -> None:
    """Draws the line from the sensor at x = start to the controller at x = end, and the packets that travel on it."""
    y = theme.PACKET_LINE
    canvas.dashed([(start, y), (end, y)], theme.FAINT, 1.5, dash=3.0)
    sent = any(packet.stamp == frame.step for packet in frame.packets)
    arrived = any(packet.arrival == frame.step for packet in frame.packets)
    _draw_endpoint(canvas, start, "sensor", 1.0, active=sent)
    _draw_endpoint(canvas, end, "controller", 0.0, active=arrived)
    in_flight, labeled, middle = [], [], 0.5 * (start + end)
    has_room = not (frame.broken_elsewhere or frame.missing_inputs)  # what the header says of them takes the line above
    for packet in frame.packets:
        if packet.arrival is None:
            _draw_lost(canvas, middle, frame.step - packet.stamp, labeled=has_room)
            labeled += [middle] * (frame.step == packet.stamp)
        elif frame.step <= packet.arrival:
            length = end - start - _DEPARTURE_GAP - _ARRIVAL_GAP
            x = start + _DEPARTURE_GAP + length * _progress(packet, frame.step)
            in_flight.append((frame.step - packet.stamp, x))
    for age, x in in_flight:
        canvas.line([(start + 10, y), (x, y)], theme.blend(_color(age), theme.PAPER, 0.6), 2.5)
    for age, x in in_flight:
        _draw_envelope(canvas, (x, y), _color(age))
        if age and has_room and all(abs(x - other) > _LABEL_SPACING for other in labeled):
            text = f"{counted(age, 'step')} late"
            canvas.text(text, (x, y - 18), theme.INK, align=0.5, bold=True)
            labeled.append(x)


def _progress(packet: PacketRecord, step: int) -> float:
    """Returns the fraction of its way that a packet has covered; one that arrives at once has covered all of it."""
    assert packet.arrival is not None
    if packet.arrival == packet.stamp:
        return 1.0
    return (step - packet.stamp) / (packet.arrival - packet.stamp)


def _color(age: int) -> theme.Color:
    return theme.LATE if age else theme.ESTIMATE


def _draw_envelope(canvas: Canvas, center: tuple[float, float], color: theme.Color, size: float = 1.0) -> None:
    x, y = center
    w, h = 11.0 * size, 7.5 * size
    canvas.rect(theme.Rect(x - w, y - h, 2 * w, 2 * h), color, radius=2.5 * size)
    canvas.line([(x - w + 2, y - h + 2.5), (x, y + 1), (x + w - 2, y - h + 2.5)], theme.PAPER, 1.25)


def _draw_lost(canvas: Canvas, middle: float, age: int, *, labeled: bool) -> None:
    """Draws a lost packet that fades while it drifts on."""
    if age > _FADE_STEPS:
        return
    center, fading = (middle + _DRIFT * age, theme.PACKET_LINE), 0.3 * age
    _draw_envelope(canvas, center, theme.blend(theme.FAINT, theme.MIST, fading), 0.9)
    canvas.cross(center, 8.0, theme.blend(theme.DANGER, theme.MIST, fading), 3.0)
    if age == 0 and labeled:
        canvas.text("lost", (middle, theme.PACKET_LINE - 18), theme.DANGER, align=0.5, bold=True)


def _draw_endpoint(canvas: Canvas, x: float, name: str, align: float, *, active: bool) -> None:
    """Draws the sensor or the controller as a ring with its name, filled when it sends or receives a packet."""
    color, y = theme.ESTIMATE if active else theme.MUTED, theme.PACKET_LINE
    canvas.circle((x, y), 7.0, theme.PAPER)
    canvas.circle((x, y), 7.0, color, width=2.0)
    if active:
        canvas.circle((x, y), 3.5, color)
    canvas.text(name, (x - 12 if align else x + 12, y), theme.MUTED, align=align)
