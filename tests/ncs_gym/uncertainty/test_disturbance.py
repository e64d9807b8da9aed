import numpy as np
import pytest

from ncs_gym import AdversarialDisturbance, BoxDisturbance, SinusoidDisturbance
from ncs_gym.uncertainty.disturbances import BY_NAME, as_disturbance, checked
from tests.plants import random_plant


def draws(source, plant, count=400, seed=0):
    rng = np.random.default_rng(seed)
    memory = source.begin(rng, plant)
    return np.array([source.draw(rng, plant, rng.standard_normal(plant.n), k, memory) for k in range(count)])


@pytest.mark.parametrize("name", BY_NAME)
@pytest.mark.parametrize("n", [1, 2, 4])
def test_every_kind_stays_in_its_bound(name, n):
    plant = random_plant(n, n, 1)
    source = as_disturbance(name, plant, False)
    samples = draws(source, plant)
    if source.replaces_process_noise:
        assert all(plant.disturbance.contains(d) for d in samples)
    else:
        assert (samples**2).sum(axis=1).max() <= plant.gamma * (1 + 1e-12)


@pytest.mark.parametrize("name", ["sphere", "adversarial"])
def test_extremal_kinds_use_the_whole_bound(name, plant):
    samples = draws(as_disturbance(name, plant, False), plant)
    assert min(plant.disturbance.gauge(d) for d in samples) > 1.0 - 1e-9


def test_process_noise_is_part_of_what_extremal_kinds_use(plant):
    radius = np.sqrt((draws(as_disturbance("sphere", plant, False), plant) ** 2).sum(axis=1)).max()
    assert radius > 1.5 * np.sqrt(plant.gamma)


def test_adversary_pushes_out_of_the_rows_that_it_is_given(plant):
    rng = np.random.default_rng(1)
    rows = np.array([[1.0, 2.0], [-3.0, 1.0], [0.0, 1.0]])
    source = AdversarialDisturbance(rows=rows)
    for _ in range(100):
        nominal = rng.standard_normal(2)
        d = source.draw(rng, plant, nominal, 0, None)
        others = plant.disturbance.sample_boundary(rng, 50)
        assert np.abs(rows @ (nominal + d)).max() >= np.abs(rows @ (nominal + others).T).max() - 1e-9
    with pytest.raises(ValueError, match="rows must have 2 columns, got 3"):
        as_disturbance(AdversarialDisturbance(rows=np.ones((1, 3))), plant, False)


def test_adversary_maximizes_the_largest_constraint(plant):
    rng = np.random.default_rng(1)
    for _ in range(50):
        nominal = rng.uniform(-2, 2, 2)
        worst = AdversarialDisturbance().draw(rng, plant, nominal, 0, None)
        value = np.abs(plant.box_rows @ (nominal + worst)).max()
        others = [np.abs(plant.box_rows @ (nominal + plant.disturbance.sample_boundary(rng))).max() for _ in range(300)]
        assert value >= max(others) - 1e-12


def test_adversary_with_a_matrix_maximizes_its_level(plant):
    rng = np.random.default_rng(2)
    M = np.array([[0.5, 0.1], [0.1, 0.2]])
    for _ in range(50):
        nominal = rng.uniform(-2, 2, 2)
        end = nominal + AdversarialDisturbance(M).draw(rng, plant, nominal, 0, None)
        others = [nominal + plant.disturbance.sample_boundary(rng) for _ in range(300)]
        assert end @ M @ end >= max(other @ M @ other for other in others) - 1e-9


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


def test_box_beyond_the_bound_is_possible_on_purpose(plant):
    assert as_disturbance(BoxDisturbance([0.1, 0.1]), plant, True).half_widths[0] == 0.1
