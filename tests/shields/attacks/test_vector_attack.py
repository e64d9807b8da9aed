"""Attacks on the vector shield: thousands of environments at once, with every bound attained."""

from unittest import mock

import numpy as np
import pytest

from ncs_gym import Channel, NCSVectorEnv, batch_reactor, cart_pole
from ncs_gym.network.contract import contract_of
from ncs_gym.processes.plant_step import BlockSampler
from shields import VectorSafetyShield
from tests.certificates import certificate_of
from tests.shields.attacks.extremes import CHANNELS, RANDOM, TRUCKS, filter_of, harmful, largest_gauge

PLANTS = {**TRUCKS, **RANDOM}
UNSTABLE = {
    "cart-pole": cart_pole(),
    "cart-pole, position and angle": cart_pole(full_state=False),
    "batch reactor": batch_reactor(),
}
EDGES = {
    "constant delay": Channel(delay=3),
    "longest gap each time": Channel(loss=1.0, max_consecutive_losses=3),
    "overtaking": Channel(loss=0.4, max_consecutive_losses=1, jitter=2),
}
# Environments and steps of each attack in the ordinary suite and in the slow one.
SIZES = (40, 40), (680, 100)


class ExtremalVectorNoise(NCSVectorEnv):
    """First estimates and sensor noise lie on the boundary of their bounds, pulled in by what rounding takes."""

    def __init__(self, *arguments, **settings):
        super().__init__(*arguments, **settings)
        self._process.sensor_noise = BlockSampler(self._extreme_noise, self.num_envs)

    def _extreme_noise(self, rng, count):
        return (1.0 - 1e-12) * self.plant.sensor_noise.bound.sample_boundary(rng, count).T

    def _first(self, count):
        states, _ = super()._first(count)
        return states, (1.0 - 1e-12) * self.plant.initial_noise.bound.sample_boundary(self.np_random, count).T


def attack(plant, channel, contract, mode, policy, count, steps, seed):
    """Largest level of the true state, largest gauge of errors in their ellipsoids, and the share of overrides."""
    certificate = certificate_of(plant, contract)
    env = ExtremalVectorNoise(
        count,
        plant=plant,
        channel=channel,
        contract=contract,
        disturbance="sphere" if policy == "random" else harmful(plant, contract),
        initial_set=certificate.safe_set,
    )
    with mock.patch("shields.runtime.wrapper.SafetyFilter", filter_of):
        shield = VectorSafetyShield(env, certificate, mode)
    _, info = shield.reset(seed=seed)
    rng = np.random.default_rng(seed)
    worst = np.linalg.inv(np.linalg.cholesky(certificate.L))
    level = error = overridden = 0.0
    for _ in range(steps):
        actions = {
            "random": lambda: rng.uniform(-1, 1, (count, plant.m)),
            "outwards": lambda estimates: np.sign(estimates @ plant.A.T @ certificate.M @ plant.B),
            "gain turned round": lambda estimates: -(estimates @ certificate.K.T) * 1e3 / plant.u_max,
        }[policy](*(() if policy == "random" else (info["estimate"],)))
        *_, info = shield.step(actions)
        assert info["shield_guaranteed"].all(), set(info["shield_reason"])
        assert not info["assumption_violated"].any()
        assert not info["contract_broken"].any()
        level = max(level, float(np.linalg.norm(info["state"] @ worst.T, axis=1).max()))
        table, numbers = env.error_shapes
        error = max(error, largest_gauge(table.shapes[numbers], info["estimation_error"]))
        overridden += float(info["shield_intervened"].sum())
    return level, error, overridden / (count * steps)


def assert_safe(results):
    assert all(level <= 1.0 and error <= 1.0 + 1e-9 for level, error, _ in results)
    shares = [share for _, _, share in results]
    assert max(shares) > 0.0
    assert min(shares) < 1.0


POLICIES = {"random": "boundary", "outwards": "project", "gain turned round": "switch"}


def vector_attack_steps(suite):
    """Steps of all attacks in the ordinary suite (0) or in the slow one (1)."""
    count, steps = SIZES[suite]
    return (len(PLANTS) * len(CHANNELS) + len(UNSTABLE) * len(EDGES)) * len(POLICIES) * count * steps


@pytest.mark.parametrize(
    ("count", "steps"), [SIZES[0], pytest.param(*SIZES[1], marks=pytest.mark.slow)], ids=["some", "many"]
)
@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("name", PLANTS)
def test_no_environment_leaves_its_safe_set(name, channel, count, steps):
    results = [
        attack(PLANTS[name], CHANNELS[channel], None, mode, policy, count, steps, seed)
        for seed, (policy, mode) in enumerate(POLICIES.items())
    ]
    assert_safe(results)


@pytest.mark.parametrize(
    ("count", "steps"), [SIZES[0], pytest.param(*SIZES[1], marks=pytest.mark.slow)], ids=["some", "many"]
)
@pytest.mark.parametrize("channel", EDGES)
@pytest.mark.parametrize("name", UNSTABLE)
def test_no_unstable_plant_leaves_its_safe_set_while_the_contract_is_kept(name, channel, count, steps):
    contract = contract_of(EDGES[channel])
    assert contract.max_age <= 3
    results = [
        attack(UNSTABLE[name], EDGES[channel], contract, mode, policy, count, steps, seed)
        for seed, (policy, mode) in enumerate(POLICIES.items())
    ]
    assert_safe(results)


def test_the_attack_comes_close_and_would_see_an_exit():
    plant, channel = TRUCKS["4000 kg"], CHANNELS["bursts"]
    level, error, _ = attack(plant, channel, None, "project", "outwards", 200, 100, 0)
    assert level > 0.9
    assert error > 0.5
    with pytest.raises(AssertionError, match="not known to be in the safe set"):
        attack(plant, channel, None, "monitor", "outwards", 200, 100, 0)
