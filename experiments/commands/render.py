"""`ncs render`: draws an episode."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import gymnasium as gym
import numpy as np
from tqdm import tqdm

from experiments.plots.animation import FORMATS, save_frames
from experiments.runs.loops import registered_env
from experiments.runs.output_folder import require_place
from experiments.runs.policies import policy_by_name
from experiments.settings import id_alone, require_horizon, require_limits, short_version
from ncs_gym.envs.env import ncs_env
from ncs_gym.validation import counted
from shields import Certificate, SafetyShield

# Budget of `--smoke`.
_SMOKE = {"steps": 5}
# Width and gray value of the space between two frames side by side [pixels].
_GAP = 8
_GRAY = 120


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """Draws an episode of a policy, as an animation or its last frame (docs/rendering.md).

    Attributes:
        env: Id of an environment with a plant of its own; module:id first imports the module, which registers one of
            your own (`ncs_gym.register_plant`).
        out: File to write: .gif, or .png for the last frame alone.
        policy: "lqr", "mpc", "zero", "random", "pretrained" (the small agent of the package), or the folder of a
            trained agent.
        shield: Mode of the shield; "none" for no shield.
        horizon: Longest plan of mode "lookahead" [steps]; 6 by default.
        side_by_side: Draw the same episode without a shield at the left, with it at the right.
        certificate: Certificate file to use instead of synthesizing one.
        seed: Seed of the episode (of both, side by side) and of the random policy.
        steps: Largest number of steps.
        fps: Frames per second; one frame per step.
        scale: Pixels of a frame per unit of its layout of 640 by 480; by default 2, sharp on dense screens, and
            1 for a .gif, whose file would be several times as large.
        smoke: Draw a few steps only, to see that everything works; into episode-smoke.gif unless `--out` differs.
    """

    env: str = "ncs_gym/TruckTrailerCruise-v0"
    out: Path = Path("episode.gif")
    policy: str = "lqr"
    shield: Literal["project", "lookahead", "switch", "boundary", "monitor", "none"] = "project"
    horizon: int | None = None
    side_by_side: bool = False
    certificate: Path | None = None
    seed: int = 0
    steps: int = 200
    fps: int = 10
    scale: int | None = None
    smoke: bool = False

    def __post_init__(self) -> None:
        require_horizon(self, self.shield)
        require_limits(self, seed=0, steps=1, fps=(1, 50), scale=(1, 4))
        if self.side_by_side and self.shield == "none":
            raise ValueError('--side-by-side compares with a shield: choose a --shield other than "none"')


def render(settings: RenderSettings) -> None:
    """Runs `ncs render`."""
    settings = short_version(settings, **_SMOKE)
    registered_env(settings.env)
    if settings.out.suffix not in FORMATS:
        raise ValueError(f"--out must end in {' or '.join(FORMATS)}, got {settings.out}")
    require_place(settings.out)
    modes = ("none", settings.shield) if settings.side_by_side else (settings.shield,)
    renderers = [_EpisodeRenderer(settings, mode) for mode in modes]
    frames = map(_side_by_side, _frames(renderers, settings.steps))
    size = save_frames(frames, settings.out, settings.fps)
    for renderer in renderers:
        print(renderer)
    print(f"saved to {settings.out} ({size / 1e6:.2f} MB)")


class _EpisodeRenderer:
    """Simulates one episode and draws it step by step.

    Args:
        settings: Settings of the command.
        mode: Mode of the shield, or "none".

    Attributes:
        is_over: Whether the episode has ended.
    """

    def __init__(self, settings: RenderSettings, mode: str) -> None:
        self._mode = mode
        certificate = None if settings.certificate is None else Certificate.load(settings.certificate)
        env_id = id_alone(settings.env)  # whose module is imported
        self._env: gym.Env = gym.make(env_id, render_mode="rgb_array")
        inner = ncs_env(self._env)
        assert inner.renderer is not None
        inner.renderer.scale = settings.scale or (1 if settings.out.suffix == ".gif" else 2)
        self._policy = policy_by_name(settings.policy, env_id, inner, settings.seed)
        if mode != "none":
            on_unproved = "ignore" if mode == "monitor" else "warn"  # a monitor overrides nothing
            given = {"mode": mode, "horizon": settings.horizon, "on_unproved": on_unproved}
            self._env = SafetyShield(self._env, certificate, **given)
        self._observation, self._info = self._env.reset(seed=settings.seed)
        self.is_over, self._steps = False, 0

    def frame(self) -> np.ndarray:
        """Returns the frame of the present step, shape (height, width, 3), uint8."""
        frame = self._env.render()
        if not isinstance(frame, np.ndarray):
            raise TypeError(f"expected an image, got {type(frame).__name__}")
        return frame

    def step(self) -> None:
        """Simulates a step, unless the episode is over."""
        if not self.is_over:
            action = self._policy(self._observation, self._info)
            self._observation, _, terminated, truncated, self._info = self._env.step(action)
            self._steps += 1
            self.is_over = terminated or truncated

    def __str__(self) -> str:
        count = int(self._info["episode_violations"])
        mode = "no shield" if self._mode == "none" else self._mode
        line = f"{mode}: {counted(self._steps, 'step')}, {count} with a violation"
        if self._mode == "none":
            return line
        acted = "would have acted" if self._mode == "monitor" else "acted"
        return f"{line}, shield {acted} {counted(self._info['episode_interventions'], 'time')}"


def _frames(renderers: list[_EpisodeRenderer], steps: int) -> Iterator[list[np.ndarray]]:
    """Yields the frames of all episodes at reset and after each step, until all episodes are over."""
    yield [renderer.frame() for renderer in renderers]
    with tqdm(total=steps, desc="drawing", unit="step", leave=False, disable=None) as bar:
        for _ in range(steps):
            if all(renderer.is_over for renderer in renderers):
                return
            for renderer in renderers:
                renderer.step()
            yield [renderer.frame() for renderer in renderers]
            bar.update()


def _side_by_side(frames: list[np.ndarray]) -> np.ndarray:
    gap = np.full((len(frames[0]), _GAP, 3), 255, np.uint8)
    gap[:, _GAP // 2 - 1 : _GAP // 2 + 1] = _GRAY
    parts = [part for frame in frames for part in (gap, frame)][1:]
    return np.concatenate(parts, axis=1)
