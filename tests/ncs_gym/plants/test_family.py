"""A family of plants: the bound that its middle is given, which members there are, and what is refused."""

import itertools
import json
from dataclasses import replace
from fractions import Fraction
from functools import partial

import numpy as np
import pytest

from ncs_gym import Ellipsoid, LinearPlant, cart_pole, truck_trailer
from ncs_gym.plants.family import Family, Remainder
from tests.plants import varying_cart_pole, varying_truck
from tests.product import altered, family_of, linear_plant, loop_env, rate_limited, sampled_plant

MASSES = {"mass": (3800.0, 4200.0)}
POLE = {"pole_mass": (0.098, 0.102), "length": (0.49, 0.51)}
TRUCK, POLES = varying_truck(), varying_cart_pole()
TRUCKS = [truck_trailer(mass=mass) for mass in (3800.0, 4000.0, 4300.0)]
HULL = family_of(TRUCKS)
QUIET = {"disturbance_bound": 0.0, "sensor_bound": 0.0, "initial_bound": 0.0}
SMALL = {"A": [[0.9, 0.1], [0.0, 0.8]], "B": [[0.0], [0.3]], "box": [1.0, 2.0], "u_max": 3.0, "dt": 0.1} | QUIET


def exact(matrix):
    return [[Fraction(entry) for entry in row] for row in np.atleast_2d(matrix).tolist()]


def solved(matrix, vector):
    """The exact solution of P z = r, by elimination."""
    rows = [[*row, entry] for row, entry in zip(matrix, vector, strict=True)]
    for k in range(len(rows)):
        rows[k] = [entry / rows[k][k] for entry in rows[k]]
        for i in range(len(rows)):
            if i != k:
                rows[i] = [a - rows[i][k] * b for a, b in zip(rows[i], rows[k], strict=True)]
    return [row[-1] for row in rows]


def largest_gauge(plant, members, widths):
    """The largest r' R^-1 r of r = ([A_i, B_i] - [A, B]) z over members and the corners z of box and limits: exact.

    It is convex in z and in the member, so that no point of box x limits and of the members' hull has a larger one.
    Members rest where the middle does.
    """
    assert all(not member[:, len(widths) :].any() for member in members)
    members = [member[:, : len(widths)] for member in members]
    middle, P = exact(np.hstack([plant.A, plant.B])), exact(plant.remainder.bound.shape_matrix)
    largest = Fraction(0)
    for member in members:
        off = [
            [a - b for a, b in zip(row, other, strict=True)] for row, other in zip(exact(member), middle, strict=True)
        ]
        for signs in itertools.product((-1, 1), repeat=len(widths)):
            z = [sign * Fraction(width) for sign, width in zip(signs, widths, strict=True)]
            r = [sum(a * b for a, b in zip(row, z, strict=True)) for row in off]
            largest = max(largest, sum(a * b for a, b in zip(r, solved(P, r), strict=True)))
    return largest


def between(function, ranges, count, seed=0):
    """[A, B] of plants at random parameters and at the corners."""
    rng, ends = np.random.default_rng(seed), list(ranges.values())
    points = [*itertools.product(*ends), *([rng.uniform(*end) for end in ends] for _ in range(count))]
    plants = [function(**dict(zip(ranges, map(float, point), strict=True))) for point in points]
    return [np.hstack([each.A, each.B]) for each in plants]


@pytest.mark.parametrize(
    ("plant", "members", "widths"),
    [
        (TRUCK, between(truck_trailer, MASSES, 10), (2.0, 2.0, 4.0)),
        (POLES, between(cart_pole, POLE, 4), (2.4, 3.0, 0.2, 2.0, 10.0)),
        (HULL, [np.hstack([each.A, each.B]) for each in TRUCKS], (2.0, 2.0, 4.0)),
    ],
)
def test_bound_holds_every_member_exactly_and_is_not_far_larger(plant, members, widths):
    gauge = largest_gauge(plant, members, widths)
    assert 0.4 < gauge <= 1
    assert plant.remainder.proved


