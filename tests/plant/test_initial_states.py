import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tables import rows

from cpjax import HANGING, State, sample_starts
from cpjax.plant.initial_states import START_SETS
from cpjax.plant.state import NAMES

COUNT = 20_000
RANGES = {
    "hanging": {
        "x": (-0.1, 0.1),
        "x_dot": (0.0, 0.0),
        "theta": (math.pi - 0.3, math.pi + 0.3),
        "theta_dot": (-0.3, 0.3),
    },
    "wide": {
        "x": (-0.15, 0.15),
        "x_dot": (0.0, 0.0),
        "theta": (math.pi - 0.4, math.pi + 0.4),
        "theta_dot": (-0.4, 0.4),
    },
    "anywhere": {"x": (-0.3, 0.3), "x_dot": (-0.5, 0.5), "theta": (-math.pi, math.pi), "theta_dot": (-4.0, 4.0)},
    "rest": {"x": (0.0, 0.0), "x_dot": (0.0, 0.0), "theta": (math.pi, math.pi), "theta_dot": (0.0, 0.0)},
}
every_set = rows("name", RANGES)


def matrix(starts):
    return np.stack([getattr(starts, name) for name in NAMES], axis=-1)


def test_the_sets_are_those_of_the_protocol():
    assert set(START_SETS) == set(RANGES)


@every_set
def test_every_component_fills_its_range_evenly_and_never_leaves_it(name):
    starts = sample_starts(name, COUNT, seed=3)
    for component, (low, high) in RANGES[name].items():
        values = getattr(starts, component)
        assert values.min() >= low
        assert values.max() <= high
        if low == high:
            continue
        counts, _ = np.histogram(values, bins=10, range=(low, high))
        # 1 / 10 of the starts in each tenth, within five standard deviations of the count
        assert np.all(np.abs(counts - COUNT / 10) < 5 * math.sqrt(COUNT * 0.1 * 0.9))


@every_set
def test_components_that_vary_are_uncorrelated(name):
    columns = matrix(sample_starts(name, COUNT, seed=4)).T
    varying = [column for column in columns if np.ptp(column)]
    if len(varying) > 1:
        correlation = np.corrcoef(varying) - np.eye(len(varying))
        assert np.abs(correlation).max() < 5 / math.sqrt(COUNT)


@every_set
@rows("count", [1, 7])
def test_the_starts_are_a_state_of_float64_arrays_of_that_length(name, count):
    starts = sample_starts(name, count, seed=1)
    assert type(starts) is State
    assert {(type(leaf), leaf.dtype, leaf.shape) for leaf in jax.tree.leaves(starts)} == {
        (np.ndarray, np.dtype("float64"), (count,))
    }


@every_set
def test_one_seed_always_gives_the_same_starts(name):
    a, b = (matrix(sample_starts(name, 100, seed=5)) for _ in range(2))
    np.testing.assert_array_equal(a, b)


@rows("name", ["hanging", "wide", "anywhere"])
def test_two_seeds_give_different_starts_throughout(name):
    a, b = (matrix(sample_starts(name, 100, seed=seed)) for seed in (5, 6))
    assert not np.any((a == b)[:, np.ptp(a, axis=0) > 0])


@every_set
def test_a_larger_count_begins_with_the_same_starts(name):
    few, many = (matrix(sample_starts(name, count, seed=7)) for count in (10, 4096))
    np.testing.assert_array_equal(few, many[:10])


def test_global_random_state_and_jaxs_settings_change_nothing():
    expected = matrix(sample_starts("anywhere", 5, seed=1))
    np.random.seed(0)
    with jax.enable_x64(False):
        got = matrix(sample_starts("anywhere", 5, seed=1))
    np.testing.assert_array_equal(got, expected)
    assert got.dtype == np.float64


def test_a_seed_keeps_its_starts_from_release_to_release():
    # The figures in the README are over seed 1; another stream would be another experiment.
    unit = np.random.Generator(np.random.PCG64(1)).uniform(-1.0, 1.0, size=(3, 4))
    starts = sample_starts("hanging", 3, seed=1)
    np.testing.assert_array_equal(starts.x, 0.1 * unit[:, 0])
    np.testing.assert_array_equal(starts.theta, math.pi + 0.3 * unit[:, 2])
    np.testing.assert_array_equal(starts.theta_dot, 0.3 * unit[:, 3])
    assert starts.x[0] == pytest.approx(0.0023643249400513433, rel=0, abs=0)


@every_set
@rows("dtype", [np.float32, jnp.float32, "float32"], ids=str)
def test_float32_starts_are_the_float64_ones_rounded(name, dtype):
    wide, narrow = sample_starts(name, 50, seed=1), sample_starts(name, 50, seed=1, dtype=dtype)
    for component in NAMES:
        column = getattr(narrow, component)
        assert column.dtype == np.float32
        np.testing.assert_array_equal(column, getattr(wide, component).astype(np.float32))


def test_rest_is_exactly_hanging_at_rest():
    starts = matrix(sample_starts("rest", 3, seed=9))
    np.testing.assert_array_equal(starts, np.tile([getattr(HANGING, name) for name in NAMES], (3, 1)))
