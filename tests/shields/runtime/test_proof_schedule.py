"""Who proves x_j and the way to it: the table in docs/shield_proof.md, by brute force in continuous time.

The plant swings once around within a step, so that ways leave the box between samples that are inside.
"""

from __future__ import annotations

from functools import cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.linalg import expm

from ncs_gym import Channel, LinearPlant, Packet
from ncs_gym.network.downlink import downlink_protocol
from shields.runtime.guard import GuaranteeMonitor
from shields.runtime.safety_filter import Decision
from tests.certificates import certificate_of
from tests.plants import swinging
from tests.product import (
    altered,
    belief,
    safe_loop,
    safety_filter,
    staying,
    vector_env,
    vector_shield,
)

KEEPING = ("project", "switch", "boundary", "lookahead")
STEPS = 8
# In the box, some in the safe set and some not, at rest and so fast that the swing leaves the box.
STARTS = np.array(list(product((-0.8, -0.3, 0.0, 0.4), (-7.5, -6.5, -3.0, 0.0, 4.0, 7.0, 7.9))))


@cache
def swing() -> LinearPlant:
    return swinging(damping=0.3, u_max=0.9)


@cache
def certificate() -> Any:
    return certificate_of(swing())


@cache
def times() -> np.ndarray:
    """[A_tau B_tau] at 201 times of a step, by scipy."""
    G = np.pad(swing().model.continuous, ((0, 1), (0, 0)))
    return np.array([expm(G * tau)[:2] for tau in np.linspace(0.0, swing().dt, 201)])


def worst_until_next(x: np.ndarray, u: np.ndarray) -> float:
    """The largest |c x(t)| until the next sample, without a disturbance, for a row c of the box."""
    return float(np.abs(swing().box @ (times() @ np.concatenate([x, u])).T).max())


class Trace(NamedTuple):
    """What happened in an episode: flags and states of x_0 .. x_k, and the worst of the way that begins at each."""

    flags: list[bool]
    states: list[np.ndarray]
    ways: list[float]


def settings(c: int) -> dict[str, Any]:
    downlink = Channel(delay=c) if c else None
    return {"plant": swing(), "channel": Channel(), "downlink": downlink, "terminate_on_violation": False}


def follow_vector(mode: str, c: int, starts: np.ndarray) -> list[Trace]:
    env = vector_shield(vector_env(num_envs=len(starts), **settings(c)), certificate(), mode, on_unproved="ignore")
    rng, traces = np.random.default_rng(0), [Trace([], [], []) for _ in starts]
    _, info = env.reset(seed=0, options={"state": starts})
    for _ in range(STEPS):
        before = info
        *_, info = env.step(rng.choice([-1.0, 0.3, 1.0], (len(starts), 1)).astype(np.float32))
        for e, trace in enumerate(traces):
            trace.flags.append(bool(before["shield_guaranteed"][e]))
            trace.states.append(before["state"][e])
            trace.ways.append(worst_until_next(before["state"][e], info["input"][e]))
    return traces


def follow_loop(mode: str, c: int, start: np.ndarray, *, exact: bool = True, other_input_at: int = STEPS) -> Trace:
    """A plant of its own behind a `SafeLoop`.

    `exact`: the start is given besides the first estimate. From `other_input_at` on, something else is applied once.
    """
    plant, rng = swing(), np.random.default_rng(0)
    downlink = Channel(delay=c) if c else None
    loop = safe_loop(certificate(), plant, Channel(), mode, downlink=downlink, on_unproved="ignore")
    x, pending, trace, u = start, [np.zeros(1)] * c, Trace([], [], []), None
    loop.start(start, initial_set=start if exact else None)
    for step in range(STEPS):
        loop.receive([Packet(step, x.copy(), loop.episode)] if step else [], applied=u if step else None)
        trace.flags.append(loop.guaranteed)
        trace.states.append(x)
        pending.append(loop.decide(rng.choice([-1.0, 0.3, 1.0], 1)).input)
        u = pending.pop(0)
        if step == other_input_at:
            u = plant.largest_input - u
        trace.ways.append(worst_until_next(x, u))
        x = plant.A @ x + plant.B @ u
    return trace