def test_members_inside_the_hull_leave_out_less_than_its_vertices():
    rng = np.random.default_rng(0)
    inside = np.einsum("ei,ijk->ejk", rng.dirichlet(np.ones(3), 20), HULL.remainder.family.members)
    assert largest_gauge(HULL, inside, (2.0, 2.0, 4.0)) < 1
    beyond = between(truck_trailer, {"mass": (3500.0, 4700.0)}, 0)
    assert largest_gauge(HULL, beyond, (2.0, 2.0, 4.0)) > 1


def test_limits_with_two_ends_and_inputs_under_way_count_by_their_larger_end():
    def of(gain, **more):
        limits = {"state_limits": ([-1.0, -2.0], [0.5, 2.0]), "input_limits": (-1.0, 3.0)}
        model = (SMALL["A"], [[0.0], [gain]], np.eye(2), np.zeros((2, 1)), 0.1)
        return sampled_plant(model, **limits, **QUIET, **more)

    plant = family_of([of(0.3), of(0.5)])
    np.testing.assert_allclose(np.sqrt(np.diag(plant.remainder.bound.shape_matrix)), [0.0, 0.3], rtol=1e-8)
    np.testing.assert_allclose(plant.reach, [1.0, 2.0, 3.0])
    for more, past in (({"input_delay": 2}, [3.0, 3.0]), ({"du_max": 0.5}, [3.0])):
        made = family_of([of(0.3, **more), of(0.5, **more)])
        given = family_of(partial(of, **more), {"gain": (0.3, 0.5)}, monotone=True)
        for each in (made, given):
            size = np.sqrt(np.diag(each.remainder_bound.shape_matrix))
            np.testing.assert_allclose(size, [0.0, 0.3, *(0.0 * np.array(past))], rtol=1e-8, atol=1e-7)
            np.testing.assert_allclose(each.reach, [1.0, 2.0, 3.0, *past])
            assert each.past == len(past)


def test_rows_of_sums_bound_states_and_a_free_state_may_do_the_same_in_all_members():
    def of(entry, column=0, **more):
        A = np.array(SMALL["A"])
        A[0, column] = entry
        return linear_plant(**SMALL | {"A": A} | more)

    sums = {"box": np.array([[1.0, 1.0], [1.0, -1.0]])}
    plant = family_of([of(0.8, **sums), of(0.9, **sums)])
    np.testing.assert_allclose(np.sqrt(np.diag(plant.remainder.bound.shape_matrix)), [0.05, 0.0], rtol=1e-8)
    free = {"box": [np.inf, 2.0]}
    plant = family_of([of(0.1, 1, **free), of(0.2, 1, **free)])
    np.testing.assert_allclose(np.sqrt(np.diag(plant.remainder.bound.shape_matrix)), [0.1, 0.0], rtol=1e-8)
    with pytest.raises(ValueError, match="differ in what x1 does"):
        family_of([of(0.8, **free), of(0.9, **free)])
    alone = {"box": np.array([[1.0, 1.0]])}
    with pytest.raises(ValueError, match="differ in what x1 does"):
        family_of([of(0.8, **alone), of(0.9, **alone)])


def test_middle_is_the_middle_of_the_entries_and_all_else_that_of_the_members():
    ends = [truck_trailer(mass=mass) for mass in MASSES["mass"]]
    np.testing.assert_allclose(TRUCK.A, 0.5 * (ends[0].A + ends[1].A), rtol=1e-12)
    np.testing.assert_allclose(TRUCK.B, 0.5 * (ends[0].B + ends[1].B), rtol=1e-12)
    assert altered(TRUCK, A=ends[0].A, B=ends[0].B, remainder=None).fingerprint == ends[0].fingerprint
    assert TRUCK.fingerprint != altered(TRUCK, remainder=None).fingerprint


def test_file_holds_the_members_listed_of_a_function_the_corners(tmp_path):
    for plant, count in ((HULL, 3), (POLES, 4)):
        plant.save(tmp_path / "plant.json")
        read = LinearPlant.load(tmp_path / "plant.json")
        assert read.fingerprint == plant.fingerprint
        assert read.remainder.sentence == plant.remainder.sentence
        family, own = read.remainder.family, plant.remainder.family
        np.testing.assert_array_equal(family.members, own.members)
        np.testing.assert_array_equal(family.parameters, own.parameters)
        assert (family.names, family.function, len(family.members)) == (own.names, None, count)
        drawn = {tuple(loop_env(read, **_contract(read)).reset(seed=seed)[1]["parameters"]) for seed in range(30)}
        assert drawn == set(map(tuple, own.parameters.tolist()))


