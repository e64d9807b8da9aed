"""Tries to drive a shielded plant out of its safe set with everything the assumptions allow."""

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import AdversarialDisturbance, Channel, Ellipsoid, GilbertElliott, LinearPlant, NCSEnv, truck_trailer
from shields import Certificate, SafetyShield, synthesize
from tests.plants import random_plant

CHANNELS = {
    "blackout": Channel(loss=1.0),
    "bursts": Channel(loss=GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.1), quantization_step=0.05),
    "overtaking": Channel(loss=0.2, quantization_step=0.05, send_period=2, delay=1, jitter=3),
}
CERTIFICATES: dict[str, Certificate] = {}


def certificate_of(plant: LinearPlant) -> Certificate:
    return CERTIFICATES.setdefault(plant.fingerprint, synthesize(plant))


class ExtremalNoise(NCSEnv):
    """Every bound is attained: sensor noise and first estimate on the boundary of theirs."""

    def _measure(self):
        return self.plant.H @ self._state + self.plant.sensor_noise.bound.sample_boundary(self.np_random)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        start = (1 - 1e-12) * self.initial_set.sample_boundary(self.np_random)
        _, info = super().reset(options={"state": start})
        self.estimator.reset(start + self.plant.initial_noise.bound.sample_boundary(self.np_random))
        info["estimate"] = self.estimator.belief.mean.copy()
        info["estimation_error"] = info["estimate"] - start
        return self._observation(), info


def policies(env: SafetyShield, rng: np.random.Generator):
    """Actions from the info: random, constant, and steepest ascent of the next state's level."""
    plant, M = env.filter.plant, env.certificate.M
    push = plant.B.T @ M @ plant.A

    def outwards(info):
        return np.sign(push @ info["estimate"] + 1e-12 * rng.standard_normal(plant.m)).astype(np.float32)

    return {
        "random": lambda info: rng.uniform(-1, 1, plant.m).astype(np.float32),
        "constant": lambda info: np.ones(plant.m, np.float32),
        "outwards": outwards,
        "gain_turned_round": lambda info: (
            (-env.certificate.K @ info["estimate"] * 1e3).clip(-plant.u_max, plant.u_max) / plant.u_max
        ),
    }


def attack(plant, channel, disturbance, mode, policy, seed, steps=200):
    """Largest level of the true state, largest gauge of the error in its ellipsoid, and interventions."""
    certificate = certificate_of(plant)
    env = SafetyShield(
        ExtremalNoise(plant, channel, disturbance=disturbance, initial_set=certificate.safe_set), certificate, mode=mode
    )
    act = policies(env, np.random.default_rng(seed))[policy]
    _, info = env.reset(seed=seed)
    level = error = 0.0
    for _ in range(steps):
        *_, info = env.step(act(info))
        assert info["shield_guaranteed"], info["shield_reason"]
        level = max(level, certificate.safe_set.gauge(info["state"]))
        error = max(error, Ellipsoid(info["error_shape"]).gauge(info["estimation_error"]))
    return level, error, info["episode_interventions"]


@pytest.mark.parametrize("mode", ["project", "switch"])
@pytest.mark.parametrize("policy", ["random", "constant", "outwards", "gain_turned_round"])
@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("mass", [1000.0, 4000.0])
def test_truck_trailer_never_leaves_its_safe_set(mass, channel, policy, mode):
    plant = truck_trailer(mass=mass)
    harmful = AdversarialDisturbance(certificate_of(plant).M)
    for seed, disturbance in enumerate((harmful, "adversarial")):
        level, error, _ = attack(plant, CHANNELS[channel], disturbance, mode, policy, seed)
        assert level <= 1.0
        assert error <= 1.0


@pytest.mark.parametrize("mode", ["project", "switch"])
@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("seed", range(8))
def test_random_plants_with_partial_measurements_never_leave_their_safe_set(seed, channel, mode):
    n, m = 2 + seed % 3, 1 + seed % 2
    plant = random_plant(seed, n, m, p=n - 1)
    harmful = AdversarialDisturbance(certificate_of(plant).M)
    level, error, _ = attack(plant, CHANNELS[channel], harmful, mode, "outwards", seed)
    assert level <= 1.0
    assert error <= 1.0


def test_the_attack_is_strong_enough_to_come_close():
    # Otherwise the tests above would prove nothing: it reaches the edge of S and of the error ellipsoid ...
    plant = truck_trailer(mass=4000.0)
    harmful = AdversarialDisturbance(certificate_of(plant).M)
    level, error, interventions = attack(plant, CHANNELS["blackout"], harmful, "project", "outwards", 0, 1000)
    assert level > 0.98
    assert error > 0.8
    assert interventions > 300


def test_the_same_attack_leaves_the_safe_set_without_a_shield():
    # ... and breaks the bare plant at once.
    plant = truck_trailer(mass=4000.0)
    certificate = certificate_of(plant)
    env = ExtremalNoise(plant, disturbance=AdversarialDisturbance(certificate.M), initial_set=certificate.safe_set)
    _, info = env.reset(seed=0)
    push = plant.B.T @ certificate.M @ plant.A
    levels = []
    for _ in range(50):
        *_, info = env.step(np.sign(push @ info["estimate"]).astype(np.float32))
        levels.append(certificate.safe_set.gauge(info["state"]))
    assert max(levels) > 1.5


def test_extremal_noise_raises_no_false_alarm():
    plant = truck_trailer(mass=4000.0, H=np.array([[1.0, 0.0]]))
    env = ExtremalNoise(plant, CHANNELS["overtaking"], disturbance="sphere")
    env.reset(seed=0)
    for _ in range(4000):
        assert not env.step(env.action_space.sample())[4]["assumption_violated"]


def test_long_shielded_run_through_the_registered_environment_has_no_violation():
    plant = truck_trailer(mass=4000.0)
    env = SafetyShield(gym.make("ncs_gym/TruckTrailerCruise-v0", disturbance="adversarial"), certificate_of(plant))
    rng = np.random.default_rng(0)
    for seed in range(10):
        env.reset(seed=seed)
        for _ in range(200):
            *_, info = env.step(rng.choice([-1.0, 1.0], 1).astype(np.float32))
        assert info["is_success"] == 1.0
