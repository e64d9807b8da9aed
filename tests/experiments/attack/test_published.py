"""Attacks on plants as they are published: limits with two ends and limits of rates are under the same attack."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.attack.monte_carlo_batch import MonteCarloBatch, cases_of
from experiments.published.attack import attack
from experiments.published.largest_share import largest_share
from experiments.settings import AttackSettings
from ncs_gym import LinearPlant
from tests.certificates import certificate_of
from tests.shields.polytope.limits import CONTRACT, PLANTS


@pytest.mark.parametrize(
    "name", ["rates", *(pytest.param(name, marks=pytest.mark.slow) for name in ("angle", "coupled"))]
)
def test_no_limit_is_broken_under_attack_and_all_are_without_the_shield(name, tmp_path):
    plant, certificate = PLANTS[name], certificate_of(PLANTS[name], CONTRACT, "polytope")
    counts = attack(plant, certificate, 50_000)
    assert counts.steps >= 50_000
    assert counts.exits == counts.violations == counts.unproved == counts.outside_starts == 0
    assert counts.interventions > 1_000
    plant.save(tmp_path / "plant.json")
    settings = AttackSettings(plant=tmp_path / "plant.json", max_age=CONTRACT.max_age, envs=100, unshielded=True)
    alone = MonteCarloBatch(settings, next(iter(cases_of(settings))), 0, certificate).execute(lambda count: None)
    assert alone.violations > 1_000


def test_largest_share_is_where_an_input_can_still_turn_the_state_round():
    """x+ = 1.25 x + u with |u| <= 1: from |x| <= 4; that of the other state is kept, whatever the sign of its row."""
    exact = {"dt": 0.1, "disturbance_bound": 0.01, "sensor_bound": 0.0, "initial_bound": 0.0}
    plant = LinearPlant(A=np.diag([1.25, 0.5]), B=np.eye(2, 1), box=np.diag([0.1, -1.0]), u_max=1.0, **exact)
    assert largest_share(plant) == pytest.approx(0.4, abs=0.01)
    assert largest_share(replace(plant, box=np.array([[0.1, 0.0]]))) is None
