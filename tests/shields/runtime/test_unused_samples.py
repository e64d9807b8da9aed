"""Samples that are of no use are not thrown away without a word, and what is said names the cause."""

from __future__ import annotations

import warnings

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import Channel, Packet, truck_trailer
from ncs_gym.network.channel import UnusedPacketsWarning
from ncs_gym.processes.plant_step import PlantSimulation
from shields.runtime.guard import NOT_FINITE
from tests.certificates import certificate_of
from tests.product import loop_env, loop_step, safe_loop, safety_shield, vector_env, vector_shield

PLANT = truck_trailer(mass=4000.0)


def test_every_reason_is_counted_and_named_once_and_apart():
    loop = safe_loop(certificate_of(PLANT), PLANT, Channel(delay=1))
    loop.start(np.zeros(2))
    for _ in range(4):
        loop_step(loop, 0.0)
    strays = [Packet(stamp, np.zeros(2)) for stamp in (1, 90, 2000)] + [Packet(4, np.zeros(2), 5)] * 3
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        loop_step(loop, 0.0, strays)
        loop_step(loop, 0.0, strays)
    assert loop.discarded == (2, 4, 6)
    said = [str(warning.message) for warning in caught]
    assert len(said) == 3
    for text in ("older than 1 step, the longest delay", "is ahead of the loop", "episode is not that of the loop"):
        assert sum(text in each for each in said) == 1
    loop.start(np.zeros(2))
    assert loop.discarded == (0, 0, 0)


@pytest.mark.parametrize("many", [False, True])
def test_environments_name_it_as_well(many, monkeypatch):
    honest, count = PlantSimulation.measure, 0

    def damaged(simulation, rng, state):
        nonlocal count
        count += 1
        measured = honest(simulation, rng, state)
        if count == 3:
            measured[1] = np.nan
        return measured

    monkeypatch.setattr(PlantSimulation, "measure", damaged)
    settings = {"plant": PLANT, "channel": Channel()}
    inner = vector_env(num_envs=2, **settings) if many else loop_env(**settings)
    env = (vector_shield if many else safety_shield)(inner, certificate_of(PLANT), on_unproved="ignore")
    env.reset(seed=0)
    reasons = [np.unique(env.step(np.zeros((2, 1) if many else 1, np.float32))[4]["shield_reason"]) for _ in range(5)]
    assert [each.tolist() for each in reasons] == [[""], [""], [NOT_FINITE], [NOT_FINITE], [NOT_FINITE]]


def test_rounding_too_coarse_for_any_update_is_named_once():
    with pytest.warns(UnusedPacketsWarning, match="no packet is of use: .* rounded to 0.2, samples") as caught:
        env = gym.make("ncs_gym/TruckTrailer-v0", channel=Channel(quantization_step=0.2))
    assert len(caught) == 1
    env.reset(seed=0)
    assert [env.step(np.zeros(1))[4]["measurement_age"] for _ in range(20)] == [*range(1, 21)]