def _contract(plant):
    from ncs_gym import ChannelContract

    return {} if plant.spectral_radius < 1.0 else {"contract": ChannelContract(3)}


def tank(k, delay=0, level=None, **more):
    """h' = 0.5 q - k h, in absolute coordinates, at rest at 0.4 / k with q = 0.8; q may act later."""
    settings = {"state_limits": ([1.5], [2.5]), "input_limits": (0.0, 2.0), "input_delay": delay or None}
    settings |= {"operating_state": [0.4 / k if level is None else level], "operating_input": [0.8]}
    decay = np.exp(-0.5 * k)
    model = ([[decay]], [[0.5 * (1.0 - decay) / k]], np.eye(1), np.zeros((1, 1)), 0.5)
    return sampled_plant(model, **settings | QUIET | more)


@pytest.mark.parametrize(("delay", "kind"), [(0, "plants"), (1, "function")])
def test_members_that_rest_elsewhere_leave_out_no_more_than_the_bound_in_absolute_coordinates(kind, delay):
    def of(k):
        return tank(k, delay, offset=[0.0])

    values = (0.19, 0.2, 0.21)
    given = (of, {"k": (0.19, 0.21)}) if kind == "function" else ([of(k) for k in values],)
    plant = family_of(*given, monotone=kind == "function", at_rest=True)
    assert "at rest at its operating point (given)" in plant.remainder.sentence
    x0, u0 = plant.operating_state, plant.operating_input
    np.testing.assert_allclose(u0 + plant.input_ends[:, 0], [0.0, 2.0], atol=1e-15)
    np.testing.assert_allclose(plant.operating_state[0] + plant.box_ends[:, 0] / plant.box[0, 0], [1.5, 2.5])
    size, largest = np.sqrt(plant.remainder.bound.shape_matrix[0, 0]), 0.0
    for k in (*values, *np.linspace(0.19, 0.21, 7)):
        decay = np.exp(-0.5 * k)
        for level, acts, decided in itertools.product((1.5, 2.5), (0.0, 2.0), (0.0, 2.0)):
            acts = acts if delay else decided
            truth = [decay * level + 0.5 * (1.0 - decay) / k * acts, *[decided] * delay]
            model = plant.A @ ([level, *[acts] * delay] - x0) + plant.B @ (decided - u0)
            left_out = truth - x0 - model
            np.testing.assert_allclose(left_out[1:], 0.0, atol=1e-15)
            largest = max(largest, abs(left_out[0]))
    assert 0.5 * size < largest <= size
    env = loop_env(plant, initial_set=Ellipsoid(1e-6 * np.eye(plant.n)))
    for k in (0.19, 0.21):
        parameters = {"k": k} if kind == "function" else {"member": values.index(k)}
        info = env.reset(seed=0, options={"parameters": parameters})[1]
        for _ in range(60):
            info = env.step((0.8 - u0 - plant.input_middle) / plant.input_half)[-1]
        np.testing.assert_allclose((info["state"] + x0)[0], 0.4 / k, atol=2e-3)


def test_members_are_at_rest_where_somebody_says_so():
    def at_two(k):
        return tank(k, level=2.0)

    ranges, sentence = {"k": (0.19, 0.21)}, "say at_rest=True if each is at rest"
    for members in ((at_two, ranges), ([at_two(0.19), at_two(0.21)],)):
        with pytest.raises(ValueError, match=sentence):
            family_of(*members, monotone=len(members) > 1)
    stays = family_of(at_two, ranges, monotone=True, at_rest=True)
    assert not stays.remainder.family.members[..., -1].any()
    assert stays.operating_state == 2.0


def family_in(document):
    """What a document of a plant says of its family."""
    return document["bounds"]["disturbance"]["Sum"]["parts"][-1]["Remainder"]["family"]


