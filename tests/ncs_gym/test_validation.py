import copy
import pickle

import numpy as np
import pytest

from ncs_gym import AdversarialDisturbance, BoxDisturbance, Ellipsoid, Regulation, truck_trailer

SETTINGS = {
    "plant": (truck_trailer(), "A"),
    "ellipsoid": (Ellipsoid(np.eye(2)), "shape"),
    "disturbance": (AdversarialDisturbance(np.eye(2)), "M"),
    "box": (BoxDisturbance([0.1, 0.2]), "half_widths"),
    "task": (Regulation(state_cost=np.eye(2)), "state_cost"),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_arrays_stay_read_only_through_copies_and_pickles(name):
    thing, field = SETTINGS[name]
    for twin in (thing, copy.copy(thing), copy.deepcopy(thing), pickle.loads(pickle.dumps(thing))):
        with pytest.raises(ValueError, match="read-only"):
            getattr(twin, field)[0] = 7.0


def test_settings_do_not_share_memory_with_what_they_were_made_from():
    shape = np.eye(2)
    ellipsoid = Ellipsoid(shape)
    shape[0, 0] = 5.0
    assert ellipsoid.shape_matrix[0, 0] == 1.0


def test_derived_bounds_survive_pickling_read_only():
    plant = truck_trailer()
    bound = plant.disturbance.shape_matrix.copy()
    twin = pickle.loads(pickle.dumps(plant))
    np.testing.assert_array_equal(twin.disturbance.shape_matrix, bound)
    assert not twin.disturbance.shape_matrix.flags.writeable
    assert twin.fingerprint == plant.fingerprint
