import cvxpy as cp
import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import Channel, ChannelContract, truck_trailer
from shields import Infeasible, verify
from shields.synthesis.semidefinite_programs import largest_box_ellipsoid
from tests.plants import random_plant
from tests.product import library_plant, linear_plant, safety_shield, sampled_plant, synthesize
from tests.verdicts import verified

OBLIQUE = np.array([[0.5, 0.0], [0.0, 0.5], [0.4, 0.4]])


def slow(*values):
    """More of the same, for the slow tests."""
    return pytest.param(*values, marks=pytest.mark.slow)


def area_fraction(certificate, plant):
    return np.sqrt(np.linalg.det(certificate.safe_set.shape_matrix) / np.linalg.det(largest_box_ellipsoid(plant.box)))


SIZES = [(n, m, seed) for n in (1, 2, 3, 4) for m in (1, 2) for seed in range(2)]


@pytest.mark.cases(1)
@pytest.mark.parametrize(("n", "m", "seed"), [(2, 1, 0), (3, 2, 0), *(slow(*size) for size in SIZES)])
def test_random_stable_plants_get_a_certificate_that_verifies(n, m, seed):
    plant = random_plant(seed, n, m, p=max(1, n - 1))
    certificate = synthesize(plant, safe_set="ellipsoid")
    assert verified(certificate, plant).valid
    assert 0.3 < area_fraction(certificate, plant) <= 1.0


CART = {"dt": 0.1, "box": [1.0, 2.0], "u_max": 2.0, "initial_bound": [0.005, 0.02]}
CART |= {"disturbance_bound": [0.001, 0.005], "sensor_bound": 0.002}


def test_state_that_no_output_shows_is_named():
    system = ([[0.0, 1.0], [0.0, -0.5]], [[0.0], [1.0]], [[0.0, 1.0]], [[0.0]])
    plant = sampled_plant(system, **CART, state_names=("place", "speed"))
    with (
        pytest.raises(Infeasible, match="no error set exists: the outputs do not show place, whose errors"),
    ):
        synthesize(plant, contract=ChannelContract(0))


def test_unstable_plant_is_infeasible_for_want_of_an_error_bound():
    plant = linear_plant(A=[[1.1]], B=[[1.0]], box=[[1.0]], u_max=1.0, dt=0.1, gamma=1e-4)
    with pytest.raises(Infeasible, match="spectral radius") as caught:
        synthesize(plant)
    assert caught.value.binding == "E1"
    assert caught.value.shortfall == pytest.approx(0.1)


def test_weak_input_is_what_binds():
    # An unstable plant that a strong input can hold in the box, and a weak one cannot.
    def with_limit(u_max):
        return linear_plant(A=[[1.1]], B=[[1.0]], box=[[1.0]], u_max=u_max, dt=0.1, gamma=4e-4)

    contract = ChannelContract(1)
    certificate = synthesize(with_limit(1.0), contract=contract, safe_set="ellipsoid")
    assert verified(certificate, with_limit(1.0)).valid
    with pytest.raises(Infeasible) as caught:
        synthesize(with_limit(1e-3), contract=contract)
    assert caught.value.binding == "U"


@pytest.mark.cases(1)
@pytest.mark.parametrize(
    "bounds",
    [
        slow({"measurement_noise_cov": 1e-4 * np.outer([0.3, 0.7], [0.3, 0.7])}),
        slow({"gamma": 0.0, "process_noise_cov": 1e-4 * np.outer([0.3, 0.7], [0.3, 0.7])}),
        {"gamma": 0.0, "process_noise_cov": 1e-4 * np.outer([0.1, -0.3], [0.1, -0.3])},
        slow({"gamma": 0.0, "process_noise_cov": 1e-6 * np.eye(2)}),
        slow({"initial_cov": 1e-4 * np.outer([0.3, 0.7], [0.3, 0.7])}),
        {"gamma": 0.0} | dict.fromkeys(("process_noise_cov", "measurement_noise_cov", "initial_cov"), np.zeros((2, 2))),
    ],
)
def test_flat_and_absent_uncertainty_gets_a_certificate(bounds):
    plant = library_plant(truck_trailer, **bounds)
    assert verified(synthesize(plant, safe_set="ellipsoid"), plant).valid


