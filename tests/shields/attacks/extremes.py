"""What tests use to drive a shielded plant out of its safe set, with everything the assumptions allow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ncs_gym import (
    AdversarialDisturbance,
    Channel,
    ChannelContract,
    Ellipsoid,
    GilbertElliott,
    LinearPlant,
    NCSEnv,
    truck_trailer,
)
from ncs_gym.uncertainty.ellipsoid import is_inside
from shields import SafetyShield
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

    def _extreme_sample(self, rng, state):
        bound = self.plant.sensor_noise.bound
        stubborn = self.plant.H @ (self.estimator.belief.mean - state)
        v = bound.extreme_point(stubborn) if rng.random() < 0.5 else bound.sample_boundary(rng)
        assert bound.gauge(v) > 0.999
        return self.plant.H @ state + (1 - 1e-12) * v

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        start = (1 - 1e-12) * self.initial_set.sample_boundary(self.np_random)
        _, info = super().reset(options={"state": start})
        self.estimator.reset(start + self.plant.initial_noise.bound.sample_boundary(self.np_random))
        self._belief = self._downlink.belief()
        info["estimate"] = self._belief[0].copy()
        info["estimation_error"] = self.estimator.belief.mean - start
        return self._observation(), info


def policy(name: str, env: SafetyShield, rng: np.random.Generator):
    """Actions from the info: random, constant, steepest ascent, or a search for what the shield lets through."""
    plant, certificate = env.filter.plant, env.certificate
    push = plant.B.T @ certificate.M @ plant.A

    def outwards(info):
        return np.sign(push @ info["estimate"] + 1e-12 * rng.standard_normal(plant.m)).astype(np.float32)

    def searching(info):
        """The proposal after which the next state is expected farthest out: no gradient, the shield as a black box."""
        estimate, shape = info["estimate"], info["error_shape"]
        corners = rng.integers(-1, 2, (4, plant.m)).astype(np.float64)
        inputs = [env.filter.decide(estimate, shape, plant.u_max * corner).input for corner in corners]
        nominal = [plant.A @ estimate + plant.B @ u for u in inputs]
        return corners[int(np.argmax([x @ certificate.M @ x for x in nominal]))].astype(np.float32)

    return {
        "random": lambda info: rng.uniform(-1, 1, plant.m).astype(np.float32),
        "constant": lambda info: np.ones(plant.m, np.float32),
        "outwards": outwards,
        "gain_turned_round": lambda info: (
            (-certificate.K @ info["estimate"] * 1e3).clip(-plant.u_max, plant.u_max) / plant.u_max
        ),
        "searching": searching,
    }[name]


def attack(plant, channel, disturbance, mode, policy_name, seed, steps, contract=None):
    """Largest level of the true state, largest gauge of the error in its ellipsoid, and interventions.

    Fails if the shield ever doubts its proof, or the running ellipsoid leaves the certified one of its age: every
    assumption holds.
    """
    certificate = certificate_of(plant, contract)
    inner = ExtremalNoise(plant, channel, disturbance=disturbance, initial_set=certificate.safe_set, contract=contract)
    env = SafetyShield(inner, certificate, mode=mode)
    act = policy(policy_name, env, np.random.default_rng(seed))
    level = error = 0.0
    errors: dict[tuple[bytes, int], Ellipsoid] = {}  # shapes recur
    _, info = env.reset(seed=seed)
    for _ in range(steps):
        *_, info = env.step(act(info))
        assert info["shield_guaranteed"], info["shield_reason"]
        assert not info["assumption_violated"]
        assert not info["contract_broken"]
        shape, age = info["error_shape"], info["measurement_age"]
        if (shape.tobytes(), age) not in errors:
            assert is_inside(shape, (1 + 1e-12) * inner.error_set.shape_at(age))
            errors[shape.tobytes(), age] = Ellipsoid(shape)
        level = max(level, certificate.safe_set.gauge(info["state"]))
        error = max(error, errors[shape.tobytes(), age].gauge(info["estimation_error"]))
    return level, error, info["episode_interventions"]


def harmful(plant: LinearPlant, contract: ChannelContract | None = None) -> AdversarialDisturbance:
    """The disturbance that pushes the next state farthest out of S."""
    return AdversarialDisturbance(certificate_of(plant, contract).M)
