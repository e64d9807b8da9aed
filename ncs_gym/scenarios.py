"""The registered environments: the only place with numbers."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from ncs_gym.channel import Channel
from ncs_gym.disturbance import BoxDisturbance
from ncs_gym.ellipsoid import Ellipsoid
from ncs_gym.env import NCSEnv
from ncs_gym.plant import LinearPlant, truck_trailer
from ncs_gym.task import SpeedTracking, Task

# Steps per episode of every registered environment (`paper.tex` Section 5).
EPISODE_STEPS = 200
# Mass of the loaded trailer [kg]: full throttle stretches the coupling beyond its limit (theory.md section 5).
LOADED_MASS = 4000.0
# Half-widths of the disturbance box and starting radius of the case study [m, m/s].
BOX = (0.02, 0.01)
CASE_STUDY_START = 1.9
# Starts of the cruise are this near rest of the coupling [m, m/s].
CRUISE_START = 0.2


def case_study_channel() -> Channel:
    """Returns the four impairments of `paper.tex` Section 5, all at once."""
    return Channel(loss=0.3, quantization_step=0.05, send_period=2, delay=2)


def make_truck_trailer(
    plant: LinearPlant | None = None,
    channel: Channel | None = None,
    task: Task | None = None,
    disturbance: Any = None,
    initial_set: Ellipsoid | None = None,
    terminate_on_violation: bool = False,
    allow_assumption_violation: bool = False,
    render_mode: str | None = None,
) -> NCSEnv:
    """Returns `ncs_gym/TruckTrailer-v0`: the case study of `paper.tex` Section 5, task Regulation.

    1000 kg, dt 0.5 s, disturbance uniform in [-0.02, 0.02] x [-0.01, 0.01] (gamma 5e-4) plus process noise
    Q = 1e-4 I, P0 = R = 1e-4 I (the paper prints no R), delta 0.05; loss 0.3, quantization step 0.05, a sample
    every 2 steps, delay 2 steps; starts uniformly in the disc of radius 1.9. See `NCSEnv` for the arguments.
    """
    return NCSEnv(
        plant=truck_trailer() if plant is None else plant,
        channel=case_study_channel() if channel is None else channel,
        task=task,
        disturbance=_default_disturbance(plant) if disturbance is None else disturbance,
        initial_set=_disc(CASE_STUDY_START) if initial_set is None else initial_set,
        terminate_on_violation=terminate_on_violation,
        allow_assumption_violation=allow_assumption_violation,
        render_mode=render_mode,
        horizon=EPISODE_STEPS,
    )


def make_truck_trailer_cruise(
    plant: LinearPlant | None = None,
    channel: Channel | None = None,
    task: Task | None = None,
    disturbance: Any = None,
    initial_set: Ellipsoid | None = None,
    terminate_on_violation: bool = False,
    allow_assumption_violation: bool = False,
    render_mode: str | None = None,
) -> NCSEnv:
    """Returns `ncs_gym/TruckTrailerCruise-v0`: the loaded trailer, task SpeedTracking.

    4000 kg on the same coupling, noise and channel as the case study; the truck follows a random piecewise-constant
    speed profile, and starts within 0.2 of rest of the coupling. See `NCSEnv` for the arguments.
    """
    return NCSEnv(
        plant=truck_trailer(mass=LOADED_MASS) if plant is None else plant,
        channel=case_study_channel() if channel is None else channel,
        task=SpeedTracking() if task is None else task,
        disturbance=_default_disturbance(plant) if disturbance is None else disturbance,
        initial_set=_disc(CRUISE_START) if initial_set is None else initial_set,
        terminate_on_violation=terminate_on_violation,
        allow_assumption_violation=allow_assumption_violation,
        render_mode=render_mode,
        horizon=EPISODE_STEPS,
    )


def make_linear_ncs(
    plant: LinearPlant | None = None,
    channel: Channel | None = None,
    task: Task | None = None,
    disturbance: Any = "ball",
    initial_set: Ellipsoid | None = None,
    terminate_on_violation: bool = False,
    allow_assumption_violation: bool = False,
    render_mode: str | None = None,
) -> NCSEnv:
    """Returns `ncs_gym/LinearNCS-v0`: any `plant`, behind a perfect channel and with task Regulation unless given.

    See `NCSEnv` for the arguments.

    Raises:
        ValueError: If no plant is given.
    """
    if plant is None:
        raise ValueError("LinearNCS-v0 needs plant=LinearPlant(...)")
    return NCSEnv(
        plant=plant,
        channel=channel,
        task=task,
        disturbance=disturbance,
        initial_set=initial_set,
        terminate_on_violation=terminate_on_violation,
        allow_assumption_violation=allow_assumption_violation,
        render_mode=render_mode,
        horizon=EPISODE_STEPS,
    )


def _default_disturbance(plant: LinearPlant | None) -> BoxDisturbance:
    """Returns the paper's box; for a plant of the user's the box that its own gamma allows."""
    return BoxDisturbance(BOX if plant is None else None)


def _disc(radius: float) -> Ellipsoid:
    return Ellipsoid(radius**2 * np.eye(2))


ENTRY_POINTS = {
    "ncs_gym/TruckTrailer-v0": make_truck_trailer,
    "ncs_gym/TruckTrailerCruise-v0": make_truck_trailer_cruise,
    "ncs_gym/LinearNCS-v0": make_linear_ncs,
}


def register_all() -> None:
    """Registers the ids with gymnasium; `import ncs_gym` calls it."""
    for env_id, factory in ENTRY_POINTS.items():
        factory.metadata = NCSEnv.metadata
        if env_id not in gym.registry:
            gym.register(id=env_id, entry_point=f"{__name__}:{factory.__name__}", max_episode_steps=EPISODE_STEPS)
