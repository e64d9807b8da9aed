import ast
import inspect
import math
from dataclasses import fields, replace
from decimal import Decimal, localcontext

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import chi2

from ncs_gym import LinearPlant, truck_trailer
from ncs_gym.uncertainty.truncated_gaussian import TruncatedGaussian, truncation_energy


def test_truck_trailer_reproduces_the_printed_matrices():
    plant = truck_trailer()
    np.testing.assert_allclose(plant.A, [[0.7247, 0.1636], [-0.7361, -0.0278]], atol=5e-5)
    np.testing.assert_allclose(plant.B, [[0.0612], [0.1636]], atol=5e-5)


def test_zero_order_hold_agrees_with_integrating_the_differential_equation():
    plant = truck_trailer(mass=3000.0, stiffness=4000.0, damping=900.0, dt=0.7)

    def rate(_, x):
        return [x[1], -4000.0 / 3000.0 * x[0] - 900.0 / 3000.0 * x[1] + 1.7]

    start = np.array([0.4, -0.9])
    end = solve_ivp(rate, (0.0, 0.7), start, rtol=1e-11, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(plant.A @ start + plant.B @ [1.7], end, atol=1e-8)


def test_disturbance_bound_holds_ball_plus_truncated_noise():
    plant = truck_trailer()
    rng = np.random.default_rng(0)
    for _ in range(500):
        direction = rng.standard_normal(2)
        direction /= np.linalg.norm(direction)
        need = np.sqrt(plant.gamma) + np.sqrt(chi2.ppf(0.95, 2) * direction @ plant.process_noise_cov @ direction)
        assert plant.disturbance.support(direction) >= need


def test_case_study_bounds_have_the_measured_radii():
    plant = truck_trailer()
    assert np.sqrt(plant.disturbance.shape_matrix[0, 0]) == pytest.approx(0.0468, abs=5e-5)
    assert plant.initial_error.shape_matrix[0, 0] == pytest.approx(1e-4 * 5.9915, rel=1e-4)


def test_sensor_bound_with_quantizer_holds_corners_of_the_rounding_box():
    plant = truck_trailer()
    step = 0.05
    noise, bound = plant.sensor_error.shape_matrix, plant.sensor_error_with(step)
    corner = np.array([step / 2, -step / 2])
    extreme = corner + np.sqrt(noise[0, 0]) * corner / np.linalg.norm(corner) * (1 - 1e-9)
    assert bound.contains(extreme)
    assert not bound.contains(1.01 * extreme)


def test_quantile_is_of_the_kept_mass_not_of_the_removed_one():
    assert truncation_energy(0.05, 2) == pytest.approx(-2.0 * np.log(0.05), rel=1e-15)


@pytest.mark.parametrize("degrees", [1, 2, 3, 7])
@pytest.mark.parametrize("delta", [0.999, 0.5, 0.05, 1e-9, 1e-12])
def test_truncation_energy_is_the_quantile_of_scipy_stats(delta, degrees):
    assert truncation_energy(delta, degrees) == pytest.approx(chi2.isf(delta, degrees), rel=1e-11)


@pytest.mark.parametrize("degrees", [2, 4, 6])
@pytest.mark.parametrize("delta", [0.999, 0.05, 1e-12])
def test_truncation_energy_is_the_smallest_float_that_cuts_off_no_more_than_delta(delta, degrees):
    """An even number of degrees has the tail e^-h (1 + h + h^2/2 + ..), h half of the energy."""
    tails = []
    for energy in (truncation_energy(delta, degrees), math.nextafter(truncation_energy(delta, degrees), 0.0)):
        with localcontext(prec=60):
            half = Decimal(energy) / 2
            tails.append((-half).exp() * sum(half**k / math.factorial(k) for k in range(degrees // 2)))
    assert tails[0] <= Decimal(delta) < tails[1]


def test_truncated_noise_stays_in_its_bound_and_keeps_its_mass():
    rng = np.random.default_rng(4)
    covariance = np.array([[2.0, 0.3], [0.3, 0.5]])
    noise = TruncatedGaussian(covariance, truncation_energy(0.5, 2))
    samples = np.array([noise.sample(rng) for _ in range(4000)])
    assert all(noise.bound.gauge(sample) <= 1.0 + 1e-12 for sample in samples)
    # A Gaussian truncated at its median energy keeps 1 - log 2 of its covariance in two dimensions.
    np.testing.assert_allclose(np.cov(samples.T), (1.0 - np.log(2.0)) * covariance, atol=0.05)


def test_fingerprint_changes_with_every_number():
    base = truck_trailer()
    others = [
        truck_trailer(mass=1000.0001),
        truck_trailer(gamma=5.0000001e-4),
        truck_trailer(delta=0.051),
        truck_trailer(u_max=4.0000001),
        truck_trailer(initial_cov=2e-4 * np.eye(2)),
        truck_trailer(H=np.array([[1.0, 0.0]])),
        replace(base, error_gain=[[1.0, 0.0]]),
    ]
    prints = {plant.fingerprint for plant in (base, *others)}
    assert len(prints) == 1 + len(others)
    assert truck_trailer().fingerprint == base.fingerprint


QUIET = {"disturbance_bound": 0.01, "sensor_bound": 0.01, "initial_bound": 0.01}


def good() -> dict:
    return {"A": np.eye(2) * 0.5, "B": np.ones((2, 1)), "box": np.eye(2), "u_max": 1.0, "dt": 0.1, "gamma": 0.0}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"A": np.ones((2, 3))}, r"A must have shape \(2, 2\), got \(2, 3\)"),
        ({"A": [[np.nan, 0], [0, 0]]}, "A must be finite"),
        ({"A": "no"}, "A must be a matrix"),
        ({"box": [[1e150, 0.0], [0.0, 1.0]]}, "box must be finite and below 1e"),
        ({"gamma": "0"}, "gamma"),
        ({"B": np.ones((3, 1))}, r"B must have shape \(2, any\), got \(3, 1\)$"),
        (
            {"B": [0, 0.5]},
            r"B must have shape \(2, any\), got \(2,\); a single column is written \[\[0.0\], \[0.5\]\]$",
        ),
        ({"B": [0.5]}, r"B must have shape \(2, any\), got \(1,\)$"),
        ({"H": [1.0, 0.0]}, r"H must have shape \(any, 2\), got \(2,\); a single row is written \[\[1.0, 0.0\]\]$"),
        ({"error_gain": [1.0, 0.0]}, r"\(1, 2\), got \(2,\); a single row is written \[\[1.0, 0.0\]\]$"),
        ({"A": [1.0, 0.0]}, r"A must have shape \(any, any\), got \(2,\)$"),
        ({"box": np.ones((1, 3))}, "box must have shape"),
        ({"box": [[0.0, 0.0], [1.0, 0.0]]}, "every row of box must limit something"),
        ({"box": [1.0, -2.0]}, r"box must be positive half-widths of shape \(2,\)"),
        ({"box": [1.0, 2.0, 3.0]}, r"box must be positive half-widths of shape \(2,\)"),
        ({"box": [np.inf, np.inf]}, "box must be positive half-widths"),
        ({"box": [1.0, np.nan]}, "box must be positive half-widths"),
        ({"box": "wide"}, r"box must be half-widths of shape \(2,\) or rows of shape \(any, 2\)"),
        ({"box": ([-1.0, -2.0], [1.0, 2.0])}, r"box looks like lower and upper limits.*LinearPlant.around"),
        ({"box": [(-1.0, 2.0), (-2.0, 3.0)]}, "box looks like lower and upper limits"),
        ({"box": [(0.5, 1.0), (-2.0, 2.0)]}, "box looks like lower and upper limits"),
        ({"box": [(0, 1), (-2, 2)]}, "box looks like lower and upper limits"),
        ({"box": ((0, 3), (0, np.inf))}, r"box looks like lower and upper limits.*give them as an array"),
        ({"A": [[0.5]], "B": [[1.0]], "box": [(0.5, 1.0)]}, "box looks like lower and upper limits"),
        ({"A": np.eye(3) / 2, "B": np.ones((3, 1)), "box": [[-1, 1]] * 3}, r"box looks like.*\(state_limits="),
        ({"H": np.ones((1, 3))}, "H must have shape"),
        ({"u_max": -1.0}, "u_max must be a positive number"),
        ({"u_max": [1.0, 2.0]}, "u_max must be a positive number"),
        ({"u_max": (-1.0, 2.0)}, r"u_max must be a positive number.*LinearPlant.around\(input_limits="),
        ({"disturbance_bound": 1e-6 * np.eye(2)}, "a covariance has an argument of its own"),
        ({"dt": 0.0}, "dt must be a number > 0"),
        ({"gamma": -1e-9}, "gamma must be a number >= 0, got -1e-09"),
        ({"gamma": np.inf}, "gamma"),
        ({"delta": 0.0}, "delta"),
        ({"delta": 1.0}, "delta"),
        ({"delta": 1e-17}, "delta"),
        ({"H": [[1.0, 0.0], [0.0, 0.0]]}, "every row of H must measure something"),
        ({"process_noise_cov": -np.eye(2)}, "process_noise_cov must be positive semidefinite"),
        ({"initial_cov": [[1.0, 0.5], [0.0, 1.0]]}, "initial_cov must be symmetric"),
        ({"measurement_noise_cov": np.eye(3)}, "measurement_noise_cov must have shape"),
        ({"state_names": ["one"]}, "state_names"),
        ({"error_gain": np.ones((2, 2))}, "error_gain must have shape"),
    ],
)
def test_bad_numbers_are_refused_in_one_sentence(change, words):
    with pytest.raises(ValueError, match=words) as caught:
        LinearPlant(**(good() | change))
    assert "\n" not in str(caught.value)


