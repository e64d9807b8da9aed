"""`ncs render`: draws an episode."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Literal

import gymnasium as gym
import numpy as np
from PIL import Image
from tqdm import tqdm

from experiments.runs.loops import registered_env
from experiments.runs.output_folder import require_place
from experiments.runs.policies import policy_by_name
from experiments.settings import id_alone, require_horizon, require_limits
from ncs_gym.envs.env import ncs_env
from ncs_gym.rendering import theme
from ncs_gym.validation import counted
from shields import Certificate, SafetyShield
from shields.documents import write_atomically
from shields.runtime.safety_filter import Mode


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """Draws an episode of a policy, as an animation or its last frame.

    Attributes:
        env: Id of an environment with a plant of its own, or module:id.
        out: File to write: .gif, or .png for the last frame alone.
        policy: lqr, mpc, zero-input, random, pretrained (the small agent of the package), or the folder of a trained
            agent.
        shield: Mode of the shield; "none" for no shield.
        horizon: Longest plan of mode "lookahead" [steps]; 6 by default.
        side_by_side: Draw the same episode without a shield at the left, with it at the right.
        certificate: Certificate file to use instead of synthesizing one.
        seed: Seed of the episode (of both, side by side) and of the random policy.
        steps: Largest number of steps.
    """

    env: str = "ncs_gym/TruckTrailerCruise-v0"
    out: Path = Path("episode.gif")
    policy: str = "lqr"
    shield: Literal[Mode, "none"] = "project"
    horizon: int | None = None
    side_by_side: bool = False
    certificate: Path | None = None
    seed: int = 0
    steps: int = 200

    def __post_init__(self) -> None:
        require_horizon(self, self.shield)
        require_limits(self, seed=0, steps=1)
        if self.side_by_side and self.shield == "none":
            raise ValueError('--side-by-side compares with a shield: choose a --shield other than "none"')


# The white between frames side by side, with a line [pixels].
_GAP, _GRAY = 8, 120
# Time of a frame of an animation, and of its last one [ms].
_FRAME_TIME, _LAST_FRAME_TIME = 100, 2000


def render(settings: RenderSettings) -> None:
    """Runs `ncs render`."""
    registered_env(settings.env)
    if settings.out.suffix not in (".gif", ".png"):
        raise ValueError(f"--out must end in .gif or .png, got {settings.out}")
    require_place(settings.out)
    modes = ("none", settings.shield) if settings.side_by_side else (settings.shield,)
    episodes = [_Episode(settings, mode) for mode in modes]
    buffer, palette, images, last = io.BytesIO(), _palette(), [], None
    for frame in _frames(episodes, settings.steps):
        last = Image.fromarray(frame)
        if settings.out.suffix == ".gif":
            images.append(last.quantize(palette=palette, dither=Image.Dither.NONE))
    assert last is not None
    if images:
        times = [_FRAME_TIME] * (len(images) - 1) + [_LAST_FRAME_TIME]
        images[0].save(buffer, "GIF", save_all=True, append_images=images[1:], duration=times, loop=0, optimize=True)
    else:
        last.save(buffer, "PNG", optimize=True)
    write_atomically(settings.out, buffer.getvalue())
    print(*episodes, sep="\n")
    print(f"saved to {settings.out} ({buffer.tell() / 1e6:.2f} MB)")


class _Episode:
    """An episode that is simulated and drawn step by step, behind the shield of a mode or none."""

    def __init__(self, settings: RenderSettings, mode: str) -> None:
        self._mode, env_id = mode, id_alone(settings.env)  # whose module is imported
        self._env: gym.Env = gym.make(env_id, render_mode="rgb_array")
        inner = ncs_env(self._env)
        assert inner.renderer is not None
        inner.renderer.scale = 1 if settings.out.suffix == ".gif" else 2  # sharp on dense screens, and a larger file
        self._policy = policy_by_name(settings.policy, env_id, inner, settings.seed)
        if mode != "none":
            certificate = None if settings.certificate is None else Certificate.load(settings.certificate)
            on_unproved = "ignore" if mode == "monitor" else "warn"  # a monitor overrides nothing
            given = {"mode": mode, "horizon": settings.horizon, "on_unproved": on_unproved}
            self._env = SafetyShield(self._env, certificate, **given)
        self._observation, self._info = self._env.reset(seed=settings.seed)
        self.is_over, self._steps = False, 0

    def frame(self) -> np.ndarray:
        """Returns a frame, shape (height, width, 3), uint8."""
        return np.asarray(self._env.render())

    def step(self) -> None:
        """Simulates a step unless the episode is over."""
        if not self.is_over:
            action = self._policy(self._observation, self._info)
            self._observation, _, terminated, truncated, self._info = self._env.step(action)
            self._steps += 1
            self.is_over = terminated or truncated

    def __str__(self) -> str:
        violations = f"{counted(self._steps, 'step')}, {int(self._info['episode_violations'])} with a violation"
        if self._mode == "none":
            return f"no shield: {violations}"
        acted = "would have acted" if self._mode == "monitor" else "acted"
        return f"{self._mode}: {violations}, shield {acted} {counted(self._info['episode_interventions'], 'time')}"


def _frames(episodes: list[_Episode], steps: int) -> Iterator[np.ndarray]:
    """Yields the frames of all episodes side by side, at reset and after each step, until all episodes are over."""
    for _ in tqdm(range(steps), desc="drawing", unit="step", leave=False, disable=None):
        yield _side_by_side([each.frame() for each in episodes])
        if all(each.is_over for each in episodes):
            return
        for each in episodes:
            each.step()
    yield _side_by_side([each.frame() for each in episodes])


def _side_by_side(frames: list[np.ndarray]) -> np.ndarray:
    gap = np.full((len(frames[0]), _GAP, 3), 255, np.uint8)
    gap[:, _GAP // 2 - 1 : _GAP // 2 + 1] = _GRAY
    return np.concatenate([part for frame in frames for part in (gap, frame)][1:], axis=1)


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
