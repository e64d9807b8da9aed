"""Draws an episode: `ncs render`."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator

import gymnasium as gym
import numpy as np
from tqdm import tqdm

from experiments.commands import require_extra
from experiments.commands.synthesize import plant_of
from experiments.plots.animation import FORMATS, save_animation, scaled
from experiments.runs.policies import UNTRAINED, policy_by_name
from experiments.settings.learning import RenderSettings
from ncs_gym.envs.env import ncs_env
from shields import Certificate, SafetyShield

FASTEST = 50
NARROWEST = 160
# Between two pictures side by side [pixels].
GAP = 8
GRAY = 120


def render(settings: RenderSettings) -> None:
    """Runs `ncs render`.

    Raises:
        ValueError: If a setting is wrong.
        OSError: If a file cannot be read or written.
        Infeasible: If a shield is asked for and no certificate is found.
    """
    _check(settings)
    if settings.policy not in UNTRAINED:
        require_extra("train", "stable_baselines3", "torch")
    if settings.out.suffix == ".mp4":
        require_extra("render", "moviepy")
    modes = ("none", settings.shield) if settings.side_by_side else (settings.shield,)
    players = [Player(settings, mode) for mode in modes]
    pictures = (scaled(_joined(row), settings.width) for row in _rows(players, settings.steps))
    size = save_animation(pictures, settings.out, settings.fps)
    for player in players:
        print(player)
    print(f"saved to {settings.out} ({size / 1e6:.2f} MB)")


class Player:
    """One episode that is drawn step by step.

    Args:
        settings: Of the command.
        mode: The shield's, or "none".
    """

    def __init__(self, settings: RenderSettings, mode: str) -> None:
        self._mode = mode
        certificate = None if settings.certificate is None else Certificate.load(settings.certificate)
        self._env: gym.Env = gym.make(settings.env, render_mode="rgb_array")
        self._policy = policy_by_name(settings.policy, settings.env, ncs_env(self._env), settings.seed)
        if mode != "none":
            self._env = SafetyShield(self._env, certificate, mode=mode)
        self._observation, self._info = self._env.reset(seed=settings.seed)
        self.is_over, self._steps = False, 0

    def picture(self) -> np.ndarray:
        """Returns the present picture, shape (height, width, 3), uint8."""
        picture = self._env.render()
        if not isinstance(picture, np.ndarray):
            raise TypeError(f"expected a picture, got {type(picture).__name__}")
        return picture

    def step(self) -> None:
        """Plays a step, unless the episode is over."""
        if not self.is_over:
            action = self._policy(self._observation, self._info)
            self._observation, _, terminated, truncated, self._info = self._env.step(action)
            self._steps += 1
            self.is_over = terminated or truncated

    def __str__(self) -> str:
        count = int(self._info["episode_violations"])
        line = f"{'no shield' if self._mode == 'none' else self._mode}: {self._steps} steps, {count} with a violation"
        if self._mode == "none":
            return line
        acted = "would have acted" if self._mode == "monitor" else "acted"
        return f"{line}, shield {acted} {self._info['episode_interventions']} times"


def _rows(players: list[Player], steps: int) -> Iterator[list[np.ndarray]]:
    """Yields the pictures of all players at reset and after each step, until all episodes are over."""
    yield [player.picture() for player in players]
    with tqdm(total=steps, desc="drawing", unit="step", leave=False, disable=None) as bar:
        for _ in range(steps):
            if all(player.is_over for player in players):
                return
            for player in players:
                player.step()
            yield [player.picture() for player in players]
            bar.update()


def _joined(row: list[np.ndarray]) -> np.ndarray:
    """Returns pictures side by side with a line between them."""
    gap = np.full((len(row[0]), GAP, 3), 255, np.uint8)
    gap[:, GAP // 2 - 1 : GAP // 2 + 1] = GRAY
    parts = [part for picture in row for part in (gap, picture)][1:]
    return np.concatenate(parts, axis=1)


def _check(settings: RenderSettings) -> None:
    """Raises unless the settings make sense.

    Raises:
        ValueError: If one does not.
        OSError: If there is no folder for the file.
    """
    plant_of(settings.env)
    if settings.out.suffix not in FORMATS:
        raise ValueError(f"--out must end in one of {', '.join(FORMATS)}, got {settings.out}")
    for name, low, high in (("seed", 0, None), ("steps", 1, None), ("fps", 1, FASTEST), ("width", NARROWEST, None)):
        value = getattr(settings, name)
        if value is not None and (value < low or (high is not None and value > high)):
            limits = f"at least {low}" + (f" and at most {high}" if high is not None else "")
            raise ValueError(f"--{name} must be {limits}, got {value}")
    if settings.side_by_side and settings.shield == "none":
        raise ValueError('--side-by-side compares with a shield: choose a --shield other than "none"')
    if not settings.out.resolve().parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(settings.out))
