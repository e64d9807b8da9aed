import numpy as np
import pytest
from scipy.stats import chi2, kstest, norm, truncnorm

from ncs_gym.draws import (
    fill_directions,
    fill_keys,
    fill_normal,
    fill_stream,
    fill_truncated,
    fill_uniform,
    normals,
    uniform_many,
)
from ncs_gym.law import BALL, BOX, SPHERE, add_drawn

COUNT = 200_000


def keys_of(seed, count=COUNT):
    keys = np.empty(count, np.uint64)
    fill_keys(np.uint64(seed), keys)
    return keys


def drawn(fill, *settings, rank, seed=1, count=COUNT):
    out = normals(rank, count)
    fill(keys_of(seed, count), 7, *settings, out)
    return out[:rank]


def test_uniform_numbers_are_uniform_and_never_zero_or_one():
    numbers = np.empty((3, COUNT))
    fill_uniform(keys_of(0), 0, 3, numbers)
    assert 0.0 < numbers.min() < 1e-4
    assert 1.0 - 1e-4 < numbers.max() < 1.0
    assert all(kstest(row, "uniform").pvalue > 1e-3 for row in numbers)
    assert np.abs(np.corrcoef(numbers) - np.eye(3)).max() < 0.01


def test_one_key_draws_independent_numbers_over_time():
    numbers, keys = np.empty((1, 2)), keys_of(3, 2)
    series = []
    for number in range(20000):
        fill_uniform(keys, number, 1, numbers)
        series.append(numbers[0].copy())
    series = np.array(series)
    assert all(kstest(row, "uniform").pvalue > 1e-3 for row in series.T)
    both = np.column_stack([series[:-1], series[1:]])
    assert np.abs(np.corrcoef(both.T) - np.eye(4)).max() < 0.03


def test_numbers_of_a_seed_are_the_published_ones_of_splitmix64():
    published = [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431]
    numbers = np.empty((2, 2))
    fill_stream(np.uint64(1234567), numbers)
    np.testing.assert_allclose(numbers.ravel() * 2.0**64, published, rtol=1e-14)


def test_numbers_drawn_for_many_are_uniform_and_follow_from_the_generator():
    rng = np.random.default_rng(0)
    numbers = np.concatenate([uniform_many(rng, 2, 100) for _ in range(COUNT // 100)], axis=1)
    assert all(kstest(row, "uniform").pvalue > 1e-3 for row in numbers)
    assert np.abs(np.corrcoef(np.vstack([numbers[:, 1:], numbers[:, :-1]])) - np.eye(4)).max() < 0.01
    first, second = np.random.default_rng(5), np.random.default_rng(5)
    np.testing.assert_array_equal(uniform_many(first, 2, 3), uniform_many(second, 2, 3))


@pytest.mark.parametrize("rank", [1, 2, 3, 4])
def test_normal_numbers_are_normal_far_into_the_tails(rank):
    g = drawn(fill_normal, 1.0, np.inf, rank=rank)
    assert all(kstest(row, "norm").pvalue > 1e-3 for row in g)
    np.testing.assert_allclose(np.cov(g), np.eye(rank) if rank > 1 else 1.0, atol=0.015)
    np.testing.assert_allclose((g**4).mean(axis=1), 3.0, atol=0.1)
    np.testing.assert_allclose((np.abs(g) > 3.0).mean(axis=1), 2.0 * norm.sf(3.0), atol=4e-4)
    assert kstest((g**2).sum(axis=0), chi2(rank).cdf).pvalue > 1e-3


@pytest.mark.parametrize("energy", [0.05, 5.99, 30.0])
@pytest.mark.parametrize("rank", [1, 2, 3])
def test_truncated_numbers_have_the_law_of_a_normal_vector_given_its_energy(rank, energy):
    g = drawn(fill_truncated, energy, rank, rank=rank)
    squares = (g**2).sum(axis=0)
    assert squares.max() <= energy
    kept = chi2.cdf(energy, rank)
    assert kstest(squares, lambda value: chi2.cdf(value, rank) / kept).pvalue > 1e-3
    if rank == 1:
        edge = energy**0.5
        assert kstest(g[0], truncnorm(-edge, edge).cdf).pvalue > 1e-3
    else:
        angles = np.arctan2(g[1], g[0])
        assert kstest(angles / (2.0 * np.pi) + 0.5, "uniform").pvalue > 1e-3


def test_directions_have_length_one_and_point_everywhere():
    h = drawn(fill_directions, 3, rank=3)
    np.testing.assert_allclose((h**2).sum(axis=0), 1.0, rtol=1e-14)
    assert all(kstest(row, "uniform", args=(-1.0, 2.0)).pvalue > 1e-3 for row in h)  # Archimedes


def test_ball_box_and_sphere_fill_their_sets():
    for kind, size in ((BALL, 2), (BALL, 3), (BOX, 2), (SPHERE, 2)):
        h = np.zeros((size, COUNT))
        add_drawn(kind, np.eye(size), 0.0, keys_of(5), 0, h)
        lengths = np.sqrt((h**2).sum(axis=0))
        if kind == BOX:
            assert np.abs(h).max() <= 1.0
            assert all(kstest(row, "uniform", args=(-1.0, 2.0)).pvalue > 1e-3 for row in h)
        elif kind == BALL:
            assert lengths.max() <= 1.0
            assert kstest(lengths**size, "uniform").pvalue > 1e-3
        else:
            np.testing.assert_allclose(lengths, 1.0, rtol=1e-14)


def test_an_environment_draws_the_same_in_any_company():
    few, many = drawn(fill_truncated, 2.0, 3, rank=3, count=5), drawn(fill_truncated, 2.0, 3, rank=3, count=1000)
    np.testing.assert_array_equal(few, many[:, :5])
    assert len(np.unique(many)) == many.size
