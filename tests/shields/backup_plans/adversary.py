"""What tests use to drive a plant out of its box under mode "lookahead": it knows the plan and where it is weakest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ncs_gym import Channel, Ellipsoid, batch_reactor, cart_pole, truck_trailer
from ncs_gym.network.contract import contract_of
from shields import SafetyShield
from tests.certificates import certificate_of
from tests.plants import random_plant
from tests.shields.attacks.extremes import CHANNELS, ExtremalNoise, policy

EDGES = {
    "constant delay": Channel(delay=3),
    "longest gap each time": Channel(loss=1.0, max_consecutive_losses=3),
    "overtaking": Channel(loss=0.4, max_consecutive_losses=1, jitter=2),
}
OUTSIDE = "a state that is guaranteed lies outside the box"
# Plant, horizon.
STABLE = {
    "truck": (truck_trailer(), 3),
    "cruise": (truck_trailer(mass=4000.0), 3),
    "n=3 m=2": (replace(random_plant(1, 3, 2, 1), u_max=0.6), 5),
    "n=4 m=1": (replace(random_plant(2, 4, 1, 2), u_max=0.1), 4),
    "n=6 m=2": (replace(random_plant(5, 6, 2, 3), u_max=0.2), 4),
}
UNSTABLE = {
    "cart-pole": (cart_pole(), 12),
    "cart-pole, position and angle": (cart_pole(full_state=False), 8),
    "batch reactor": (batch_reactor(), 6),
}
CASES = [(name, channel) for name in STABLE for channel in CHANNELS]
CASES += [(name, channel) for name in UNSTABLE for channel in EDGES]
# The same with a certificate whose polytope is where plans end.
IN_POLYTOPE = ", polytope"
CASES += [(name + IN_POLYTOPE, "overtaking") for name in UNSTABLE] + [("n=6 m=2" + IN_POLYTOPE, "bursts")]


def case(name: str, channel: str):
    """Plant, horizon, channel and contract."""
    name = name.removesuffix(IN_POLYTOPE)
    if name in STABLE:
        return *STABLE[name], CHANNELS[channel], None
    edge = EDGES[channel]
    return *UNSTABLE[name], edge, contract_of(edge)


def box_ellipsoid(plant, share: float) -> Ellipsoid:
    """An ellipsoid in the box that reaches a fraction of each half-width; far larger than S where S is small."""
    return Ellipsoid(share**2 * np.diag(plant.half_widths**2))


class WeakestPoint:
    """The disturbance that is worst for the plan under way: for the row and the step with the least room.

    Every other time it pushes the end of the plan out of the safe set instead.
    """

    def __init__(self):
        self.shield: SafetyShield | None = None

    def __call__(self, rng, plant, nominal_next):
        stored = self.shield._monitored._stored if self.shield is not None else []
        bound, center, power, spread = plant.nominal_disturbance, nominal_next, np.eye(plant.n), 0.0
        values, pulled = [plant.box_rows @ center], [plant.box_rows]
        rooms = [1.0 - np.abs(plant.box_rows @ center)]
        for u in stored:
            center, power = plant.A @ center + plant.B @ u, plant.A @ power
            spread = spread + bound.support(plant.box_rows @ power)
            values.append(plant.box_rows @ center)
            pulled.append(plant.box_rows @ power)
            rooms.append(1.0 - np.abs(plant.box_rows @ center) - spread)
        if self.shield is not None and rng.random() < 0.5:
            polytope = self.shield.certificate.polytope
            if polytope is None:
                return bound.extreme_point(power.T @ self.shield.certificate.M @ center)
            rooms = 1.0 - polytope.F @ center - bound.support(polytope.F @ power)
            return bound.extreme_point(power.T @ polytope.F[np.argmin(rooms)])
        step, row = np.unravel_index(np.argmin(rooms), np.shape(rooms))
        return bound.extreme_point(np.copysign(1.0, values[step][row]) * pulled[step][row])


def extremal_env(name: str, channel: str, share: float = 0.95, **settings):
    """A shielded environment whose first error, sensor noise and disturbances lie on the boundaries of their sets."""
    plant, horizon, network, contract = case(name, channel)
    adversary = WeakestPoint()
    inner = ExtremalNoise(
        plant, network, disturbance=adversary, contract=contract, initial_set=box_ellipsoid(plant, share)
    )
    certificate = certificate_of(plant, contract, "polytope" if name.endswith(IN_POLYTOPE) else "ellipsoid")
    env = SafetyShield(inner, certificate, mode="lookahead", horizon=horizon, **settings)
    adversary.shield = env
    return env


def attack(env: SafetyShield, policy_name: str, seed: int, episodes: int, steps: int) -> dict[str, float]:
    """What happened; fails if a state that was guaranteed is outside the box, or a guarantee that held is lost."""
    rng = np.random.default_rng(seed)
    act = policy(policy_name, env, rng)
    counts = {"steps": 0, "guaranteed": 0, "stored": 0, "planned": 0, "outside S": 0, "closest": 0.0, "starts": 0}
    for episode in range(episodes):
        _, info = env.reset(seed=seed * 1000 + episode)
        held = False
        counts["starts"] += info["shield_guaranteed"] and not env.certificate.safe_set.contains(info["state"])
        for _ in range(int(rng.integers(1, steps + 1))):  # resets in mid-plan
            before = info["shield_plan_length"]
            *_, info = env.step(act(info))
            assert not info["assumption_violated"]
            assert info["shield_guaranteed"] or not held, info["shield_reason"]
            held = info["shield_guaranteed"]
            counts["steps"] += 1
            counts["guaranteed"] += held
            counts["planned"] += info["shield_plan_length"] > 0
            counts["stored"] += info["shield_plan_length"] == before - 1
            if held:
                worst = info["constraint_values"].max()
                assert worst <= 0.0, OUTSIDE
                counts["closest"] = max(counts["closest"], 1.0 + worst)
                counts["outside S"] += not env.certificate.safe_set.contains(info["state"])
    return counts
