"""What is said in advance of a contract that is exceeded, by simulation and linear programs of its own."""

from dataclasses import replace
from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from scipy.optimize import linprog

import shields
from ncs_gym import Channel, ChannelContract, Packet
from ncs_gym.estimation.error_bound import certified_error_set
from ncs_gym.estimation.estimator import Estimator
from shields import CertificateError, certificate_for
from shields.silence import MOST_STEPS
from shields.synthesis.faces import Extremes, Faces
from shields.synthesis.polytope_certificates import certified_polytope
from shields.synthesis.resting_point import at_operating_point
from tests.certificates import certificate_of
from tests.plants import small
from tests.product import linear_plant

CASES = ("CartPole", "CSTR", "Convoy", "Pendulum", "drifts", "open")


@cache
def registered(name):
    """A registered plant, its certificate and its silence, or those of one whose set leaves more than a step."""
    if name == "drifts":
        plant, wide = (small([[1.02, 0.05], [0.0, 0.9]], gamma=gamma) for gamma in (1e-5, 1e-3))
        certificate = certificate_of(wide, ChannelContract(6), "polytope")
        certificate = replace(certificate, fingerprint=plant.fingerprint)
    elif name == "open":  # a solver's price of an open end is about 1e-11, not 0
        limits = {"state_limits": ([-1.0, -1.5], [2.0, np.inf]), "input_limits": ([-2.0], [1.0])}
        given = {"A": [[1.03, 0.1], [0.0, 0.8]], "B": [[0.1], [0.2]], "dt": 0.1, "sensor_bound": 0.003}
        plant, wide = (
            linear_plant(**given, **limits, initial_bound=0.003, disturbance_bound=each) for each in (0.003, 0.008)
        )
        certificate = certificate_of(wide, ChannelContract(3, 0.001), "polytope")
        certificate = replace(certificate, fingerprint=plant.fingerprint)
    else:
        env = gym.make(f"ncs_gym/{name}-v0").unwrapped
        plant, certificate = env.plant, certificate_for(env.plant, env.certificate_contract)
    return plant, certificate, shields.silence_of(certificate, plant, input_delay(name))


def input_delay(name):
    """What a downlink takes of the contract's age."""
    return 0 if name in ("drifts", "open") else gym.make(f"ncs_gym/{name}-v0").unwrapped.downlink_protocol.input_delay


def simulated(plant, certificate, age, steps, start, error, disturbances, from_estimate):
    """Last states and fallback inputs of q simulations, (n, q) and (m, q), begun `age` steps after the oldest sample.

    Starts, errors and each of the disturbances, which begin at that sample, are (n, q).
    """
    rest, K = certificate.resting_state[:, None], certificate.K
    for w in disturbances[:age]:
        error = plant.A @ error - w
    x_hat = start if from_estimate else start + error
    x = x_hat - error
    for w in disturbances[age : age + steps]:
        u = certificate.resting_input[:, None] + K @ (x_hat - rest)
        x, x_hat = plant.A @ x + plant.B @ u + w, plant.A @ x_hat + plant.B @ u
    return x, certificate.resting_input[:, None] + K @ (x_hat - rest)


def extremes(plant, certificate, age, steps, share=None):
    """Largest values of the box's rows after so many steps and of the inputs then, and least ones: (2, k), (2, m).

    The map from start, error and disturbances is taken from simulations, the extremes from its linear parts.
    """
    count = 2 + age + steps
    cases = np.hstack([np.zeros((count * plant.n, 1)), np.eye(count * plant.n)])
    start, error, *disturbances = np.split(cases, count)
    x, u = simulated(plant, certificate, age, steps, start, error, disturbances, share is not None)
    values = np.concatenate([plant.box @ x, u])
    constant = values[:, 0]
    linear = values[:, 1:] - constant[:, None]
    P, rest = certificate.safe_set, certificate.resting_state
    roots = [certificate.Sigma] + [plant.disturbance.shape_matrix] * (age + steps)
    least, largest = [], []
    for row, offset in zip(linear, constant, strict=True):
        of_start, *others = np.split(row, count)
        reach = sum(np.sqrt(max(g @ shape @ g, 0.0)) for g, shape in zip(others, roots, strict=True))
        ends = []
        for sign in (-1.0, 1.0):
            A = np.concatenate([P.rows, -P.rows])
            b = np.concatenate([P.high, -P.low])
            found = linprog(-sign * of_start, A_ub=A[np.isfinite(b)], b_ub=b[np.isfinite(b)], bounds=(None, None))
            of_set = -sign * found.fun
            if share is not None:
                of_set = of_start @ rest + share * (of_set - of_start @ rest)
            ends.append(offset + of_set + sign * reach)
        least.append(ends[0])
        largest.append(ends[1])
    k = len(plant.box)
    return np.array([least[:k], largest[:k]]), np.array([least[k:], largest[k:]])


def keeps_box(plant, values, slack):
    return np.all(plant.box_ends[0] - slack <= values[0]) and np.all(values[1] <= plant.box_ends[1] + slack)


def exceeds_limits(plant, values):
    return np.any(values[0] < plant.input_ends[0]) or np.any(values[1] > plant.input_ends[1])