def test_the_bound_of_a_family_is_worked_out_from_its_members_wherever_it_comes_from():
    document = json.loads(json.dumps(HULL.document))
    family_in(document)["members"][2][1][2] *= 3.0  # a stronger input
    read = LinearPlant.load(document)
    assert largest_gauge(read, read.members.members, (2.0, 2.0, 4.0)) <= 1
    assert read.remainder.bound.shape_matrix[1, 1] > 4.0 * HULL.remainder.bound.shape_matrix[1, 1]
    smaller = Remainder(Ellipsoid(np.zeros((2, 2))), True, "nothing is left out", HULL.members)
    wider = altered(HULL, box=[4.0, 4.0], remainder=smaller)
    assert largest_gauge(wider, wider.members.members, (4.0, 4.0, 4.0)) <= 1
    assert altered(HULL, remainder=smaller).fingerprint == HULL.fingerprint
    for changes in ({"interval": None}, {"check": None}, {"function": None, "interval": None}):
        with pytest.raises(ValueError, match="needs"):
            replace(TRUCK.members, **changes)
    document = json.loads(json.dumps(TRUCK.document))
    family_in(document)["interval"] = None
    with pytest.raises(ValueError, match="needs interval"):
        LinearPlant.load(document)
    document = json.loads(json.dumps(TRUCK.document))
    family_in(document)["members"][0][1][2] *= 3.0
    with pytest.raises(ValueError, match="must lie in its interval"):
        LinearPlant.load(document)
    late = family_of(
        [linear_plant(**SMALL, input_delay=1), linear_plant(**SMALL | {"B": [[0.0], [0.4]]}, input_delay=1)]
    )
    document = json.loads(json.dumps(late.document))
    family_in(document)["members"][0][2][3] *= 0.5  # of the input under way
    with pytest.raises(ValueError, match="must have the past inputs of the plant of the middle"):
        LinearPlant.load(document)


@pytest.mark.parametrize(
    ("changed", "name"),
    [({"disturbance_bound": 0.05}, r"Bounds\(disturbance=...\)"), ({"H": [[1.0, 0.1], [0.0, 1.0]]}, "H")],
)
def test_what_members_share_is_compared_inside_the_ranges(changed, name):
    def of(angle):
        model = {"A": [[0.9, 0.1 * (angle + 2.0)], [0.0, 0.8]]} | {"disturbance_bound": 0.02}
        return linear_plant(**SMALL | model | (changed if abs(angle) < where else {}))

    where = 0.6  # on the grid
    with pytest.raises(ValueError, match=f"one inside the ranges differs in {name}"):
        family_of(of, {"angle": (-1.16, 1.16)}, monotone=True)
    where = 1e-3  # between its points
    env = loop_env(family_of(of, {"angle": (-1.16, 1.16)}, monotone=True))
    env.reset(options={"parameters": {"angle": 0.5}})
    with pytest.raises(ValueError, match=f"one inside the ranges differs in {name}"):
        env.reset(options={"parameters": {"angle": 0.0}})


def test_two_ended_disturbances_move_each_member():
    def pushed(k):
        return tank(k, disturbance_bound=([[1.0]], [-0.01], [0.03]))

    plant = family_of(pushed, {"k": (0.19, 0.21)}, monotone=True, at_rest=True)
    assert plant.remainder.family.members[..., -1].all()
    width = np.sqrt(plant.of_disturbance.bound.shape_matrix.item())
    assert 0.02 <= width <= 0.02 + 5e-8  # what the members' rest lacks of an equilibrium by rounding is inside


def read_back(plant):
    return LinearPlant.load(json.loads(json.dumps(plant.document)))


