"""The one door through which tests make plants, loops, shields and certificates of the product.

Where a constructor changes, this file translates; `tests/test_product.py` finds the calls that go past it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import gymnasium as gym

import ncs_gym
import shields
from ncs_gym import LinearPlant
from shields import Certificate


def linear_plant(**described: Any) -> LinearPlant:
    """A plant by its matrices, limits and bounds."""
    return LinearPlant(**described)


def sampled_plant(model: Any, dt: float | None = None, **described: Any) -> LinearPlant:
    """A plant sampled from a state-space model: (A, B, C, D), or an object that has them."""
    return LinearPlant.from_statespace(model, dt, **described)


def library_plant(make: Callable[..., LinearPlant], *physical: Any, **described: Any) -> LinearPlant:
    """A plant of the library with limits and bounds that are not its own."""
    return make(*physical, **described)


def linear_model(process: Any, *limits: Any, **described: Any) -> LinearPlant:
    """The linear model of a process, with what it leaves out."""
    return ncs_gym.linear_model(process, *limits, **described)


def family_of(members: Any, ranges: Any = None, **settings: Any) -> LinearPlant:
    """A plant of which several members, or ranges of parameters, are possible."""
    return LinearPlant.family(members, ranges, **settings)


def altered(plant: LinearPlant, **described: Any) -> LinearPlant:
    """The plant with other matrices, limits or bounds."""
    return dataclasses.replace(plant, **described)


def resampled(plant: LinearPlant, dt: float) -> LinearPlant:
    """The plant with steps of another duration."""
    return plant.resampled(dt)


def rate_limited(plant: LinearPlant, largest: Any, **settings: Any) -> LinearPlant:
    """The plant whose inputs change by so much from one step to the next at most."""
    return plant.with_rate_limits(largest, **settings)


def loop_env(plant: LinearPlant, *channel: Any, **settings: Any) -> ncs_gym.NCSEnv:
    """The environment of one loop."""
    return ncs_gym.NCSEnv(plant, *channel, **settings)


def vector_env(num_envs: int = 1, **settings: Any) -> ncs_gym.NCSVectorEnv:
    """The environment of several loops."""
    return ncs_gym.NCSVectorEnv(num_envs, **settings)


def gym_env(**settings: Any) -> gym.Env:
    """The environment that `gym.make` gives for a plant."""
    return gym.make("ncs_gym/LinearNCS-v0", **settings)


def gym_vector_env(num_envs: int, **settings: Any) -> gym.vector.VectorEnv:
    """The environment that `gym.make_vec` gives for a plant."""
    return gym.make_vec("ncs_gym/LinearNCS-v0", num_envs, **settings)


def safety_shield(env: gym.Env, *certificate: Any, **settings: Any) -> shields.SafetyShield:
    """The environment behind a shield."""
    return shields.SafetyShield(env, *certificate, **settings)


def vector_shield(env: gym.vector.VectorEnv, *certificate: Any, **settings: Any) -> shields.VectorSafetyShield:
    """The vector environment behind a shield."""
    return shields.VectorSafetyShield(env, *certificate, **settings)


def safety_filter(certificate: Certificate, plant: LinearPlant, *mode: Any, **settings: Any) -> shields.SafetyFilter:
    """The filter that decides on inputs."""
    return shields.SafetyFilter(certificate, plant, *mode, **settings)


def safe_loop(certificate: Certificate, plant: LinearPlant, *channel: Any, **settings: Any) -> shields.SafeLoop:
    """The controller's side of a loop, whose plant is elsewhere."""
    return shields.SafeLoop(certificate, plant, *channel, **settings)


def synthesize(plant: LinearPlant, **settings: Any) -> Certificate:
    """A certificate that is made here."""
    return shields.synthesize(plant, **settings)


def paper_synthesis(plant: LinearPlant, **settings: Any) -> Any:
    """A certificate of the published method that is made here."""
    return shields.paper.synthesize(plant, **settings)
