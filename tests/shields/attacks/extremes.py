"""What tests use to drive a shielded plant out of its safe set, with everything the assumptions allow."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from unittest import mock

import numpy as np

from ncs_gym import (
    AdversarialDisturbance,
    Channel,
    ChannelContract,
    GilbertElliott,
    LinearPlant,
    NCSEnv,
    truck_trailer,
)
from ncs_gym.uncertainty.shape_matrices import INCLUSION_ROUNDING
from shields import SafetyFilter, SafetyShield
from tests.certificates import certificate_of
from tests.plants import random_plant

CHANNELS = {
    "perfect": Channel(),
    "blackout": Channel(loss=1.0),
    "bursts": Channel(loss=GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.1), quantization_step=0.05),
    "overtaking": Channel(loss=0.2, quantization_step=0.05, send_period=2, delay=1, jitter=3),
}
TRUCKS = {
    "1000 kg": truck_trailer(),
    "4000 kg": truck_trailer(mass=4000.0),
    "4000 kg, position only": truck_trailer(mass=4000.0, H=np.array([[1.0, 0.0]])),
}
# n = 2..8, m = 1..3, p < n; inputs so weak that the shield lets some through and overrides others.
RANDOM = {
    f"n={n} m={m} p={p}": replace(random_plant(seed, n, m, p), u_max=u_max)
    for seed, (n, m, p, u_max) in enumerate(
        (
            (2, 1, 1, 0.2),
            (3, 2, 1, 0.5),
            (4, 3, 2, 0.1),
            (5, 1, 3, 0.2),
            (6, 2, 3, 0.2),
            (7, 3, 5, 0.08),
            (8, 3, 4, 0.16),
        )
    )
}
POLICIES = ("random", "constant", "outwards", "gain_turned_round", "searching")


class ExtremalNoise(NCSEnv):
    """Every bound is attained: first estimate and sensor noise lie on the boundary of theirs.

    Every other sample the noise points where the error points already, so that the filter goes on believing it.
    """

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self._process.measure = self._extreme_sample
        self._noise: list[np.ndarray] = []

    def _extreme_sample(self, rng, state):
        bound = self.plant.sensor_noise.bound
        stubborn = self.plant.H @ (self.estimator.estimate.mean - state)
        v = bound.extreme_point(stubborn) if rng.random() < 0.5 else bound.sample_boundary(rng)
        self._noise.append(v)
        return self.plant.H @ state + (1 - 1e-12) * v

    def smallest_noise(self) -> float:
        """Returns the smallest gauge of all sensor noise so far in its bound; 1 if there was no sample."""
        noise = np.reshape(self._noise, (-1, self.plant.H.shape[0]))
        return float(np.min(self.plant.sensor_noise.bound.gauge(noise), initial=1.0))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        start = (1 - 1e-12) * self.initial_set.sample_boundary(self.np_random)
        _, info = super().reset(options={"state": start})
        self.estimator.reset(start + self.plant.initial_noise.bound.sample_boundary(self.np_random))
        self._estimate = self._predicted_estimate()
        info["estimate"] = self._estimate[0].copy()
        info["estimation_error"] = self.estimator.estimate.mean - start
        return self._observation(), info


def policy(name: str, env: SafetyShield, rng: np.random.Generator):
    """Actions from the info: random, constant, steepest ascent, or a search for what the shield lets through."""
    plant, certificate = env.filter.plant, env.certificate
    push = plant.B.T @ certificate.M @ plant.A

    def outwards(info):
        return np.sign(push @ info["estimate"] + 1e-12 * rng.standard_normal(plant.m)).astype(np.float32)

    def searching(info):
        """The proposal after which the next state is expected farthest out: no gradient, the shield as a black box."""
        corners = rng.integers(-1, 2, (4, plant.m)).astype(np.float64)
        estimates, alike = np.tile(info["estimate"][:, None], 4), np.zeros(4, np.int64)
        errors = env.filter.errors_of(info["error_shape"]).batch().of(alike)
        inputs = env.filter.decide_columns(estimates, errors, plant.u_max[:, None] * corners.T).input
        nominal = plant.A @ estimates + plant.B @ inputs
        return corners[int(np.argmax((nominal * (certificate.M @ nominal)).sum(axis=0)))].astype(np.float32)

    return {
        "random": lambda info: rng.uniform(-1, 1, plant.m).astype(np.float32),
        "constant": lambda info: np.ones(plant.m, np.float32),
        "outwards": outwards,
        "gain_turned_round": lambda info: (
            (-certificate.K @ info["estimate"] * 1e3).clip(-plant.u_max, plant.u_max) / plant.u_max
        ),
        "searching": searching,
    }[name]


@cache
def filter_of(certificate, plant, mode, horizon=None) -> SafetyFilter:
    """The filter of a mode, whose certificate is verified once per process: neither it nor the plant can change."""
    return SafetyFilter(certificate, plant, mode, horizon)


def shielded(inner: NCSEnv, certificate, mode) -> SafetyShield:
    """A shield around an environment, with the filter of all attacks on its plant in this mode."""
    with mock.patch("shields.runtime.wrapper.SafetyFilter", filter_of):
        return SafetyShield(inner, certificate, mode=mode)


def largest_gauge(shapes: np.ndarray, points: np.ndarray) -> float:
    """The largest sqrt(z' P^-1 z) of points (T, n), each in its own ellipsoid, shapes (T, n, n)."""
    extents = np.sqrt(np.diagonal(shapes, axis1=1, axis2=2))
    points = points / extents
    solved = np.linalg.solve(shapes / (extents[:, :, None] * extents[:, None, :]), points[..., None])[..., 0]
    return float(np.sqrt((points * solved).sum(axis=1)).max())


def are_inside(inner: np.ndarray, outer: np.ndarray) -> bool:
    """Whether every E(inner) is a proper subset of its E(outer), (T, n, n), as `is_inside` decides it one by one."""
    extents = np.sqrt(np.diagonal(outer, axis1=1, axis2=2))
    values = np.linalg.eigvalsh((outer - inner) / (extents[:, :, None] * extents[:, None, :]))
    return bool((values[:, 0] > INCLUSION_ROUNDING * values.shape[1] * values[:, -1]).all())


def attack(plant, channel, disturbance, mode, policy_name, seed, steps, contract=None):
    """Largest level of the true state, largest gauge of the error in its ellipsoid, and interventions.

    Fails if the shield ever doubts its proof, or the running ellipsoid leaves the certified one of its age: every
    assumption holds. What needs no answer during the episode is checked for all its steps at once at its end.
    """
    certificate = certificate_of(plant, contract)
    inner = ExtremalNoise(plant, channel, disturbance=disturbance, initial_set=certificate.safe_set, contract=contract)
    env = shielded(inner, certificate, mode)
    act = policy(policy_name, env, np.random.default_rng(seed))
    seen = {name: [] for name in ("state", "estimation_error", "error_shape", "measurement_age")}
    _, info = env.reset(seed=seed)
    for _ in range(steps):
        *_, info = env.step(act(info))
        assert info["shield_guaranteed"], info["shield_reason"]
        assert not info["assumption_violated"]
        assert not info["contract_broken"]
        for name, values in seen.items():
            values.append(info[name])
    states, errors, shapes, ages = map(np.array, seen.values())
    assert inner.smallest_noise() > 0.999
    certified = np.array([inner.error_set.shape_at(age) for age in range(ages.max() + 1)])
    assert are_inside(shapes, (1 + 1e-12) * certified[ages])
    level = float(certificate.safe_set.gauge(states).max())
    return level, largest_gauge(shapes, errors), info["episode_interventions"]


def harmful(plant: LinearPlant, contract: ChannelContract | None = None) -> AdversarialDisturbance:
    """The disturbance that pushes the next state farthest out of S."""
    return AdversarialDisturbance(certificate_of(plant, contract).M)
