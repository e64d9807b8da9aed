"""Frames of an episode as a GIF, an MP4 or a PNG file."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Iterable
from itertools import product
from pathlib import Path

import numpy as np
from PIL import Image

from ncs_gym.rendering import theme
from shields.atomic_write import write_atomically

FORMATS = (".gif", ".mp4", ".png")
# Time that an animation shows its last frame [ms].
_LAST_FRAME_TIME = 2000
# Fractions of the foreground in the mixed colors of edges.
_EDGE_FRACTIONS = (0.35, 0.7)


def save_animation(frames: Iterable[np.ndarray], file: Path, fps: int, width: int | None = None) -> int:
    """Writes frames in the format of the file's name.

    Args:
        frames: Frames of the same size, at least one, shape (height, width, 3), uint8.
        file: File whose name ends in one of FORMATS.
        fps: Frames per second.
        width: Width of the animation [pixels]; None for that of the frames.

    Returns:
        Size of the file [bytes].

    Raises:
        OSError: If it cannot be written.
    """
    encode = {".gif": _gif, ".mp4": _mp4, ".png": _png}[file.suffix]
    data = encode((_scaled(frame, width) for frame in frames), fps)
    write_atomically(file, data)
    return len(data)


def _scaled(frame: np.ndarray, width: int | None) -> Image.Image:
    """Returns a frame scaled to a width; both sides are even, as video encoders need them."""
    image = Image.fromarray(frame)
    if width is None or width == image.width:
        return image
    height = round(image.height * width / image.width)
    return image.resize((width - width % 2, height - height % 2), Image.Resampling.LANCZOS)


def _gif(frames: Iterable[Image.Image], fps: int) -> bytes:
    palette, buffer = _palette(), io.BytesIO()
    first, *others = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in frames]
    pace = round(1000 / fps)
    durations = [pace] * len(others) + [_LAST_FRAME_TIME]
    first.save(buffer, "GIF", save_all=True, append_images=others, duration=durations, loop=0, optimize=True)
    return buffer.getvalue()


def _mp4(frames: Iterable[Image.Image], fps: int) -> bytes:
    import imageio_ffmpeg

    remaining = iter(frames)
    image = next(remaining)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "episode.mp4"
        # Blocks of 2 pixels: by default the writer would stretch frames to multiples of 16.
        writer = imageio_ffmpeg.write_frames(str(file), image.size, fps=fps, macro_block_size=2)
        writer.send(None)
        try:
            writer.send(image.tobytes())
            for image in remaining:
                writer.send(image.tobytes())
            for _ in range(_LAST_FRAME_TIME * fps // 1000):
                writer.send(image.tobytes())
        finally:
            writer.close()
        return file.read_bytes()


def _png(frames: Iterable[Image.Image], fps: int) -> bytes:
    buffer, last = io.BytesIO(), None
    for frame in frames:
        last = frame
    assert last is not None
    last.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def _palette() -> Image.Image:
    """Returns an image with the palette of our frames; one computed from the frames loses small red objects."""
    grounds = (theme.PAPER, theme.MIST, theme.SAFE_FILL, theme.DANGER_FILL, theme.ERROR_FILL, theme.SHIELD_FILL)
    marks = (theme.INK, theme.MUTED, theme.STEEL, theme.FAINT, theme.SAFE, theme.DANGER, theme.ESTIMATE, theme.LATE)
    marks = (*marks, theme.LATE_TEXT, theme.SHIELD, theme.BODYWORK)
    ramp = [theme.load_color(level) for level in np.linspace(0.6, 0.95, 9)]
    edges = [theme.blend(mark, ground, fraction) for mark, ground, fraction in product(marks, grounds, _EDGE_FRACTIONS)]
    plan = [
        theme.blend(theme.PLAN, ground, fraction) for ground in (theme.PAPER, theme.SAFE_FILL) for fraction in (0, 0.5)
    ]
    others = theme.GRID, theme.CARGO, theme.CRATE, theme.GLASS
    colors = list(dict.fromkeys([*grounds, *marks, *others, *ramp, *plan, *edges]))[:255]
    image = Image.new("P", (1, 1))
    image.putpalette([part for color in colors for part in color])
    return image
