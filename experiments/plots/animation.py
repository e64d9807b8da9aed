"""Frames of an episode as a GIF, or the last one as a PNG file."""

from __future__ import annotations

import io
from collections import deque
from collections.abc import Iterable
from itertools import product
from pathlib import Path

import numpy as np
from PIL import Image

from ncs_gym.rendering import theme
from shields.atomic_write import write_atomically

FORMATS = (".gif", ".png")
# Time that an animation shows its last frame [ms].
_LAST_FRAME_TIME = 2000


def save_frames(frames: Iterable[np.ndarray], file: Path, fps: int) -> int:
    """Writes frames as an animation, or the last one alone if the file's name ends in .png.

    Args:
        frames: Frames of the same size, at least one, shape (height, width, 3), uint8.
        file: File whose name ends in one of FORMATS.
        fps: Frames per second.

    Returns:
        Size of the file [bytes].

    Raises:
        OSError: If it cannot be written.
    """
    buffer, palette = io.BytesIO(), _palette()
    if file.suffix == ".png":
        (last,) = deque(frames, maxlen=1)
        Image.fromarray(last).save(buffer, "PNG", optimize=True)
    else:
        images = [Image.fromarray(each).quantize(palette=palette, dither=Image.Dither.NONE) for each in frames]
        times = [round(1000 / fps)] * (len(images) - 1) + [_LAST_FRAME_TIME]
        images[0].save(buffer, "GIF", save_all=True, append_images=images[1:], duration=times, loop=0, optimize=True)
    write_atomically(file, buffer.getvalue())
    return buffer.tell()


def _palette() -> Image.Image:
    """Returns an image with the palette of our frames; one computed from the frames loses small red objects."""
    grounds = (theme.PAPER, theme.MIST, theme.SAFE_FILL, theme.DANGER_FILL, theme.ERROR_FILL, theme.SHIELD_FILL)
    colors = [each for each in vars(theme).values() if isinstance(each, tuple) and len(each) == 3]
    colors += [theme.load_color(level) for level in np.linspace(0.6, 0.95, 9)]
    marks = [each for each in colors if each not in grounds]  # mixtures of grounds would stand for white
    mixed = [theme.blend(one, other, by) for by, one, other in product((0.3, 0.65), grounds, marks[::-1])]
    image = Image.new("P", (1, 1))
    image.putpalette([part for color in list(dict.fromkeys([*colors, *mixed]))[:255] for part in color])
    return image
