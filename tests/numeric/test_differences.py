import numpy as np
import pytest

from cpjax.numeric.differences import central_differences

STEPS = 1e-1 * 4.0 ** -np.arange(7)


def both_sides(function):
    return lambda h: (function(h), function(-h))


def test_the_derivatives_of_smooth_functions_are_right_and_so_is_their_uncertainty():
    speeds = np.array([0.1, 1.0, 10.0, 30.0])
    found = central_differences(both_sides(lambda h: np.exp(speeds * h)), STEPS)
    error = np.abs(found.derivative - speeds)
    assert np.all(error <= 1e-11 * speeds)
    assert np.all(error <= 10.0 * found.uncertainty + 1e-12 * speeds)  # an estimate, and rounding is lucky


def test_rounding_is_told_in_the_uncertainty():
    rng = np.random.default_rng(1)
    found = central_differences(both_sides(lambda h: np.sin(1.0 + h) + 1e-9 * rng.normal(size=50)), STEPS)
    error = np.abs(found.derivative - np.cos(1.0))
    assert np.median(error / found.uncertainty) <= 3.0
    assert np.max(error) <= 1e-6


def test_steps_that_do_not_count_are_left_out():
    kink = 0.01
    function = lambda h: np.array([np.sin(h) + 5.0 * max(0.0, h - kink)])  # noqa: E731
    blind = central_differences(both_sides(function), STEPS, lambda h: np.array([True]))
    told = central_differences(both_sides(function), STEPS, lambda h: np.array([h < kink]))
    assert told.derivative[0] == pytest.approx(1.0, abs=1e-10)
    assert np.isfinite(blind.derivative[0])
    none = central_differences(both_sides(function), STEPS, lambda h: np.array([False]))
    assert np.isnan(none.derivative[0])
    assert none.uncertainty[0] == np.inf
