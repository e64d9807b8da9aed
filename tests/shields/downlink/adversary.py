"""What tests use to drive a plant out of its safe set when both of its channels go to the edge of their contracts."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from ncs_gym import Channel, ChannelContract, Ellipsoid, LinearPlant, batch_reactor, cart_pole, truck_trailer
from ncs_gym.network.contract import contract_of
from shields import Certificate, VectorSafetyShield
from tests.certificates import certificate_of
from tests.plants import random_plant
from tests.shields.attacks.extremes import harmful
from tests.shields.attacks.test_vector_attack import ExtremalVectorNoise

PLANTS = {
    "cruise": truck_trailer(mass=4000.0),
    "cruise, position only": truck_trailer(mass=4000.0, H=np.array([[1.0, 0.0]])),
    "n=4 m=3": random_plant(2, 4, 3, 2),
    "cart-pole": cart_pole(),
    "cart-pole, position and angle": cart_pole(full_state=False),
    "batch reactor": batch_reactor(),
}
POLICIES = {"random": "boundary", "outwards": "project", "gain turned round": "switch"}


def edges(age: int) -> dict[str, Channel]:
    """Channels that keep a contract and use all of it: late, lost as often in a row as allowed, overtaking."""
    return {
        "late": Channel(delay=age),
        "runs": Channel(loss=1.0, max_consecutive_losses=age),
        "overtaking": Channel(loss=0.5, max_consecutive_losses=1, jitter=age - 1),
    }


@dataclass(frozen=True)
class Case:
    """A plant behind two channels."""

    plant: LinearPlant
    uplink: Channel
    downlink: Channel

    @property
    def contract(self) -> ChannelContract | None:
        """That of the uplink; None for a stable plant."""
        return None if self.plant.spectral_radius < 1.0 else contract_of(self.uplink)

    @property
    def certificate(self) -> Certificate:
        """One that counts the steps of both channels."""
        if self.contract is None:
            return certificate_of(self.plant)
        ages = self.contract.max_age + contract_of(self.downlink).max_age
        return certificate_of(self.plant, ChannelContract(ages))

    def env(
        self, count: int, policy: str, start: float = 0.3, kind: type = ExtremalVectorNoise, **settings: Any
    ) -> Any:
        """Environments whose starts, first errors, noise and disturbances lie on the boundaries of their sets."""
        certificate = self.certificate
        contract = certificate.contract
        return kind(
            count,
            plant=self.plant,
            channel=self.uplink,
            contract=self.contract,
            downlink=self.downlink,
            disturbance="sphere" if policy == "random" else harmful(self.plant, contract),
            initial_set=Ellipsoid(start**2 * certificate.L),
            **settings,
        )


class UnawareVectorEnv(ExtremalVectorNoise):
    """Tells a shield nothing of its downlink: the estimate is that of now, as if inputs were applied at once."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self._protocol, self._certificate_contract = None, self.contract
        self._predicted_estimates = lambda: (self._estimator.mean, self._estimator.statistics)


@dataclass
class Outcome:
    """What came of an attack: of the true states, and of errors in the ellipsoids predicted for their time."""

    level: float = 0.0
    error: float = 0.0
    overridden: float = 0.0
    exits: int = 0
    steps: int = 0
    missing: int = 0


def actions_of(policy: str, case: Case, rng: np.random.Generator, estimates: np.ndarray) -> np.ndarray:
    """Actions, shape (N, m)."""
    plant, certificate = case.plant, case.certificate
    if policy == "random":
        return rng.uniform(-1, 1, (len(estimates), plant.m))
    if policy == "outwards":
        return np.sign(estimates @ plant.A.T @ certificate.M @ plant.B)
    return -(estimates @ certificate.K.T) * 1e3 / plant.u_max


def attack(
    case: Case, mode: str, policy: str, count: int, steps: int, seed: int, *, aware: bool = True, warm: int = 0
) -> Outcome:
    """Runs environments under attack; fails if a shield that knows its downlink ever doubts its proof."""
    certificate = case.certificate
    env = case.env(count, policy, kind=ExtremalVectorNoise if aware else UnawareVectorEnv)
    input_delay = env.single.downlink_protocol.input_delay
    shield = VectorSafetyShield(env, certificate, mode)
    _, info = shield.reset(seed=seed)
    rng, outcome = np.random.default_rng(seed), Outcome()
    root = np.linalg.inv(np.linalg.cholesky(certificate.L))
    inverses: dict[int, np.ndarray] = {}
    expected: deque = deque()
    for _ in range(steps):
        table, numbers = env.error_shapes
        expected.append((info["estimate"], numbers.copy(), table))
        *_, info = shield.step(actions_of(policy, case, rng, info["estimate"]))
        if aware:
            assert info["shield_guaranteed"].all(), set(info["shield_reason"])
            assert not info["assumption_violated"].any()
            assert not info["contract_broken"].any()
            assert not info["downlink_broken"].any()
        levels = np.linalg.norm(info["state"] @ root.T, axis=1)
        outcome.level = max(outcome.level, float(levels.max()))
        outcome.exits += int(np.count_nonzero(levels > 1.0))
        outcome.overridden += float(info["shield_intervened"].sum()) / (count * steps)
        outcome.steps += count
        if aware and len(expected) >= input_delay and input_delay > 0:
            outcome.error = max(outcome.error, _gauge(expected.popleft(), info["state"], inverses))
    return outcome


def _gauge(expected: tuple, states: np.ndarray, inverses: dict[int, np.ndarray]) -> float:
    """Largest gauge of the errors of estimates in the ellipsoids that were predicted for their time."""
    estimates, numbers, table = expected
    for number in np.unique(numbers).tolist():
        inverses.setdefault(number, np.linalg.inv(table.shapes[number]))
    each = np.stack([inverses[number] for number in numbers.tolist()])
    errors = estimates - states
    return float(np.einsum("ei,eij,ej->e", errors, each, errors).max()) ** 0.5
