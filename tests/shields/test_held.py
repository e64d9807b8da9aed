"""What can be held, by rest of the filter itself, by samples of equilibria and by linear programs of the test's own."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.optimize import linprog

from ncs_gym import ChannelContract
from shields import CertificateError, certificate_for, reach_of, setpoint_range
from shields.held import held_text
from tests.certificates import certificate_of
from tests.plants import named
from tests.product import altered, linear_plant, safety_filter

# Points this share of half a range inside of an end are not overridden, those so far outside are.
NEAR = 1e-4
TWO_ENDS = "two ends"
KINDS = [
    *((name, kind) for name in ("CartPole", "BatchReactor", "oscillator") for kind in ("polytope", "ellipsoid")),
    ("TruckTrailer", "polytope"),  # whose input has a limit that ends the range
    *((name, "polytope") for name in ("LaneKeeping", "delayed", "servo", TWO_ENDS)),
]


def two_ends():
    """A heated mass around 5: its input may push up more than down, and input and state have a limit together."""
    limits = {"state_limits": ([2.0, -1.0], [9.0, 2.0]), "input_limits": ([0.5], [4.0])}
    around = {"operating_state": [5.0, 0.0], "operating_input": [2.0]}
    bounds = {"disturbance_bound": 0.02, "sensor_bound": 0.01, "initial_bound": 0.02}
    return linear_plant(
        A=[[0.9, 0.2], [0.0, 0.7]], B=[[0.1], [0.3]], dt=0.1, **limits, **around, **bounds,
        output_limits=[([1.0, 0.0], 1.0, 8.0)],
    )  # fmt: skip


def certified(name, kind):
    """A plant, and its certificate of a kind."""
    if name == TWO_ENDS:
        plant, contract = two_ends(), ChannelContract(2)
    elif name[0].isupper():
        env = gym.make(f"ncs_gym/{name}-v0").unwrapped
        plant, contract = env.plant, env.certificate_contract
        return plant, certificate_for(plant, contract, kind)
    else:
        plant, contract = named(name)
    return plant, certificate_of(plant, contract, kind)


def moved_states(plant):
    """The states that equilibria move by more than rounding."""
    directions = null_space(np.hstack([plant.A - np.eye(plant.n), plant.B]))
    return [j for j in range(plant.n - plant.past) if np.abs(directions[j]).max() > 1e-3]


def ages_of(certificate):
    return sorted({0, len(certificate.proofs) - 1})


@pytest.mark.cases(6)
@pytest.mark.parametrize(("name", "kind"), KINDS)
def test_loop_rests_unchanged_just_inside_and_is_overridden_just_outside(name, kind):
    plant, certificate = certified(name, kind)
    shield, rng = safety_filter(certificate, plant), np.random.default_rng(0)
    directions = null_space(np.hstack([plant.A - np.eye(plant.n), plant.B]))
    judged = 0
    for age in ages_of(certificate):
        shape = certificate.error_shapes[age]
        for state in moved_states(plant):
            found = setpoint_range(certificate, plant, state, age)
            room = 0.5 * (found.deviations[1] - found.deviations[0])
            assert room > 1e-3
            middle = 0.5 * (found.states.sum(axis=0)), 0.5 * found.inputs.sum(axis=0)
            for end, x, u in zip(found.deviations, found.states, found.inputs, strict=True):
                assert x[state] == pytest.approx(end, abs=1e-12)
                x, u = (of + (1.0 - NEAR) * (at - of) for at, of in zip((x, u), middle, strict=True))
                for _ in range(8):
                    decision = shield.decide(x, shape, u)
                    assert decision.proved
                    assert not decision.intervened
                    x = plant.A @ x + plant.B @ decision.input
                assert x[state] == pytest.approx(end, abs=2.0 * NEAR * room)
                for outside in equilibria_at(
                    directions, state, end + NEAR * room * np.sign(end - middle[0][state]), rng
                ):
                    x, u = np.split(outside, [plant.n])
                    assert shield.decide(x, shape, u).intervened
                    judged += 1
    assert judged >= 2 * len(moved_states(plant))


def equilibria_at(directions, state, value, rng):
    """Equilibria at which a state has a value: the only one of a plant with one input, else many, near and far."""
    row = directions[state]
    point, others = directions @ row * (value / (row @ row)), directions @ null_space(row[None])
    if not others.shape[1]:
        return [point]
    sizes = 10.0 ** rng.uniform(-3.0, 0.5, (60, 1))
    return point + sizes * rng.standard_normal((60, others.shape[1])) @ others.T


@pytest.mark.cases(2)
@pytest.mark.parametrize("name", ["BatchReactor", "CSTR", "oscillator", TWO_ENDS])
def test_range_is_that_of_a_linear_program_in_states_and_inputs(name):
    """With states and inputs as variables, the limits of the test, and errors and disturbances by their supports."""
    plant, certificate = certified(name, "polytope")
    P, D = certificate.safe_set, plant.disturbance.shape_matrix
    for age in ages_of(certificate):
        Sigma = certificate.error_shapes[age]
        rows = np.vstack([np.hstack([P.rows @ plant.A, P.rows @ plant.B]), plant.step_rows])
        kept = np.sqrt(np.einsum("ij,jk,ik->i", rows[:, : plant.n], Sigma, rows[:, : plant.n]))
        kept = kept + np.pad(np.sqrt(np.einsum("ij,jk,ik->i", P.rows, D, P.rows)), (0, len(plant.step_rows)))
        low, high = np.hstack([[P.low, P.high], plant.step_ends])
        sides = np.vstack([rows, -rows]), np.concatenate([high - kept, -low - kept])
        program = {
            "A_ub": sides[0][np.isfinite(sides[1])],
            "b_ub": sides[1][np.isfinite(sides[1])],
            "A_eq": np.hstack([plant.A - np.eye(plant.n), plant.B]),
            "b_eq": np.zeros(plant.n),
            "bounds": [(None, None)] * plant.n + plant.input_ends.T.tolist(),
        }
        row = np.arange(1.0, plant.n + 1.0)
        expected = [sign * linprog(sign * np.append(row, np.zeros(plant.m)), **program).fun for sign in (1.0, -1.0)]
        found = setpoint_range(certificate, plant, row, age)
        np.testing.assert_allclose(found.deviations, expected, rtol=1e-4, atol=1e-5)


def test_older_samples_hold_less_and_ends_are_physical():
    plant, certificate = certified(TWO_ENDS, "polytope")
    fresh, old = (setpoint_range(certificate, plant, "x1", age) for age in (0, 2))
    assert 2.0 < fresh.low < old.low < 5.0 < old.high < fresh.high < 8.0
    for points in (fresh, old):
        assert [points.low, points.high] == pytest.approx(5.0 + points.deviations)
        np.testing.assert_allclose(plant.A @ points.states.T + plant.B @ points.inputs.T, points.states.T, atol=1e-9)
    said = " ".join(held_text(certificate, plant).split())
    assert f"x1 from {fresh.low:.4g} to {fresh.high:.4g} with samples 0 steps old" in said


def test_nothing_is_held_where_an_estimate_may_be_farther_off_than_the_box_is_wide():
    plant = linear_plant(
        A=[[0.9, 0.1], [0.0, 0.8]], B=[[0.0], [0.3]], box=[1.0, 1.0], u_max=1.0, dt=0.1, disturbance_bound=0.01,
        sensor_bound=0.01, initial_bound=3.0,
    )  # fmt: skip
    certificate = certificate_of(plant, None, "polytope")
    assert setpoint_range(certificate, plant, 0) is None
    shield = safety_filter(certificate, plant)
    assert shield.decide(np.zeros(2), certificate.Sigma, np.full(1, 0.1)).intervened
    assert "x1 nowhere" in held_text(certificate, plant)


@pytest.mark.parametrize(
    ("name", "kind"), [("CartPole", "ellipsoid"), ("LaneKeeping", "polytope"), (TWO_ENDS, "polytope")]
)
def test_no_point_of_the_set_is_beyond_its_reach_and_some_point_attains_it(name, kind):
    plant, certificate = certified(name, kind)
    points = certificate.safe_set.sample_boundary(np.random.default_rng(0), 20_000)
    reached = reach_of(certificate, plant)
    assert len(reached) == len(plant.box)
    for row, ends, reach in zip(plant.box, plant.box_ends.T, reached, strict=True):
        for end, percent in zip(ends, (reach.low, reach.high), strict=True):
            values = 100.0 * points @ row / end
            assert values.max() <= percent * (1.0 + 1e-9) <= 100.0 + 1e-6
            along = row * np.sign(end)
            if kind == "ellipsoid":
                farthest = certificate.safe_set.extreme_point(along)
            else:
                faces, center = certificate.safe_set.F, certificate.resting_state
                scale = 1.0 / np.abs(faces).max(axis=0)
                found = linprog(-along * scale, A_ub=faces * scale, b_ub=np.ones(len(faces)), bounds=(None, None))
                farthest = center + scale * found.x
            assert certificate.safe_set.gauge(farthest) <= 1.0 + 1e-7
            assert 100.0 * farthest @ row / end == pytest.approx(percent)


def test_open_ends_have_no_reach_and_the_printed_certificate_says_the_others():
    plant = linear_plant(
        A=[[1.0, 0.1], [0.0, 0.8]], B=[[0.0], [0.3]], state_limits=([-1.0, -1.0], [np.inf, 1.0]),
        input_limits=([-1.0], [1.0]), dt=0.1, disturbance_bound=0.01, sensor_bound=0.01, initial_bound=0.01,
    )  # fmt: skip
    certificate = certificate_of(plant, ChannelContract(1), "polytope")
    first, second = reach_of(certificate, plant)
    assert (first.limit, first.high) == ("x1 >= -1", None)
    assert 90.0 < first.low <= 100.0 + 1e-9
    assert str(second) == "100 % of |x2| <= 1"
    assert f"size up to {first}, {second}" in " ".join(str(certificate).split())


def test_both_refuse_what_they_cannot_use():
    plant, certificate = certified("CSTR", "polytope")
    other = altered(plant, gamma=0.5 * plant.gamma) if plant.gamma else named("stable")[0]
    for asked in (reach_of, lambda *given: setpoint_range(*given, 0)):
        with pytest.raises(CertificateError, match="was made for another plant"):
            asked(certificate, other)
        with pytest.raises(CertificateError, match="does not verify"):
            asked(replace(certificate, K=2.0 * certificate.K), plant)
        with pytest.raises(ValueError, match="Certificate"):
            asked(plant, certificate)
    for output, age, sentence in (
        ("pressure", 0, r"output must be one of the states \['concentration', 'temperature'\], got 'pressure'"),
        (2, 0, "output must be a whole number <= 1, got 2"),
        ([1.0], 0, "output must"),
        (0, 7, "age must be a whole number <= 6, got 7"),
    ):
        with pytest.raises(ValueError, match=sentence):
            setpoint_range(certificate, plant, output, age)
