from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from experiments.paper.audit import Verdict, late_packets, sensor
from experiments.paper.late_packets import Definition1Filter, discarded, largest_error, replayed, taken_as_current
from experiments.paper.paper_example import PaperExample

CASE = PaperExample()
PLANT = CASE.plant
EVERYWHERE = np.array([True])


def textbook_filter(mean):
    """Definition 1 by filterpy."""
    kalman = KalmanFilter(dim_x=2, dim_z=2)
    kalman.x, kalman.P = np.array(mean), np.array(PLANT.initial_noise.covariance)
    kalman.F, kalman.H = PLANT.A + PLANT.B @ CASE.K, PLANT.H
    kalman.Q, kalman.R = (
        PLANT.process_noise.covariance + PLANT.gamma * np.eye(2),
        np.array(PLANT.sensor_noise.covariance),
    )
    return kalman


@pytest.mark.parametrize("takes_late", [True, False])
def test_filter_is_the_textbook_filter_where_a_late_packet_is_current_or_discarded(takes_late):
    rng = np.random.default_rng(0)
    mean = np.array([[1.0], [-0.5]])
    ours = Definition1Filter(CASE, PLANT, mean.copy(), takes_late=takes_late)
    textbook, samples = textbook_filter(mean), []
    for step in range(30):
        samples.append(rng.standard_normal((2, 1)))
        age = (0, 2)[step % 2] if step >= 2 else None
        ours.advance(np.zeros((1, 1)), samples[-1], [] if age is None else [(age, EVERYWHERE)])
        textbook.predict()
        if age is not None and (age == 0 or takes_late):
            textbook.update(samples[step - age])
        np.testing.assert_allclose(ours.mean, textbook.x, atol=1e-12)


def test_late_packets_taken_as_current_break_the_bound_and_the_replaying_filter_keeps_it():
    current, skipped, again = (largest_error(CASE, make) for make in (taken_as_current, discarded, replayed))
    assert current > 3.0 * CASE.epsilon
    assert again < 0.1 * CASE.epsilon
    assert again <= skipped < 0.1 * CASE.epsilon


def test_claim_would_hold_with_a_larger_epsilon():
    assert late_packets(CASE).verdict == Verdict.UNDECIDED
    assert late_packets(replace(CASE, epsilon=0.1)).verdict == Verdict.HOLDS


def test_the_noise_that_is_not_printed_does_not_decide():
    low, high = (float(part) for part in sensor(CASE).computed.rsplit(" is ", 1)[1].split(" to "))
    assert CASE.epsilon < low < high
    assert largest_error(CASE, taken_as_current, noise_variance=1e-3) == pytest.approx(low, abs=6e-4)