@pytest.mark.cases(2)
@pytest.mark.parametrize("name", CASES)
def test_the_numbers_are_those_of_the_worst_start_error_and_disturbances(name):
    plant, certificate, found = registered(name)
    assert found.max_age == certificate.contract.max_age
    assert 1 <= found.anywhere <= found.at_half <= found.at_rest < MOST_STEPS
    assert (found.at_half < found.at_rest) == (name not in ("open", "drifts"))
    cases = [(found.at_half, 0, 0.5), (found.at_rest, 0, 0.0)]
    for steps, age, share in cases:
        for j in {1, steps // 2, steps} - {0}:
            assert keeps_box(plant, extremes(plant, certificate, age, j, share)[0], 0.0)
        is_left = not keeps_box(plant, extremes(plant, certificate, age, steps + 1, share)[0], -1e-6)
        assert is_left or exceeds_limits(plant, extremes(plant, certificate, age, steps, share)[1])
    # The state was in S at some age beyond the oldest one: the box is kept whichever it was, and not a step longer.
    last = found.anywhere
    for age in range(1, last, 7):
        assert keeps_box(plant, extremes(plant, certificate, age, last - age)[0], 0.0)
    assert any(
        not keeps_box(plant, extremes(plant, certificate, age, last + 1 - age)[0], -1e-6)
        or exceeds_limits(plant, extremes(plant, certificate, age, last - age)[1])
        for age in range(last, 0, -1)
    )


def test_a_resting_point_that_is_no_equilibrium_moves_the_estimate():
    """A certificate of larger disturbances may have one: its own hold what it lacks."""
    bounds = {"sensor_bound": 0.003, "initial_bound": 0.003}
    given = {"A": [[1.02, 0.05], [0.0, 0.9]], "B": [[0.1], [0.2]], "box": np.eye(2), "dt": 0.1, "u_max": 2.0}
    plant, wide = (linear_plant(**given, **bounds, disturbance_bound=each) for each in (0.001, 0.005))
    rest, x_c = at_operating_point(wide), np.array([0.1, 0.0])
    found = certified_polytope(wide, np.array([[-0.87, -0.75]]), ChannelContract(3), rest)
    moved = replace(
        found,
        fingerprint=plant.fingerprint,
        resting_state=x_c,
        safe_set=replace(found.safe_set, center=x_c),
    )
    steps = shields.silence_of(moved, plant).at_rest
    for each in (1, steps // 2, steps):
        assert keeps_box(plant, extremes(plant, moved, 0, each, 0.0)[0], 0.0)
    assert not keeps_box(plant, extremes(plant, moved, 0, steps + 1, 0.0)[0], -1e-6)


@pytest.mark.parametrize("size", [1.0, 1e-12, 1e12])
def test_bounds_of_rows_hold_whatever_the_solver_says(size):
    """Also where its tolerances are far too coarse, and close to the best ones where they are not."""
    angles = np.linspace(0.0, np.pi, 7, endpoint=False)
    faces = Faces(np.stack([np.cos(angles), np.sin(angles)], axis=1), np.full(7, -1.0), np.full(7, 1.0))
    extremes, reach = Extremes(faces), np.full(2, 1.1)
    for row in size * np.random.default_rng(0).standard_normal((40, 2)):
        best = -linprog(
            -row / size, A_ub=np.concatenate([faces.rows, -faces.rows]), b_ub=np.ones(14), bounds=(None, None)
        ).fun
        least, largest = extremes.bounds(row, reach)
        assert largest >= best * size * (1.0 - 1e-12)
        assert least == -largest
        if size == 1.0:
            assert largest <= best + 1e-9


@pytest.mark.cases(1)
@pytest.mark.parametrize("name", ["CartPole", "CartPoleTwoWay", "Pendulum", "drifts"])
def test_ways_back_are_those_of_an_estimator_with_as_few_samples_as_the_contract_allows(name):
    plant, certificate, silence = registered(name)
    contract = certificate.contract
    for way in silence.ways_back:
        for period, said in ((1, way.often), (contract.max_age - input_delay(name) + 1, way.rarely)):
            channel = Channel(send_period=period, quantization_step=contract.quantization_step)
            assert contract.is_kept_by(channel)
            estimator = Estimator(plant, channel, certified_error_set(plant, contract))
            estimator.reset(np.zeros(plant.n))
            first = 5 * period + way.outage  # the step of the first sample after the outage
            for step in range(1, first + said + 1):
                heard = step % period == 0 if step <= 5 * period else step >= first and (step - first) % period == 0
                sample = Packet(step, plant.H @ estimator.mean, estimator.episode)
                estimator.advance(np.zeros(plant.m), [sample] if heard else [])
                certified = estimator.table.is_certified(estimator.numbered([])[1])
                assert certified or 5 * period < step < first + said
                assert not (certified and first <= step < first + said)
    assert not contract.is_kept_by(Channel(send_period=contract.max_age + 2))


def test_certificates_of_other_plants_are_refused():
    with pytest.raises(CertificateError):
        shields.silence_of(registered("Pendulum")[1], registered("CartPole")[0])
