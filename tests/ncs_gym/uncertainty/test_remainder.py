"""The remainder of a model belongs to the plant that it was found for."""

import copy
import pickle

import numpy as np
import pytest

from ncs_gym import Ellipsoid, LinearPlant
from ncs_gym.uncertainty.remainder import Remainder
from tests.product import altered, linear_model

ROOM = {"disturbance_bound": 0.0, "sensor_bound": 0.001, "initial_bound": 0.001}


def swinging(x, u):
    """One step of a pendulum."""
    return np.array([x[0] + 0.05 * x[1], x[1] - 0.05 * np.sin(x[0]) + 0.05 * u[0]])


PLANT = linear_model(swinging, box=[0.5, 1.0], u_max=1.0, dt=0.05, samples=400, **ROOM)


def test_other_arguments_change_beside_the_remainder(tmp_path):
    assert altered(PLANT, sensor_bound=0.002).remainder is PLANT.remainder
    assert altered(PLANT, box=PLANT.box.copy()).fingerprint == PLANT.fingerprint
    assert altered(PLANT, box=[1.0, 1.0], remainder=None).remainder is None
    PLANT.save(tmp_path / "plant.json")
    twins = LinearPlant.load(tmp_path / "plant.json"), copy.deepcopy(PLANT), pickle.loads(pickle.dumps(PLANT))
    for twin in twins:
        assert twin.fingerprint == PLANT.fingerprint
        with pytest.raises(ValueError, match="another model, limits or operating point"):
            altered(twin, box=[1.0, 1.0])


def test_remainder_given_anew_holds_for_whatever_it_is_given_for():
    remainder = Remainder(Ellipsoid(1e-4 * np.eye(2)), False, "an example")
    first = altered(PLANT, remainder=remainder)
    wider = altered(PLANT, box=[1.0, 1.0], remainder=remainder)
    assert first.remainder.sentence == wider.remainder.sentence == remainder.sentence