@pytest.mark.cases(2)
@pytest.mark.parametrize(
    "answer",
    [cp.SolverError("it failed"), "infeasible_inaccurate", "user_limit", None, np.nan],
    ids=["raises", "infeasible", "stopped", "no values", "NaN"],
)
def test_solver_that_fails_gives_no_certificate_and_no_shield(monkeypatch, answer):
    plant = random_plant(11, 2, 1)

    def solve(program, *args, **kwargs):
        if isinstance(answer, Exception):
            raise answer
        program._status = answer if isinstance(answer, str) else "optimal"
        for variable in program.variables():
            variable._value = None if answer is None else np.full(variable.shape, np.nan)
        return program

    monkeypatch.setattr(cp.Problem, "solve", solve)
    with pytest.raises(Infeasible):
        synthesize(plant, safe_set="ellipsoid")
    if answer is not None:  # the others of these are as the first
        return
    oblique = library_plant(truck_trailer, box=OBLIQUE)
    with pytest.raises(Infeasible):
        safety_shield(gym.make("ncs_gym/TruckTrailer-v0", plant=oblique, channel=Channel()))
    # A polytope of no other rows than the box's needs no such program.
    assert verify(synthesize(plant), plant).valid
    with pytest.raises(Infeasible, match="largest ellipsoid"):
        synthesize(oblique)


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, slow(2), slow(3)])
def test_solver_whose_answers_are_a_little_wrong_gives_no_false_certificate(n, monkeypatch):
    plant = random_plant(12, n, 1)
    honest, rng = cp.Problem.solve, np.random.default_rng(0)

    def solve(program, *args, **kwargs):
        honest(program, *args, **kwargs)
        for variable in program.variables():
            if variable.value is not None:
                noise = 1.0 + 1e-2 * rng.standard_normal(variable.shape)
                variable._value = variable.value * (0.5 * (noise + noise.T) if variable.is_symmetric() else noise)

    monkeypatch.setattr(cp.Problem, "solve", solve)
    try:
        certificate = synthesize(plant, safe_set="ellipsoid")
    except Infeasible:
        return
    assert verified(certificate, plant).valid


@pytest.mark.cases(1)
@pytest.mark.parametrize(("a", "b", "contract"), [(0.0, 1.0, None), (0.5, 0.0, None), (0.5, 1e-6, None), (0.0, 1.0, 2)])
def test_gain_that_hardly_matters_leaves_positive_multipliers(a, b, contract):
    """The multiplier of an error that no input answers to is tiny, and must not be rounded to zero."""
    bounds = {"disturbance_bound": 0.1, "sensor_bound": 0.003, "initial_bound": 0.01}
    plant = linear_plant(A=[[a]], B=[[b]], u_max=1.0, dt=0.1, box=[1.0], **bounds)
    certificate = synthesize(plant, contract=contract and ChannelContract(contract), safe_set="ellipsoid")
    assert certificate.provenance["volume_of_box_ellipsoid"] > 0.9999


def test_delayed_inputs_are_the_registers_that_one_writes_by_hand_and_cost_no_search_for_an_ellipsoid():
    """A heat exchanger, whose valve acts seven steps later: registers in order, the oldest first, with wide limits."""
    a, b, d = 0.906112734834199, 0.09388726516580104, 7
    late = linear_plant(
        A=[[a]], B=[[b]], dt=2.1, input_delay=d, box=[0.5], u_max=1.0, disturbance_bound=[0.004], sensor_bound=[0.01],
        initial_bound=[0.02],
    )  # fmt: skip
    A, B, own = np.diag(np.ones(d), 1), np.eye(d + 1)[:, d:], np.zeros(d)
    A[0, :2] = a, b
    by_hand = linear_plant(
        A=A, B=B, H=np.eye(1, d + 1), dt=2.1, box=[0.5, *np.full(d, 4.0)], u_max=1.0,
        disturbance_bound=[0.004, *own], sensor_bound=[0.01], initial_bound=[0.02, *own],
    )  # fmt: skip
    assert late.fingerprint == by_hand.fingerprint
    stages = []
    certificate = synthesize(late, contract=ChannelContract(3), progress=stages.append)
    assert verified(certificate, by_hand).valid
    assert certificate.provenance["share_of_box"] > 0.999
    assert not any("alternation" in each for each in stages)
