"""What all estimators of a process share stays right, whatever interrupts the one that is adding to it."""

from functools import partial

import numpy as np
import pytest

from ncs_gym import Channel, Estimator, Packet, certified_error_set, truck_trailer
from ncs_gym.estimation import arrival_histories, error_table
from ncs_gym.estimation.arrival_histories import histories_of
from ncs_gym.estimation.vector_estimator import VectorEstimator
from tests.interruptions import interrupt, places

PLANT = truck_trailer(mass=4000.0)
CHANNEL = Channel(delay=1, jitter=1)
STEPS = 12
# Where what is shared is written.
SHARED = ("arrival_histories.py", "error_table.py")


@pytest.fixture(autouse=True)
def _small_tables(monkeypatch):
    """Tables that have to grow soon."""
    for module in (arrival_histories, error_table):
        monkeypatch.setattr(module, "FIRST_CAPACITY", 8)


def graph():
    return histories_of(PLANT, CHANNEL, certified_error_set(PLANT))


def traffic(rng):
    """Of each step an input, a sample, and the ages of the samples that arrive, oldest first."""
    for step in range(1, STEPS + 1):
        ages = [age for age in (2, 1) if rng.random() < 0.5 and step > age]
        yield rng.uniform(-1, 1, PLANT.m), rng.uniform(-0.1, 0.1, PLANT.n), ages


def alone(histories, seed):
    """Means, shapes and ages of an estimator."""
    estimator, samples, seen = Estimator(PLANT, CHANNEL, histories=histories), [np.zeros(PLANT.n)], []
    for step, (u, sample, ages) in enumerate(traffic(np.random.default_rng(seed)), 1):
        samples.append(sample)
        estimator.advance(u, [Packet(step - age, samples[step - age]) for age in ages])
        seen.append([*estimator.mean, *estimator.shape.ravel(), estimator.age])
    return np.array(seen)


def together(histories, seed):
    """The same of two vectorized ones, of which the second hears nothing."""
    estimator, seen = VectorEstimator(PLANT, histories, 2), []
    for u, sample, ages in traffic(np.random.default_rng(seed)):
        arrivals = [(age, np.array([True, False])) for age in ages]
        estimator.advance(np.stack([u, u], axis=1), np.stack([sample, sample], axis=1), arrivals)
        shapes = estimator.histories.table.shapes[estimator.statistics]
        seen.append([*estimator.mean.ravel(), *shapes.ravel(), *estimator.age])
    return np.array(seen)


@pytest.mark.parametrize("stride", [12, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("fill", [alone, together])
def test_estimates_and_error_sets_are_the_same_after_an_interruption_of_another_estimator(fill, stride):
    """One that fills a graph is interrupted; who uses it afterwards equals who has a graph of their own."""
    expected = {use: use(graph(), 1) for use in (alone, together)}
    tried = 0
    for place in places(partial(fill, graph(), 0), stride, *SHARED):
        for later in (0, 499):  # a line that is executed early, and one in the middle
            histories = graph()
            tried += interrupt(place + later, partial(fill, histories, 0))
            for use, wanted in expected.items():
                np.testing.assert_array_equal(use(histories, 1), wanted)
    assert tried > 3
