"""A plant of the user's own as a registered environment."""

from __future__ import annotations

import os
from typing import Any

import gymnasium as gym

from ncs_gym.network.channel import Channel
from ncs_gym.network.contract import ChannelContract
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.registration import ENTRY_POINTS, EPISODE_STEPS, LINEAR_NCS, entry_points_of
from ncs_gym.tasks.task import Task
from ncs_gym.validation import as_count


def register_plant(
    env_id: str,
    plant: LinearPlant | str | os.PathLike[str],
    *,
    channel: Channel | dict[str, Any] | None = None,
    task: Task | dict[str, Any] | None = None,
    contract: ChannelContract | dict[str, Any] | None = None,
    max_episode_steps: int = EPISODE_STEPS,
    **settings: Any,
) -> None:
    """Registers a plant as a Gymnasium environment, scalar and vectorized, with a time limit.

    With this in a module `tank.py`:

        import numpy as np
        from ncs_gym import Channel, LinearPlant, register_plant

        plant = LinearPlant(
            A=[[0.98, 0.04], [0.0, 0.95]],  # levels of two tanks, deviations from the set point [m]
            B=[[0.0], [0.05]],  # valve [l/s]
            box=[0.3, 0.5],  # |x_1| <= 0.3 m, |x_2| <= 0.5 m at every step
            u_max=2.0,
            dt=1.0,
            disturbance_bound=[0.001, 0.002],  # largest change per step by what is not modeled [m]
            sensor_bound=0.01,
            initial_bound=0.01,
        )
        register_plant("Plants/Tanks-v0", plant, channel=Channel(loss=0.3, delay=2))

    the id works wherever Gymnasium's do, and for the commands (which import the module before the colon):

        gym.make("tank:Plants/Tanks-v0")
        gym.make_vec("tank:Plants/Tanks-v0", num_envs=64)
        ncs compare --env tank:Plants/Tanks-v0

    Args:
        env_id: Id, such as "Plants/Tanks-v0".
        plant: The plant, or the path of a file that `LinearPlant.save` wrote: with a path the spec is JSON.
        channel: The network; a perfect one by default.
        task: The reward; `Regulation` by default.
        contract: What the channel promises; by default that of the channel if the plant is unstable, else none.
        max_episode_steps: Steps after which an episode is truncated.
        settings: Other keywords of `NCSEnv`: `process`, `disturbance`, `noise`, `initial_set`,
            `terminate_on_violation` and `allow_assumption_violation`.

    Raises:
        UnstablePlantError: If the plant is not Schur stable and there is no contract.
        TypeError: If a keyword is unknown.
        ValueError: If a setting is wrong, or the id is that of an environment of this package.
    """
    if env_id in ENTRY_POINTS:
        raise ValueError(f"{env_id} is an environment of this package: register the plant under an id of its own")
    steps = as_count(max_episode_steps, "max_episode_steps", low=1)
    given = {"channel": channel, "task": task, "contract": contract} | settings
    given = {name: value for name, value in given.items() if value is not None}
    given |= {"plant": plant if isinstance(plant, LinearPlant) else os.path.abspath(plant), "horizon": steps}
    LINEAR_NCS(**given)  # wrong settings are noticed here rather than when the first environment is made
    gym.register(id=env_id, max_episode_steps=steps, kwargs=given, **entry_points_of("LINEAR_NCS"))