def false_claims(trace: Trace, mode: str, first: int = 0) -> list[str]:
    """What is guaranteed and not so; ways before step `first` do not count, since no loop saw them."""
    wrong, safe_set = [], certificate().safe_set
    for k, guaranteed in enumerate(trace.flags):
        if guaranteed:
            if k > first and trace.ways[k - 1] > 1.0:
                wrong.append(f"the way to x_{k} leaves the box")
            if mode != "lookahead" and safe_set.gauge(trace.states[k][None])[0] > 1.0:
                wrong.append(f"x_{k} is not in the safe set")
            if mode in KEEPING and max(trace.ways[k:]) > 1.0:
                wrong.append(f"a way after x_{k} leaves the box")
    return wrong


@pytest.mark.cases(5)
@pytest.mark.parametrize("c", [0, 1, 2, 3])
@pytest.mark.parametrize("mode", [*KEEPING, "monitor"])
def test_what_is_guaranteed_is_so_at_all_times_in_every_kind_of_loop(mode, c):
    left = regained = 0
    for e, trace in enumerate(traces := follow_vector(mode, c, STARTS)):
        assert false_claims(trace, mode) == [], f"vector, from {STARTS[e]}"
        left += trace.ways[0] > 1.0 and np.abs(swing().box @ trace.states[1]).max() <= 1.0
        regained += trace.flags[-1] and not trace.flags[0]
    if c:  # without a downlink it is the shield that decides the first way
        assert left > 0
    assert sum(trace.flags[0] for trace in traces) > 0
    assert regained > 0 or mode == "monitor"
    for start in STARTS[::6]:
        for exact in (True, False):
            trace = follow_loop(mode, c, start, exact=exact)
            assert false_claims(trace, mode) == [], f"loop, from {start}, {exact}"


@pytest.mark.parametrize("c", [0, 1, 2])
def test_nobody_proves_anything_after_another_input(c):
    trace = follow_loop("project", c, np.zeros(2), other_input_at=2)
    assert trace.flags == [True] * 3 + [False] * (STEPS - 3)


NOTHING, ESTIMATE, DECISION = range(3)


def as_the_table_says(proofs: np.ndarray, c: int, on_grid: bool) -> np.ndarray:
    """Flags of steps 0.., shape (K, N): everything from x_k to x_k+c is proved, and on a grid the ways that lead there.

    `proofs`, shape (K + c, N), says what proves x_j: of the first c its estimate, or what also proves the way from it;
    of later ones the estimate, or the decision that also proves the way to it from where something did.
    """
    known = proofs != NOTHING
    ways = np.ones(proofs.shape, np.bool_)
    if on_grid:
        ways[1 : c + 1] = proofs[:c] == DECISION
        ways[c + 1 :] = (proofs[c + 1 :] == DECISION) & known[c:-1]
    proved = known & ways
    return np.array([proved[k : k + c + 1].all(axis=0) for k in range(len(proofs) - c)])


@pytest.mark.parametrize("c", [0, 1, 2, 3])
@pytest.mark.parametrize("points", [None, 32])
def test_flags_are_those_of_the_table_for_every_sequence_of_proofs(points, c):
    plant = swing() if points else altered(swing(), between_samples=None)
    shield = safety_filter(certificate_of(plant), plant, "switch")
    protocol = downlink_protocol(Channel(delay=c) if c else None, None)
    monitor, steps = GuaranteeMonitor(shield, protocol), 4
    proofs = np.array(list(product((NOTHING, ESTIMATE, DECISION), repeat=steps + c))).T
    expected = as_the_table_says(proofs, c, bool(points))

    def seen(proof: np.ndarray) -> tuple[Any, Any]:
        estimates = np.where(proof == ESTIMATE, 0.0, np.array([[0.95], [7.5]]))
        errors = shield.errors_of_many(plant.initial_error.shape_matrix[None]).of(np.zeros(len(proof), np.intp))
        return belief(estimates, np.zeros(len(proof), np.bool_)), staying(errors)

    def inputs(proof: np.ndarray) -> Decision:
        passed = proof == DECISION
        return Decision(np.zeros((1, len(proof))), ~passed, passed, np.zeros_like(passed), passed, passed)

    every = np.ones(proofs.shape[1], np.bool_)
    state = monitor.start(proofs[c] == DECISION, *seen(proofs[c]))
    state = monitor.cover(state, [(each == DECISION, *seen(each)) for each in proofs[:c]])
    for k, flags in enumerate(expected):
        assert ((monitor.reasons(state, np.zeros(len(every))) == 0) == flags).all(), f"step {k}"
        if k + 1 < steps:
            proof = proofs[k + c + 1]
            state = monitor.advance(state, inputs(proof), every, every, *seen(proof))
    assert expected.any()
    assert not expected.all()
