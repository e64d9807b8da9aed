"""The room that error sets by age have for the rounding of an estimate that is updated with a certified gain."""

from fractions import Fraction

import numpy as np
import pytest

from ncs_gym import Channel, ChannelContract, Ellipsoid
from ncs_gym.ellipsoid import INFLATION, is_inside
from ncs_gym.estimation.error_bound import ErrorSet
from ncs_gym.estimation.estimator import Estimator
from ncs_gym.estimation.kalman_filter import SetMembership
from ncs_gym.plants.linear_plant import SIMULATED_REACH
from shields.verification.rational_matrix import congruence, rational
from tests.product import altered, linear_plant

# Radius of Sigma_0 in half-widths of the box: of sensors so fine that the rounding of an estimate far out counts.
RADIUS, GAIN, RATE = 1e-8, 0.9, 1.02
# By how much all conditions hold, so that evaluating them in float64 shows it.
SLACK = 1e-12
UNIT = ErrorSet(shapes=np.ones((1, 1, 1)), rates=np.array([0.5]))


def plant_with(sensor_radius):
    return linear_plant(
        A=[[RATE]],
        B=[[1.0]],
        box=[1.0],
        u_max=1.0,
        dt=0.1,
        sensor_bound=sensor_radius,
        initial_bound=0.0,
        disturbance_bound=0.0,
    )


def sets_for_age_zero(plant, newest, older, rate, gain, mu, noise=None):
    """Sets of one state for samples that are never late."""
    sets = ErrorSet(
        contract=ChannelContract(0),
        shapes=np.array([[[newest]], [[older]]]),
        rates=np.array([rate]),
        gains=np.array([gain]),
        multipliers=np.array([mu]),
        noise=plant.sensor_error_with(0.0).shape_matrix if noise is None else noise,
    )
    return sets


def rounded_away(gain, matched, estimate, sample):
    """How far float64 moves an update of an estimate away from the exact one."""
    computed = estimate + gain @ (sample - matched @ estimate)
    start, end = (Fraction(float(value[0])) for value in (estimate, computed))
    numbers = zip(gain[0].tolist(), sample.tolist(), matched[:, 0].tolist(), strict=True)
    return abs(float(end - start - sum(Fraction(t) * (Fraction(y) - Fraction(h) * start) for t, y, h in numbers)))


def sets_that_just_hold(room):
    """A plant and error sets for age 0 for which (C0), (C1) and (C2) hold, (C2) with the room or with none."""
    carried = RATE * RADIUS
    rounding = plant_with(1e-9)
    newest, disturbance = RADIUS**2, rounding.disturbance.shape_matrix[0, 0]
    older = (1.0 + SLACK) * (carried + disturbance**0.5) ** 2
    allowed = (newest - rounding.estimate_rounding[0, 0]) / INFLATION if room else newest
    kept = (1.0 - GAIN) * older**0.5
    noise = (1.0 - SLACK) * (allowed**0.5 - kept) / GAIN  # radius of N: kept + GAIN noise is the radius of the result
    inflation = plant_with(1e-9).sensor_error.shape_matrix[0, 0] / 1e-18
    plant = plant_with(noise / inflation**0.5)
    rate = carried / (carried + disturbance**0.5)
    return plant, sets_for_age_zero(plant, newest, older, rate, [[GAIN]], kept / allowed**0.5)


def largest_gauge_after_an_update(plant, error_set):
    """How far out of E(Sigma_0) updates in float64 take errors, 1 is its boundary, with error and noise at theirs."""
    error, noise = (Fraction(float(shape[0, 0]) ** 0.5) for shape in (error_set.shapes[1], error_set.noise))
    largest, rng = 0.0, np.random.default_rng(0)
    for _ in range(250):
        estimate = SIMULATED_REACH * plant.half_widths[0] * rng.uniform(0.7, 1.0)
        sample = estimate - float(error - noise)
        state = max(Fraction(estimate) - error, Fraction(sample) - noise)  # error and noise are within their bounds
        updated = estimate + GAIN * (sample - estimate)
        largest = max(largest, float((Fraction(updated) - state) / Fraction(RADIUS)))
    return largest


def test_without_room_an_updated_estimate_leaves_its_set_and_an_estimator_refuses_such_sets():
    plant, error_set = sets_that_just_hold(room=False)
    sets = error_set
    kept = (1.0 - GAIN) ** 2 * sets.shapes[1] / sets.multipliers[0]
    plain = kept + GAIN**2 * sets.noise / (1.0 - sets.multipliers[0])
    assert is_inside(plain, sets.shapes[0])  # (C2) as it stands in docs/contracts.md holds
    assert largest_gauge_after_an_update(plant, error_set) > 1.0
    with pytest.raises(ValueError, match=r"\(C2\)"):
        Estimator(plant, Channel(), error_set)