def test_rows_of_two_states_are_taken_from_lists_and_arrays():
    rows = [[0.5, 1.0], [2.0, -2.0]]
    for box in (rows, np.array([(0.5, 1.0), (2.0, -2.0)])):
        np.testing.assert_array_equal(LinearPlant(**(good() | QUIET | {"box": box})).box_rows, rows)
    three = [(1.0, 0.0), (0.0, 1.0), (1.0, 1.0)]  # more rows than states
    np.testing.assert_array_equal(LinearPlant(**(good() | QUIET | {"box": three})).box_rows, three)


def test_arguments_that_a_plant_does_not_have_or_lacks_are_named():
    with pytest.raises(TypeError, match="unexpected keyword argument 'sensor_bonud'"):
        LinearPlant(**good(), sensor_bonud=0.1)
    with pytest.raises(TypeError, match="unexpected keyword argument 'wheels'"):
        truck_trailer(wheels=18)
    with pytest.raises(TypeError, match=r"missing 2 required .* 'box' and 'u_max'"):
        LinearPlant(**{name: value for name, value in good().items() if name not in ("box", "u_max")})


@pytest.mark.parametrize("change", [{"mass": 0.0}, {"stiffness": -1.0}, {"damping": -1.0}, {"dt": np.nan}, {"H": 3}])
def test_bad_truck_is_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        truck_trailer(**change)


def test_constructor_for_type_checkers_takes_exactly_the_fields_with_their_defaults():
    tree = ast.parse(inspect.getsource(LinearPlant))
    (typed,) = (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and node.name == "__init__")
    given = [None if default is None else ast.literal_eval(default) for default in typed.args.kw_defaults]
    real = inspect.signature(LinearPlant).parameters
    assert [arg.arg for arg in typed.args.kwonlyargs] == [field.name for field in fields(LinearPlant)] == list(real)
    assert [default is not None for default in typed.args.kw_defaults] == [
        parameter.default is not parameter.empty for parameter in real.values()
    ]
    assert given == [None if p.default is p.empty else p.default for p in real.values()]
