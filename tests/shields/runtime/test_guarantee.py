"""What is proved, step by step: against a plain reference, for one loop and for many."""

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import Channel, Packet
from ncs_gym.ellipsoid import is_inside
from ncs_gym.plants.linear_plant import SIMULATED_REACH
from shields import SafetyFilter, certificate_for
from shields.runtime import Decision
from shields.runtime import guard as proof
from shields.runtime.guard import EXPLANATIONS, GuaranteeMonitor
from tests.certificates import certificate_of
from tests.product import belief, safe_loop, safety_filter, staying
from tests.shields.attacks.cases import RANDOM, TRUCKS


class Reference:
    """The proof of one loop, told as a story: what is asked of each step in turn."""

    def __init__(self, shield: SafetyFilter):
        self.shield, self.broken, self.inside, self.certified = shield, "", False, False

    @property
    def reason(self):
        if self.broken:
            return self.broken
        if not self.inside:
            return proof.NOT_KNOWN_INSIDE
        return "" if self.certified else proof.LARGE_ERROR

    def start(self, known_inside, *seen):
        self.broken, self.inside = "", known_inside
        self._observe(*seen)

    def step(self, passed, fallback, moved_once, same_input, *seen):
        self.inside = passed or (self.inside and self.certified and fallback)
        if not moved_once:
            self.broken = self.broken or proof.OTHER_STEPS
        elif not same_input:
            self.broken = self.broken or proof.OTHER_INPUT
        self._observe(*seen)

    def _observe(self, estimate, shape, alarm):
        if alarm:
            self.broken = self.broken or proof.ALARM
        usable = np.isfinite(estimate).all() and np.isfinite(shape).all() and np.linalg.eigvalsh(shape)[0] > -1e-12
        self.certified = False
        if not usable or np.abs(estimate).max() > 1e90:
            self.broken = self.broken or proof.UNUSABLE
            return
        plant = self.shield.plant
        if not (np.abs(estimate) + np.sqrt(np.diag(shape)) <= SIMULATED_REACH * plant.half_widths).all():
            self.broken = self.broken or proof.FAR_OUT
        self.certified = any(is_inside(shape, Sigma) for Sigma in self.shield.certificate.error_shapes)
        self.inside = self.inside or self.shield.knows_inside(estimate, shape)


def decision(passed, fallback):
    nothing = np.zeros(np.shape(passed))
    return Decision(np.zeros(1), nothing, passed, fallback, nothing, "")


@pytest.mark.cases(1)
@pytest.mark.parametrize("name", ["4000 kg", "n=4 m=3 p=2"])
def test_proofs_break_and_recover_as_the_reference_says_whatever_is_reported(name):
    plant, count, rng = (TRUCKS | RANDOM)[name], 200, np.random.default_rng(0)
    certificate = certificate_of(plant)
    shield, Sigma = safety_filter(certificate, plant), certificate.Sigma
    monitor, references = GuaranteeMonitor(shield), [Reference(shield) for _ in range(count)]
    shapes = np.array([0.2 * Sigma, Sigma, 1.1 * Sigma, -Sigma, 1e5 * np.eye(plant.n), np.full_like(Sigma, np.nan)])
    known = staying(shield.errors_of_many(shapes))
    state, states, seen = None, [None] * count, set()
    for step in range(14):
        rare = lambda share: rng.random(count) < share  # noqa: E731
        begins = rare(0.1) if step else np.ones(count, np.bool_)
        once, same, passed, fallback, inside, alarm = (
            ~rare(0.03),
            ~rare(0.03),
            rare(0.7),
            rare(0.7),
            rare(0.5),
            rare(0.03),
        )
        drawn = rng.choice(6, count, p=[0.5, 0.3, 0.14, 0.02, 0.02, 0.02])
        sizes = rng.choice([0.3, 1.0, 1.5, 1e7, 1e120, np.nan], count, p=[0.3, 0.3, 0.34, 0.02, 0.02, 0.02])
        estimates = certificate.safe_set.sample_boundary(rng, count) * sizes[:, None]
        report = belief(estimates.T, alarm), known.of(drawn)
        started = monitor.start(inside, *report)
        if state is None:
            state = started
        else:
            advanced = monitor.advance(state, decision(passed, fallback), once, same, *report)
            state = type(state)(*(np.where(begins, new, old) for new, old in zip(started, advanced, strict=True)))
        reasons = [EXPLANATIONS[code] for code in monitor.reasons(state)]
        for e, reference in enumerate(references):
            observed = estimates[e], shapes[drawn[e]], bool(alarm[e])
            alone = belief(estimates[e], bool(alarm[e])), staying(shield.errors_of(shapes[drawn[e]]))
            if begins[e]:
                reference.start(bool(inside[e]), *observed)
                states[e] = monitor.start(bool(inside[e]), *alone)
            else:
                facts = bool(passed[e]), bool(fallback[e]), bool(once[e]), bool(same[e])
                reference.step(*facts, *observed)
                states[e] = monitor.advance(states[e], decision(*facts[:2]), *facts[2:], *alone)
            assert reasons[e] == reference.reason
            assert EXPLANATIONS[monitor.reasons(states[e])] == reference.reason
        seen |= set(reasons)
    never = {proof.OLD_SAMPLE, proof.LEFT_MODEL, proof.LATE_INPUT, proof.NO_DOWNLINK_CONTRACT}
    never |= {proof.NOT_CONFIRMED, proof.NOT_FINITE, proof.OTHER_EPISODE, proof.OUTSIDE_BOUND}
    assert seen == set(EXPLANATIONS) - never


@pytest.mark.parametrize("gaps", [(2, 4, 1, 1), (1, 1, 4, 1)])
def test_a_guarantee_that_returned_lasts_while_the_contract_is_kept(gaps):
    # Two steps after a sample the error lies in the certified set of three steps, one step later in none.
    env = gym.make("ncs_gym/BatchReactor-v0").unwrapped
    plant, contract = env.plant, env.certificate_contract
    channel = Channel(quantization_step=contract.quantization_step)
    loop = safe_loop(certificate_for(plant, contract), plant, channel, mode="switch", on_unproved="ignore")
    loop.start(np.zeros(plant.n), initial_set=np.zeros(plant.n))
    times = np.cumsum([*[1] * 6, 6, *gaps, *[2] * 20]).tolist()
    x, held, returned = np.zeros(plant.n), True, 0
    for step in range(1, times[-1] + 1):
        x = plant.A @ x + plant.B @ loop.decide(np.zeros(plant.m)).input
        before = loop.measurement_age
        loop.receive([Packet(step, plant.H @ x, loop.episode)] if step in times else [])
        assert loop.guaranteed or not held or max(loop.measurement_age, before) > contract.max_age
        returned += loop.guaranteed and not held
        held = loop.guaranteed
    assert held
    assert returned == 1
