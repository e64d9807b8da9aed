"""Certificates of families under attack: members at the corners and between, their equations by another route.

The campaign attacks the same families in every mode (cases.py); here members are chosen, and moved by hand.
"""

from functools import cache

import numpy as np
import pytest
from scipy.linalg import expm

from experiments.commands.attack import hostile_agents, starts, worst_case
from ncs_gym import Channel, ChannelContract, Ellipsoid, FunctionProcess, Packet
from ncs_gym.plants.family import Remainder
from ncs_gym.processes.plant_step import without_remainder
from ncs_gym.registration import CART_POLE_CHANNEL, CASE_STUDY_CHANNEL
from tests.certificates import certificate_of
from tests.plants import varying_cart_pole, varying_truck
from tests.product import altered, family_of, safe_loop, sampled_plant, vector_env, vector_shield

FAMILIES = {
    "truck": (varying_truck, {"channel": CASE_STUDY_CHANNEL}, "ellipsoid"),
    "cart-pole": (varying_cart_pole, {"channel": CART_POLE_CHANNEL, "contract": ChannelContract(4, 1e-4)}, "polytope"),
}
SIZES = [(24, 60), pytest.param(120, 400, marks=pytest.mark.slow)]


def derivatives(name, parameters):
    """[Ac, Bc] of the plants, written down again."""
    if name == "truck":
        (mass,) = parameters
        return np.array([[0.0, 1.0, 0.0], [-4500.0 / mass, -4600.0 / mass, 1.0]])
    mass, length = parameters
    model = np.zeros((4, 5))
    model[0, 1] = model[2, 3] = model[1, 4] = 1.0
    model[1, 2], model[3, 2] = -9.81 * mass, 9.81 * (1.0 + mass) / length
    model[3, 4] = -1.0 / length
    return model


def members(family, count, rng):
    """Three quarters at the corners, the others anywhere between, shape (count, k)."""
    low, high = family.ranges
    share = np.where(np.arange(count)[:, None] % 4 == 0, rng.random((count, len(low))), rng.integers(0, 2, (count, 1)))
    flipped = np.where(rng.random(share.shape) < 0.3, 1.0 - share, share)
    return low + flipped * (high - low)


def attacked(name, plant, certificate, count, steps, mode="project", seed=0, process=None):
    """Counts of an attack on a certificate, of members that are chosen; their steps are compared with the equations."""
    rng, settings, family = np.random.default_rng(seed), FAMILIES[name][1], FAMILIES[name][0]().remainder.family
    many = vector_env(count, plant=plant, process=process, **settings, **worst_case(certificate))
    shield = vector_shield(many, certificate, mode, on_unproved="ignore")
    chosen = members(family, count, rng)
    fixed = {"parameters": {each: chosen[:, k] for k, each in enumerate(family.names)}}
    begun = {"state": starts(certificate, rng, count)}
    _, info = shield.reset(seed=seed, options=begun if process else begun | fixed)
    act, declared = hostile_agents(certificate, plant, count, rng), without_remainder(plant).disturbance
    m, n = plant.m, plant.n
    truth = [expm(plant.dt * np.vstack([derivatives(name, each), np.zeros((m, n + m))]))[:n] for each in chosen]
    held = outside = left = unsafe = alarms = 0
    for _ in range(steps):
        before = info["state"]
        *_, info = shield.step(act(info["estimate"]))
        proved, broken = info["shield_guaranteed"], info["cost"] > 0.0
        held, outside = held + np.count_nonzero(proved), outside + np.count_nonzero(proved & broken)
        left += np.count_nonzero(proved & (certificate.safe_set.gauge(info["state"]) > 1.0))
        unsafe, alarms = unsafe + np.count_nonzero(broken), alarms + np.count_nonzero(info["assumption_violated"])
        if process is None:
            joint = np.hstack([before, info["input"]])
            moved = info["state"] - np.einsum("eij,ej->ei", np.array(truth), joint)
            assert declared.gauge(moved).max() <= 1.0 + 1e-6  # what the plants declare, and no more
    return {"held": held, "outside": outside, "left": left, "unsafe": unsafe, "alarms": alarms}


def certified(name, plant=None):
    make, settings, safe_set = FAMILIES[name]
    return certificate_of(plant or make(), settings.get("contract"), safe_set)


@pytest.mark.parametrize(("count", "steps"), SIZES)
@pytest.mark.parametrize("mode", ["project", "lookahead"])
@pytest.mark.parametrize("name", FAMILIES)
def test_no_member_leaves_what_is_certified_for_all(name, mode, count, steps):
    counts = attacked(name, FAMILIES[name][0](), certified(name), count, steps, mode)
    assert counts["outside"] == counts["alarms"] == 0
    if mode != "lookahead":
        assert counts["left"] == 0
        assert counts["held"] == count * steps


@pytest.mark.parametrize("name", FAMILIES)
def test_certificate_of_the_middle_alone_does_not_hold_and_that_is_seen(name):
    family = FAMILIES[name][0]()
    nothing = Remainder(Ellipsoid(np.zeros((family.n, family.n))), True, "nothing", family.remainder.family)
    bare = altered(family)
    object.__setattr__(bare, "remainder", nothing)  # nobody can make such a plant
    object.__setattr__(bare, "fingerprint", bare.digest())
    counts = attacked(name, bare, certified(name, bare), 24, 120)
    assert counts["alarms"] > 1000
    assert counts["outside"] == 0  # for an alarm ends the guarantee
    assert name != "truck" or counts["unsafe"] > 100