@pytest.mark.filterwarnings("ignore::ncs_gym.limits.MovedOperatingPointWarning")
def test_members_belong_to_the_point_that_they_are_in_deviations_from():
    point = {"operating_state": [1.0, 0.5], "operating_input": [0.3]}
    for plant in (family_of(two(B=[[0.0], [0.4]])), read_back(family_of([linear_plant(**SMALL | point)] * 2))):
        x, u = plant.operating_state + 0.1, plant.operating_input
        moved = {"operating_state": x, "state_limits": (x - 1.0, x + 3.0), "input_limits": (u - 3.0, u + 3.0)}
        for change in ({"disturbance_bound": ([[1.0], [0.0]], [0.0], [0.01])}, {"operating_input": u} | moved):
            with pytest.raises(ValueError, match="in deviations from another operating point"):
                altered(plant, **change)


def bent(mass):
    """Its gain rises and falls again."""
    return linear_plant(**SMALL | {"B": [[0.0], [0.3 + 0.01 * mass * (1.0 - mass)]]})


def spiked(mass):
    """Monotone at each of the six points of the grid, not between two of them."""
    return linear_plant(**SMALL | {"B": [[0.0], [0.3 + 0.1 * mass + (0.4 < 5 * mass % 1 < 0.6)]]})


def test_entries_that_are_not_monotone_are_found_on_the_grid_or_when_they_are_drawn():
    with pytest.raises(ValueError, match=r"B\[1, 0\] is not monotone in mass from 0 to 1"):
        family_of(bent, {"mass": (0.0, 1.0)}, monotone=True)
    env = loop_env(family_of(spiked, {"mass": (0.0, 1.0)}, monotone=True))
    env.reset(options={"parameters": {"mass": 0.2}})
    with pytest.raises(ValueError, match=r"B\[1, 0\] at .* is not between those at the ends"):
        env.reset(options={"parameters": {"mass": 0.1}})


def two(**changes):
    return [linear_plant(**SMALL), linear_plant(**SMALL | changes)]


MODEL = ([[0.0, 1.0], [0.0, -0.5]], [[0.0], [1.0]], np.eye(2), np.zeros((2, 1)))
SAMPLED = sampled_plant(MODEL, dt=0.1, box=[1.0, 2.0], u_max=1.0, between_samples=4, **QUIET)
LEFT_OUT = Remainder(Ellipsoid(1e-4 * np.eye(2)), False, "an example")
REFUSED = {
    "nothing between the ends": (lambda: family_of(truck_trailer, MASSES), "say monotone=True if"),
    "no ranges": (lambda: family_of(truck_trailer), "ranges must be a dictionary of 1 to 6"),
    "no range": (lambda: family_of(truck_trailer, {"mass": 4000.0}, monotone=True), r"must be \(low, high\)"),
    "ends": (lambda: family_of(truck_trailer, {"mass": (4.0, 3.0)}, monotone=True), "low < high"),
    "ranges of plants": (lambda: family_of(TRUCKS, MASSES), "about a function"),
    "one plant": (lambda: family_of(TRUCKS[:1]), "two plants or more"),
    "no truth value": (lambda: family_of(TRUCKS, at_rest="no"), "at_rest must be"),
    "another box": (lambda: family_of(two(box=[1.0, 1.0])), "member 1 differs in Limits of states"),
    "a step": (lambda: family_of(truck_trailer, {"dt": (0.4, 0.5)}, monotone=True), "differs in dt"),
    "a remainder": (lambda: family_of(two(remainder=LEFT_OUT)), "without a remainder of their own"),
    "between samples": (lambda: family_of([SAMPLED, SAMPLED]), "without between_samples"),
    "between samples later": (lambda: altered(HULL, between_samples=4), "between_samples"),
    "rates later": (
        lambda: rate_limited(family_of(two(B=[[0.0], [0.4]])), 0.5),
        r"must be \[A, B, s\] of shape \(3, 5\)",
    ),
    "not a plant": (lambda: family_of(partial(dict, a=1), {"b": (0, 1)}, monotone=True), "must be plants"),
    "sizes": (
        lambda: altered(
            HULL,
            remainder=Remainder(
                HULL.remainder.bound,
                True,
                "an example",
                Family(names=["member"], parameters=[[0.0]], members=np.zeros((1, 3, 5))),
            ),
        ),
        r"of shape \(2, 4\)",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_covered_is_refused_with_a_sentence(name):
    call, sentence = REFUSED[name]
    with pytest.raises(ValueError, match=sentence):
        call()
