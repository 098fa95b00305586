import numpy as np
import pytest
from tables import rows

from cpjax.numeric.pareto import hypervolume, nondominated


def beaten(points, i):
    return any(np.all(p <= points[i]) and np.any(p < points[i]) for p in points)


@rows("seed", range(20))
def test_the_front_is_what_no_other_point_beats(seed):
    points = np.random.default_rng(seed).integers(0, 12, (40, 2)).astype(float)
    found = nondominated(points)
    expected = {tuple(points[i]) for i in range(40) if not beaten(points, i)}
    assert {tuple(p) for p in points[found]} == expected
    assert len(found) == len(expected)  # of equal points one
    assert np.all(np.diff(points[found, 0]) > 0.0)


def test_points_that_are_not_finite_and_no_points_have_no_front():
    assert nondominated(np.array([[np.inf, 0.0], [np.nan, 1.0], [2.0, 3.0]])).tolist() == [2]
    assert nondominated(np.zeros((0, 2))).tolist() == []
    assert hypervolume(np.zeros((0, 2)), np.ones(2)) == 0.0


@rows("seed", range(5))
def test_the_hypervolume_is_the_share_of_random_points_that_are_dominated(seed):
    random = np.random.default_rng(seed)
    points = random.uniform(0.0, 1.3, (12, 2))
    darts = random.uniform(size=(200_000, 2))
    hit = np.zeros(len(darts), bool)
    for point in points:
        hit |= np.all(point <= darts, axis=1)
    assert hypervolume(points, np.ones(2)) == pytest.approx(hit.mean(), abs=5e-3)


def test_a_point_beyond_the_reference_adds_nothing():
    assert hypervolume(np.array([[1.0, 2.0], [4.0, 0.5]]), np.array([3.0, 3.0])) == 2.0