def test_with_room_an_updated_estimate_stays_in_its_set():
    plant, error_set = sets_that_just_hold(room=True)
    assert 0.5 < largest_gauge_after_an_update(plant, error_set) < 1.0
    assert Estimator(plant, Channel(), error_set).error_set is error_set


@pytest.mark.parametrize(("radius", "gain"), [(1e-8, 0.9), (4e-3, 0.5)])
def test_a_gain_chosen_at_run_time_has_the_room_where_shapes_are_hardly_rounded_up(radius, gain):
    """The inflation covers what rounding takes of a large error, and what the plant adds that of a small one."""
    plant, rng, largest, H = altered(plant_with(radius), H=np.array([[0.9]])), np.random.default_rng(0), 0.0, 0.9
    sets = SetMembership(plant, 0.0, UNIT, shape_step=2.0**-90)
    error, noise = Fraction(radius), Fraction(float(sets.noise[0, 0] ** 0.5)) * (1 - Fraction(1, 10**15))
    limit = sets.updated(np.array([[radius**2]]), np.array([[gain]])).item() ** 0.5
    for _ in range(250):
        estimate = SIMULATED_REACH * rng.uniform(0.7, 1.0)
        sample = float(Fraction(H) * (Fraction(estimate) - error) + noise)
        state = max(
            Fraction(estimate) - error, (Fraction(sample) - noise) / Fraction(H)
        )  # both are within their bounds
        updated = estimate + gain * (sample - H * estimate)
        largest = max(largest, float((Fraction(updated) - state) / Fraction(limit)))
    assert 0.5 < largest < 1.0


def test_an_update_holds_noise_that_is_nearly_common_to_two_sensors():
    rng = np.random.default_rng(0)
    for _ in range(30):
        noise = Ellipsoid(1e4 * rng.uniform(0.5, 1.0) * np.array([[1.0, 0.7], [0.7, 0.49]]) + 1e-12 * np.eye(2))
        settings = {"disturbance_bound": 0.0, "sensor_bound": noise, "initial_bound": 0.0}
        plant = linear_plant(A=[[RATE]], B=[[1.0]], H=[[1.0], [0.7]], box=[1.0], u_max=1.0, dt=0.1, **settings)
        sets = SetMembership(plant, 0.0, UNIT, shape_step=2.0**-90)
        gain, shape = np.array([[70.0, -100.0]]) * rng.uniform(0.5, 1.0), np.array([[1e-26]])
        N = congruence(rational(gain), rational(sets.noise))
        assert sets.updated(shape, gain).item() >= N[0][0]


@pytest.mark.parametrize("gain", [0.0, 1.0])
def test_an_update_that_keeps_the_error_or_takes_the_noise_alone_needs_the_inflation_and_the_room(gain):
    plant = plant_with(1.0)
    sets = sets_for_age_zero(plant, 1.0, 1.0, 0.5, [[gain]], 0.5, noise=np.ones((1, 1)))
    ((_, inner, _),) = sets.needs(plant)["(C2)"]
    assert inner.item() == pytest.approx(2.0 * INFLATION, rel=1e-10)
    room = sets.rounding_of_update(plant, 0)
    assert room >= plant.estimate_rounding if gain else room == plant.estimate_rounding


@pytest.mark.parametrize(("error", "noise", "size"), [(1e4, 1e-6, 1.0), (1e-6, 1e4, 10.0), (1e-6, 1e-6, 1e3)])
def test_room_holds_what_a_large_error_large_noise_or_a_large_gain_rounds(error, noise, size):
    """Two sensors that agree but for little: each is far off, their difference is not."""
    matched = np.array([[1.0], [0.7]])
    gain = np.array([[1.0, 0.0]]) if error > noise else size * np.array([[0.7, -1.0]])
    own = Ellipsoid(noise**2 * matched @ matched.T + 1e-12 * np.eye(2))  # the gain does not see what is common to both
    settings = {"box": [1.0], "u_max": 1.0, "dt": 0.1, "disturbance_bound": 0.0, "initial_bound": 0.0}
    plant = linear_plant(A=[[0.5]], B=[[1.0]], H=matched, sensor_bound=own, **settings)
    sets = sets_for_age_zero(plant, 1.0, error**2, 0.5, gain, 0.5)
    rng, moved = np.random.default_rng(0), 0.0
    for _ in range(150):
        estimate = np.array([SIMULATED_REACH * rng.uniform(0.6, 1.0)])
        sample = matched @ (estimate + error * rng.uniform(-1.0, 1.0)) + noise * rng.uniform(-1.0, 1.0) * matched[:, 0]
        moved = max(moved, rounded_away(gain, matched, estimate, sample))
    room = sets.rounding_of_update(plant, 0).item()
    assert 0.02 < moved / (room * (INFLATION - 1.0) / 2.0) ** 0.5 < 1.0
