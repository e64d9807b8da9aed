import numpy as np
import pytest

from ncs_gym import AdversarialDisturbance, SinusoidDisturbance
from ncs_gym.disturbances import as_disturbance, checked


def draws(source, plant, count=400, seed=0):
    rng = np.random.default_rng(seed)
    memory = source.begin(rng, plant)
    return np.array([source.draw(rng, plant, rng.standard_normal(plant.n), k, memory) for k in range(count)])


@pytest.mark.parametrize("name", ["sphere", "adversarial"])
def test_extremal_kinds_use_the_whole_bound(name, plant):
    samples = draws(as_disturbance(name, plant, False), plant)
    assert min(plant.disturbance.gauge(d) for d in samples) > 1.0 - 1e-9


ROWS, M = np.array([[1.0, 2.0], [-3.0, 1.0], [0.0, 1.0]]), np.array([[0.5, 0.1], [0.1, 0.2]])


@pytest.mark.parametrize(
    ("source", "value"),
    [
        (AdversarialDisturbance(), lambda plant, x: np.abs(x @ plant.box.T).max(axis=1)),
        (AdversarialDisturbance(rows=ROWS), lambda plant, x: np.abs(x @ ROWS.T).max(axis=1)),
        (AdversarialDisturbance(M), lambda plant, x: np.sum(x @ M * x, axis=1)),
    ],
    ids=["box", "rows", "level"],
)
def test_adversary_moves_farther_than_whatever_else_is_allowed(source, value, plant):
    rng = np.random.default_rng(1)
    for nominal in rng.uniform(-2.0, 2.0, (50, 2)):
        worst = nominal + source.draw(rng, plant, nominal, 0, None)
        others = nominal + plant.disturbance.sample_boundary(rng, 300)
        assert value(plant, worst[None])[0] >= value(plant, others).max() - 1e-9


def test_sinusoid_repeats_with_its_period(plant):
    samples = draws(SinusoidDisturbance(period=8.0), plant, 64)
    np.testing.assert_allclose(samples[:8], samples[8:16], atol=1e-12)
    assert np.linalg.norm(samples, axis=1).max() > 0.9 * np.sqrt(plant.gamma)


def test_a_point_on_the_bound_passes_and_one_beyond_it_raises(plant):
    edge = plant.disturbance.extreme_point(np.ones(2))
    assert plant.disturbance.contains(checked(plant, edge, allow_assumption_violation=False))
    with pytest.raises(ValueError, match=r"outside its bound E\(D\): .* = 1\.001"):
        checked(plant, 1.001 * edge, allow_assumption_violation=False)
    np.testing.assert_array_equal(checked(plant, 9 * edge, allow_assumption_violation=True), 9 * edge)


def test_what_rounding_may_have_put_beyond_the_bound_is_scaled_back_and_no_more_than_that(plant):
    rng, allowed = np.random.default_rng(0), plant.allowed_disturbance
    for _ in range(50):
        edge = plant.disturbance.extreme_point(rng.standard_normal(2))
        edge /= plant.disturbance.gauge(edge)
        taken = checked(plant, (1.0 + 0.9e-9) * edge, allow_assumption_violation=False)
        assert 1.0 - 2e-12 < allowed.gauge(taken) < 1.0
        np.testing.assert_allclose(taken, edge, rtol=1e-8)
        with pytest.raises(ValueError, match=r"outside its bound E\(D\)"):
            checked(plant, (1.0 + 1.1e-9) * edge, allow_assumption_violation=False)
