"""What solvers print: nothing, however they are called, so that the output of programs is theirs."""

import numpy as np

from shields.synthesis.faces import Extremes, Faces
from tests.product import linear_plant, synthesize


def test_solvers_print_nothing(capfd):
    faces = Faces(np.eye(2), -np.ones(2), np.ones(2))
    assert Extremes(faces).of(np.array([1.0, 2.0])) == (-3.0, 3.0)
    plant = linear_plant(
        A=[[0.9, 0.1], [0.0, 0.8]], B=[[0.0], [0.3]], dt=0.1, box=[1.0, 2.0], u_max=3.0,
        disturbance_bound=0.01, sensor_bound=0.01, initial_bound=0.01,
    )  # fmt: skip
    assert synthesize(plant, safe_set="polytope").polytope is not None
    assert capfd.readouterr() == ("", "")
