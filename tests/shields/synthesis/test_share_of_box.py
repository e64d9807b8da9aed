"""The share of the safe box that a set fills, and the reach that is said instead."""

import numpy as np
import pytest

from ncs_gym import Ellipsoid, truck_trailer
from shields.certificate_text import size_of
from shields.synthesis.certificate_fields import reach_recorded, share_of_box
from tests.certificates import certificate_of
from tests.plants import delayed, random_plant
from tests.product import altered, linear_plant, synthesize


def test_largest_ellipse_fills_a_quarter_of_pi_whatever_the_units():
    for units in ([1.0, 1.0], [1e-4, 1e5]):
        plant = altered(truck_trailer(), box=np.diag(1.0 / np.array(units)))
        assert share_of_box(plant, np.diag(np.square(units)))["share_of_box"] == pytest.approx(np.pi / 4.0, rel=1e-12)


def test_box_with_more_rows_than_states_has_no_share_and_the_reach_is_said_instead():
    plant = random_plant(0, 6, 1)
    box = np.concatenate([np.eye(6), np.full((1, 6), 0.1)])
    plant, L = altered(plant, box=box), 0.25 * np.eye(6)
    assert share_of_box(plant, L) == {}
    record = reach_recorded(Ellipsoid(L), plant)
    assert record["reach"] == [*(f"50 % of |x{i}| <= 1" for i in range(1, 7)), record["reach"][6]]
    assert record["reach"][6].startswith("12.25 % of |x1 + x2 + ")
    assert size_of(record) == f"up to {', '.join(record['reach'])}"
    assert size_of({"reach": ["1 %", 2.0], "share_of_box": "none"}) == "up to 1 %"


def test_share_of_a_polytope_is_of_what_further_limits_leave_of_the_box():
    limit = [1.0, 1.0], -1.1, 1.0
    plant = linear_plant(
        A=[[0.9, 0.4], [-0.3, 0.9]], B=[[0.0], [0.1]], dt=0.1, state_limits=([-1.0, -0.5], [0.8, 1.0]), u_max=0.5,
        output_limits=[limit], disturbance_bound=0.02, sensor_bound=0.01, initial_bound=0.02,
    )  # fmt: skip
    certificate = synthesize(plant)
    drawn = np.random.default_rng(0).uniform([-1.0, -0.5], [0.8, 1.0], (400_000, 2))
    inside = drawn[(limit[1] <= drawn.sum(axis=1)) & (drawn.sum(axis=1) <= limit[2])]
    share = np.mean(certificate.safe_set.gauge(inside) <= 1.0)
    assert 0.3 < share < 0.95
    assert certificate.provenance["share_of_box"] == pytest.approx(share, abs=4e-3)
    said = " ".join(str(certificate).split())
    assert f"size {100.0 * certificate.provenance['share_of_box']:.3g} % of the safe box's volume" in said
    assert "size up to" not in said


@pytest.mark.parametrize("steps", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_share_with_delayed_inputs_is_that_of_the_states_with_no_input_under_way(steps):
    plant = delayed(steps)
    assert plant.past == steps
    certificate = certificate_of(plant)
    states = np.random.default_rng(1).uniform(-1.0, 1.0, (100_000, 2)) * [1.0, 1.5]
    at_rest = np.concatenate([states, np.zeros((len(states), steps))], axis=1)
    share = float((certificate.safe_set.gauge(at_rest) <= 1.0).mean())
    assert certificate.provenance["share_of_box_at_rest"] == pytest.approx(share, abs=6e-3)
    assert "share_of_box" not in certificate.provenance
    assert "of the safe box of the states, with no input under way" in " ".join(str(certificate).split())
