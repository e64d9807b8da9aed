"""Attacks on the certificates of published plants: extreme agents, disturbances and noise, from the edge of the set."""

from __future__ import annotations

from typing import NamedTuple

import gymnasium as gym
import numpy as np

from experiments.published.plants import channel_of, contract_of_plant
from ncs_gym import AdversarialDisturbance, LinearPlant
from shields import Certificate, VectorSafetyShield

ENVIRONMENTS, EPISODE = 200, 100
# Every episode is one of these agents, which propose ends of the input limits, or anything between.
AGENTS = ("high", "low", "either end", "one end for ten steps", "anything")
# Starts lie so far from the middle of the safe set to its edge.
START = 0.98


class Attacked(NamedTuple):
    """What an attack found.

    Attributes:
        steps: Number of steps.
        guaranteed: Of these, steps at which the shield said that its proof holds.
        outside: Of these, steps that broke a limit.
        closest: The largest value of a limit at a guaranteed step, in half ranges beyond the nearer end.
    """

    steps: int
    guaranteed: int
    outside: int
    closest: float


def attack(name: str, plant: LinearPlant, certificate: Certificate, steps: int, seed: int = 0) -> Attacked:
    """Returns what at least so many attacked steps of a published plant behind its shield found.

    The disturbance is the worst for the next state along rows of the box in half of the episodes, along rows of the
    polytope in the others; noise is extreme.
    """
    P, rng = certificate.polytope, np.random.default_rng(seed)
    assert P is not None
    names = {"plant": plant, "channel": channel_of(name), "contract": contract_of_plant(name), "noise": "extreme"}
    taken = guaranteed = outside = 0
    closest, episode = -np.inf, 0
    while taken < steps:
        rows = P.rows if episode % 2 else plant.box
        env = gym.make_vec(
            "ncs_gym/LinearNCS-v0",
            num_envs=ENVIRONMENTS,
            max_episode_steps=EPISODE + 1,
            disturbance=AdversarialDisturbance(rows=rows),
            **names,
        )
        shield = VectorSafetyShield(env, certificate)
        starts = P.center + START * (P.sample_boundary(rng, ENVIRONMENTS) - P.center)
        shield.reset(seed=seed + episode, options={"state": starts})
        agent, ends = AGENTS[episode % len(AGENTS)], np.ones((ENVIRONMENTS, plant.m))
        for k in range(EPISODE):
            if agent == "low":
                ends = -np.ones_like(ends)
            elif agent == "either end" or (agent == "one end for ten steps" and k % 10 == 0):
                ends = rng.choice([-1.0, 1.0], ends.shape)
            elif agent == "anything":
                ends = rng.uniform(-1.0, 1.0, ends.shape)
            _, _, _, _, info = shield.step(ends.astype(np.float32))
            proved = info["shield_guaranteed"]
            guaranteed += int(proved.sum())
            outside += int((info["cost"][proved] > 0.0).sum())
            if proved.any():
                closest = max(closest, float(info["worst_constraint_values"][proved].max()))
        shield.close()
        taken, episode = taken + ENVIRONMENTS * EPISODE, episode + 1
    return Attacked(taken, guaranteed, outside, closest)
