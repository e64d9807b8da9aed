"""Numpy's error state is the caller's: with "raise" every public door says what it says without."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from ncs_gym import (
    Channel,
    ChannelContract,
    Ellipsoid,
    Estimator,
    LinearPlant,
    NCSEnv,
    NCSVectorEnv,
    Packet,
    cart_pole,
    certified_error_set,
    truck_trailer,
)
from ncs_gym.network.packet_loss_and_delay import StackedChannels
from shields import SafeLoop, SafetyFilter, SafetyShield, VectorSafetyShield, synthesize
from tests.certificates import certificate_of
from tests.verdicts import verified

PLANT = truck_trailer(mass=4000.0)
MODES = ("project", "switch", "boundary", "monitor", "lookahead")
# Denormal, tiny, ordinary, large, and so large that squares overflow; of samples also what no sensor sends.
SIZES = (5e-324, 1e-310, 1e-200, 1e-3, 1.0, 1e9, 1e74)
BEYOND = (1e160, 1e308, np.inf, np.nan)


@pytest.fixture(autouse=True)
def _raises() -> Iterator[None]:
    with np.errstate(all="raise"):
        yield
        assert set(np.geterr().values()) == {"raise"}  # it is the caller's still


def vector(size: float, *factors: float) -> np.ndarray:
    """A product that is made before numpy is told anything."""
    with np.errstate(all="ignore"):
        return size * np.array(factors)


@pytest.mark.cases(20)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("contract", [None, ChannelContract(2)])
@pytest.mark.parametrize("mode", MODES)
def test_loops_go_on_whatever_numpy_is_told_to_raise(mode, contract, size):
    certificate = certificate_of(PLANT, contract)
    loop = SafeLoop(certificate, PLANT, Channel(delay=1), mode, downlink=Channel(delay=1), on_unproved="ignore")
    x = vector(size, 1.0, -0.7)
    for known in (True, False):
        loop.start(x, Ellipsoid(1e-3 * np.eye(2)) if known and size < 1.0 else None, known=known)
        for step in range(6):
            packets = [Packet(step, x.copy()), Packet(step - 1, vector(size, 1.0, 1.0))]
            packets += [Packet(step, vector(each, 1.0, 1.0)) for each in BEYOND if step > 3]
            estimate = loop.receive(packets, applied=[size] if step else None)
            assert estimate.shape == loop.estimate.shape == (2,)
            assert loop.error_shape.shape == (2, 2)
            loop.decide([(size, -size, 1e308, np.nan, -1e-310, 4.0)[step]])
            assert str(loop)
            loop.command()


@pytest.mark.cases(2)
@pytest.mark.parametrize("mode", MODES)
def test_filters_say_the_same_whatever_numpy_is_told_to_raise(mode):
    shields = {name: SafetyFilter(certificate_of(PLANT), PLANT, mode) for name in ("loud", "quiet")}
    sizes = (*SIZES, *BEYOND)
    for x in sizes:
        for u in sizes:
            for shape in (certificate_of(PLANT).Sigma, np.diag(vector(x, 1.0, 1.0))):
                given = vector(x, 1.0, -0.5), shape, np.array([u])
                loud, one = shields["loud"], shields["quiet"]
                said = [loud.decide(*given).input, loud.margin(*given), loud.knows_inside(*given[:2])]
                many = loud.decide_many(given[0][None], shape, given[2][None])
                with np.errstate(all="ignore"):
                    expected = [one.decide(*given).input, one.margin(*given), one.knows_inside(*given[:2])]
                    others = one.decide_many(given[0][None], shape, given[2][None])
                for each, other in zip(
                    (*said, many.input, many.plan), (*expected, others.input, others.plan), strict=True
                ):
                    with np.errstate(all="ignore"):
                        np.testing.assert_allclose(each, other, rtol=1e-6, atol=1e-9)
        if np.isfinite(x) and x < 1e160:
            loud.fallback_input(vector(x, 1.0, 1.0))


@pytest.mark.cases(4)
@pytest.mark.parametrize("size", SIZES[:4])
@pytest.mark.parametrize("plant", [PLANT, replace(PLANT, between_samples=4), cart_pole()], ids=["", "between", "pole"])
def test_environments_and_shields_step_whatever_numpy_is_told_to_raise(plant, size):
    contract = None if plant.spectral_radius < 1.0 else ChannelContract(2)
    certificate = certificate_of(plant, contract)
    settings = {"plant": plant, "contract": contract, "channel": Channel(quantization_step=0.0, delay=1)}
    start = vector(size, *0.1 * plant.half_widths)
    action = np.array([size], np.float64)
    for mode in ("project", "lookahead"):
        env = SafetyShield(NCSEnv(**settings), certificate, mode, on_unproved="ignore")
        env.reset(seed=0, options={"state": start})
        for each in (action, -action, np.float32([1.0]), np.array([1e-310]), np.array([1e300])):
            observation, reward, *_, info = env.step(each)
            assert np.isfinite(observation).all()
            assert np.isfinite(reward)
        many = VectorSafetyShield(NCSVectorEnv(num_envs=2, **settings), certificate, mode, on_unproved="ignore")
        many.reset(seed=0, options={"state": np.array([start, -start])})
        for each in (action, -action, np.array([1e-310]), np.array([1e300])):
            observation, reward, *_, info = many.step(np.tile(each, (2, 1)))
            assert np.isfinite(observation).all()
            assert np.isfinite(reward).all()
            assert "shield_reason" in info


@pytest.mark.parametrize("size", [*SIZES, *BEYOND[:2]])
def test_estimators_move_on_whatever_numpy_is_told_to_raise(size):
    estimator = Estimator(PLANT, Channel(delay=2), error_set=certified_error_set(PLANT))
    estimator.reset(vector(size, 1.0, 1.0))
    for step in range(1, 6):
        estimator.advance(vector(size, 1.0), [Packet(step - 1, vector(size, 1.0, 1.0)), Packet(step, -np.ones(2))])
        estimator.predicted([vector(size, 1.0)] * 3)
        assert estimator.estimate.shape.shape == (2, 2)


@pytest.mark.parametrize("size", [1e-160, 1e-30, 1e-3, 1.0, 1e30, 1e160])
def test_plants_are_made_or_refused_in_words_whatever_numpy_is_told_to_raise(size):
    A = np.array([[0.9, 1e-310], [1e-200, 0.5]])
    settings = {"u_max": 1.0, "dt": 0.1, "gamma": 1e-6, "process_noise_cov": np.diag([1e-30, 0.0])}
    try:
        plant = LinearPlant(A=A, B=[[size], [1e-310]], box=[size, 1.0], **settings)
    except ValueError:
        assert not 1e-75 <= size <= 1e75
        return
    for name in (
        "disturbance",
        "sensor_error",
        "initial_error",
        "weight",
        "half_widths",
        "kalman_covariances",
        "state_limit",
    ):
        assert getattr(plant, name) is not None
    ball = plant.disturbance
    ball.gauge(vector(size, 1.0, 1.0)[None])
    ball.support(vector(size, 1.0, 1.0))
    ball.outer_sum(ball)
    ball.sample(np.random.default_rng(0), 3)
    plant.worst_constraint_values(vector(size, 1.0, 1.0), np.ones(1), np.full(2, 1e-310))


def test_certificates_are_found_and_verified_whatever_numpy_is_told_to_raise():
    plant = LinearPlant(A=[[0.9, 1e-310], [0.0, 0.5]], B=[[1.0], [1e-200]], box=[1.0, 1e-3], u_max=1.0, dt=0.1,
                        disturbance_bound=[1e-3, 1e-8], sensor_bound=1e-5, initial_bound=1e-5)  # fmt: skip
    certificate = synthesize(plant)
    assert verified(certificate, plant).valid
    assert certificate.safe_set.gauge(np.full((1, 2), 1e-310)) >= 0.0
    assert certificate.M.shape == (2, 2)


@pytest.mark.parametrize("size", [*SIZES, 1e308])
def test_channels_round_whatever_numpy_is_told_to_raise(size):
    channel, value = Channel(quantization_step=10.0), vector(size, 1.0, -0.7)
    rounded = channel.quantize(value)
    np.testing.assert_array_equal(StackedChannels([channel, Channel()]).quantize(value), [rounded[0], value[1]])