@pytest.mark.parametrize(("count", "steps"), SIZES)
def test_members_may_change_from_step_to_step(count, steps):
    plant, rng = varying_truck(), np.random.default_rng(5)

    def restless(x, u):
        models = [derivatives("truck", [mass]) for mass in rng.choice([3800.0, 4200.0], x.shape[1])]
        steps = [expm(plant.dt * np.vstack([model, np.zeros((1, 3))]))[:2] for model in models]
        return np.einsum("eij,je->ie", np.array(steps), np.concatenate([x, u]))

    process = FunctionProcess(restless, vectorized=True)
    counts = attacked("truck", plant, certified("truck"), count, steps // 2, process=process)
    assert counts["outside"] == counts["alarms"] == counts["left"] == 0
    assert counts["held"] == count * (steps // 2)


def gains():
    """The hull of three plants with limits of every kind: two gains, and other poles with one of them."""
    given = {"disturbance_bound": 0.01, "sensor_bound": 0.002, "initial_bound": 0.005, "du_max": 0.4}
    given |= {"state_limits": ([-0.6, -1.0], [1.0, 0.7]), "input_limits": (-0.5, 1.0)}
    given |= {"mixed_limits": [([0.0, 1.0], [0.5], -1.1, 1.1)]}
    moving = [([[0.9, 0.1], [0.0, 0.8]], 0.28), ([[0.9, 0.1], [0.0, 0.8]], 0.3), ([[0.89, 0.1], [0.01, 0.8]], 0.3)]
    return family_of(
        [sampled_plant((A, [[0.0], [gain]], np.eye(2), np.zeros((2, 1)), 0.1), **given) for A, gain in moving]
    )


@pytest.mark.parametrize(("count", "steps"), [(30, 60), pytest.param(200, 300, marks=pytest.mark.slow)])
def test_members_keep_limits_of_every_kind_behind_a_downlink(count, steps):
    plant, downlink = gains(), Channel(delay=1, loss=0.4, max_consecutive_losses=1)
    worst = {"disturbance": "adversarial", "noise": "extreme"}
    many = vector_env(count, plant=plant, channel=Channel(loss=0.4, delay=1), downlink=downlink, **worst)
    certificate = certificate_of(plant, many.certificate_contract, "polytope")
    shield = vector_shield(many, certificate, on_unproved="ignore")
    rng = np.random.default_rng(0)
    _, info = shield.reset(seed=0, options={"parameters": {"member": np.arange(count) % 3}})
    act, held, near, overridden = hostile_agents(certificate, plant, count, rng), 0, -1.0, 0
    for _ in range(steps):
        *_, info = shield.step(act(info["estimate"]))
        proved, worst = info["shield_guaranteed"], info["worst_constraint_values"].max(axis=1)
        assert not (proved & ((info["cost"] > 0.0) | info["assumption_violated"])).any()
        low, high = plant.input_ends
        assert ((low <= info["input"]) & (info["input"] <= high)).all()
        held, near = held + np.count_nonzero(proved), max(near, worst.max())
        overridden += np.count_nonzero(info["shield_intervened"])
    assert held == count * steps
    assert near > -0.5  # the shield is what keeps them away
    assert overridden > 0.1 * held


def tank(k):
    """A level with h' = 0.5 q - k h, in absolute coordinates, around where it rests with q = 0.8."""
    decay = np.exp(-0.5 * k)
    model = ([[decay]], [[0.5 * (1.0 - decay) / k]], [[1.0]], [[0.0]], 0.5)
    settings = {"state_limits": ([1.5], [2.5]), "input_limits": (0.0, 2.0), "offset": [0.0]}
    rests = {"operating_state": [0.4 / k], "operating_input": [0.8]}
    bounds = {"disturbance_bound": 0.01, "sensor_bound": 0.02, "initial_bound": 0.02}
    return sampled_plant(model, **settings, **rests, **bounds)


@cache
def varying_tank():
    return family_of(tank, {"k": (0.19, 0.21)}, monotone=True, at_rest=True)


@pytest.mark.cases(6)
@pytest.mark.parametrize("every", [1, 10])
@pytest.mark.parametrize("outward", [-1.0, 1.0])
@pytest.mark.parametrize("k", [0.19, 0.2, 0.21])
def test_a_tank_that_rests_elsewhere_keeps_its_levels(k, outward, every):
    plant = varying_tank()
    loop = safe_loop(certificate_of(plant, None, "polytope"), plant, Channel(delay=1), on_unproved="ignore")
    level, arrived, reached = 2.0, [], 0.0
    x0, u0 = plant.operating_state, plant.operating_input
    loop.start(level + 0.02 * outward - x0)
    for step in range(150):
        loop.receive(arrived)
        q = (loop.decide(1.0 + outward - u0).input + u0)[0]
        assert loop.guaranteed
        assert 1.5 <= level <= 2.5
        reached = max(reached, abs(level - 2.0))
        measured = level - 0.02 * outward - plant.H @ x0
        arrived = [Packet(step, measured, loop.episode)] if step % every == 0 else []
        level = level * np.exp(-0.5 * k) + q * 0.5 * (1.0 - np.exp(-0.5 * k)) / k + 0.01 * outward
    assert reached > 0.3
