import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tables import rows

from cpjax.backend.trigonometry import LARGEST_TURN, rotate_by, sin_cos
from cpjax.numeric.angles import wrap_angle

LARGEST = 1e4  # the angle up to which the accuracy is promised
WIDER = {np.float32: np.float64, np.float64: np.longdouble}
DTYPES = rows("dtype", [np.float32, np.float64])


def angles(dtype):
    """Small and large angles, and those where a range reduction fails first: next to multiples of pi / 4."""
    rng = np.random.default_rng(7)
    spread = rng.uniform(-LARGEST, LARGEST, 400_000)
    small = rng.choice([-1.0, 1.0], 50_000) * 10.0 ** rng.uniform(-30.0, 1.0, 50_000)
    eighths = (np.arange(-12732, 12733) * (math.pi / 4)).astype(dtype)
    beside = [np.nextafter(eighths, dtype(side), dtype=dtype) for side in (-np.inf, np.inf)]
    every = np.concatenate([spread.astype(dtype), small.astype(dtype), eighths, *beside])
    return np.where(np.abs(every) < np.finfo(dtype).tiny, dtype(0), every)  # XLA takes denormal numbers for zero


@DTYPES
@rows("compiled", [False, True])
def test_sine_and_cosine_are_within_two_ulp_of_one_up_to_ten_thousand(dtype, compiled):
    angle = angles(dtype)
    assert np.max(np.abs(angle)) <= LARGEST
    got = (jax.jit(sin_cos) if compiled else sin_cos)(jnp.asarray(angle))
    exact = WIDER[dtype](angle)
    for value, reference in zip(got, (np.sin(exact), np.cos(exact)), strict=True):
        assert value.dtype == dtype
        assert np.max(np.abs(np.asarray(value) - reference)) <= 2 * np.finfo(dtype).eps


@DTYPES
def test_the_sine_of_a_small_angle_keeps_its_relative_accuracy(dtype):
    angle = np.geomspace(1e-30, math.pi / 4, 20_001).astype(dtype)
    sin, _ = sin_cos(jnp.asarray(angle))
    exact = np.sin(WIDER[dtype](angle))
    assert np.max(np.abs((np.asarray(sin) - exact) / exact)) <= 2 * np.finfo(dtype).eps


@DTYPES
def test_multiples_of_a_quarter_turn_are_told_apart(dtype):
    eps = np.finfo(dtype).eps
    turns = np.arange(-8, 9)
    sin, cos = sin_cos(jnp.asarray((turns * (math.pi / 2)).astype(dtype)))
    # A rounded multiple of pi / 2 is off by up to half an ulp of itself, at most 8 eps here.
    np.testing.assert_allclose(sin, np.array([0, 1, 0, -1])[turns % 4], rtol=0, atol=8 * eps)
    np.testing.assert_allclose(cos, np.array([1, 0, -1, 0])[turns % 4], rtol=0, atol=8 * eps)


@DTYPES
def test_at_zero_sine_and_cosine_are_exact(dtype):
    sin, cos = sin_cos(jnp.zeros((), dtype))
    assert (float(sin), float(cos)) == (0.0, 1.0)


@DTYPES
@rows("angle", [math.nan, math.inf, -math.inf])
def test_what_is_no_angle_has_no_sine_or_cosine(dtype, angle):
    for function in (sin_cos, jax.jit(sin_cos)):
        assert all(np.isnan(value) for value in function(jnp.asarray(angle, dtype)))
    assert np.isnan(wrap_angle(jnp.asarray(angle, dtype)))


@DTYPES
def test_forward_and_reverse_derivatives_are_cosine_and_minus_sine_to_the_last_bit(dtype):
    angle = jnp.asarray(angles(dtype)[::50])
    sin, cos = sin_cos(angle)
    _, forward = jax.jvp(sin_cos, (angle,), (jnp.ones_like(angle),))
    np.testing.assert_array_equal(forward[0], cos)
    np.testing.assert_array_equal(forward[1], -sin)
    np.testing.assert_array_equal(jax.vmap(jax.grad(lambda a: sin_cos(a)[0]))(angle), cos)
    np.testing.assert_array_equal(jax.vmap(jax.grad(lambda a: sin_cos(a)[1]))(angle), -sin)


@pytest.mark.slow
@DTYPES
@rows("outer", [jax.jacfwd, jax.jacrev])
@rows("inner", [jax.jacfwd, jax.jacrev])
def test_the_second_derivatives_are_minus_the_functions_to_the_last_bit(dtype, outer, inner):
    angle = jnp.asarray(angles(dtype)[::500])
    sin, cos = sin_cos(angle)
    second = jax.vmap(outer(inner(sin_cos)))(angle)
    np.testing.assert_array_equal(second[0], -sin)
    np.testing.assert_array_equal(second[1], -cos)


def test_a_tangent_passes_through_linearly_and_batches():
    angle, tangent = jnp.asarray([0.3, -2.0, 4.0]), jnp.asarray([2.0, -0.5, 0.0])
    _, pushed = jax.jvp(jax.vmap(sin_cos), (angle,), (tangent,))
    np.testing.assert_allclose(pushed[0], np.cos(angle) * tangent, rtol=1e-15)
    np.testing.assert_allclose(pushed[1], -np.sin(angle) * tangent, rtol=1e-15)


@DTYPES
@rows("compiled", [False, True])
def test_a_turned_sine_and_cosine_are_within_two_ulp_of_one(dtype, compiled):
    rng = np.random.default_rng(5)
    angle = rng.uniform(-math.pi, math.pi, 200_000).astype(dtype)
    turn = (rng.choice([-1.0, 1.0], angle.size) * LARGEST_TURN * rng.uniform(0.0, 1.0, angle.size)).astype(dtype)
    turn[:2] = dtype(LARGEST_TURN), -dtype(LARGEST_TURN)
    wide = WIDER[dtype](angle)
    known = (np.sin(wide).astype(dtype), np.cos(wide).astype(dtype))  # correctly rounded: half an ulp off
    got = (jax.jit(rotate_by) if compiled else rotate_by)(*map(jnp.asarray, known), jnp.asarray(turn))
    exact = wide + WIDER[dtype](turn)
    for value, reference in zip(got, (np.sin(exact), np.cos(exact)), strict=True):
        assert value.dtype == dtype
        assert np.max(np.abs(np.asarray(value) - reference)) <= 2 * np.finfo(dtype).eps


@pytest.mark.slow
@DTYPES
def test_the_derivative_of_a_turn_is_that_of_sine_and_cosine(dtype):
    turn = jnp.linspace(-LARGEST_TURN, LARGEST_TURN, 101, dtype=dtype)
    known = sin_cos(jnp.asarray(1.1, dtype))
    for mode in (jax.jacfwd, jax.jacrev):
        slopes = jax.vmap(mode(lambda by: rotate_by(*known, by)))(turn)
        exact = np.cos(1.1 + np.asarray(turn, float)), -np.sin(1.1 + np.asarray(turn, float))
        for slope, reference in zip(slopes, exact, strict=True):
            # That of the series, which ends a power earlier.
            np.testing.assert_allclose(slope, reference, rtol=0, atol=1e-12 if dtype == np.float64 else 1e-6)


@DTYPES
def test_a_wrapped_angle_is_the_angle_less_whole_turns(dtype):
    angle = angles(dtype)
    wrapped = np.asarray(wrap_angle(jnp.asarray(angle)))
    assert wrapped.dtype == dtype
    turn = 8 * np.arctan(WIDER[dtype](1))
    removed = WIDER[dtype](angle) - wrapped
    whole = np.round(removed / turn)
    assert np.max(np.abs(whole)) > 1500
    # One rounding of the product, one of 2 pi itself: both in proportion to the angle.
    assert np.all(np.abs(removed - whole * turn) <= np.finfo(dtype).eps * np.abs(angle))


@DTYPES
def test_a_wrapped_angle_lies_within_half_a_turn(dtype):
    angle = angles(dtype)
    beyond = np.abs(np.asarray(wrap_angle(jnp.asarray(angle)))) - dtype(math.pi)
    assert np.max(beyond[np.abs(angle) < 3 * math.pi / 2]) <= 0.0
    # Further out the range is kept up to the rounding of the angle itself.
    assert np.all(beyond <= np.finfo(dtype).eps * np.abs(angle))


@DTYPES
def test_an_angle_of_less_than_half_a_turn_is_wrapped_to_itself(dtype):
    angle = np.linspace(-3.14, 3.14, 10_001).astype(dtype)
    np.testing.assert_array_equal(wrap_angle(jnp.asarray(angle)), angle)


@rows(
    ("angle", "wrapped"),
    [
        (0.0, 0.0),
        (math.pi, math.pi),
        (-math.pi, -math.pi),
        (4.0, 4.0 - 2 * math.pi),
        (-4.0, 2 * math.pi - 4.0),
        (2 * math.pi, 0.0),
        (3 * math.pi, -math.pi),
        (20.0, 20.0 - 6 * math.pi),
    ],
)
def test_angles_are_wrapped_to_known_values(angle, wrapped):
    assert float(wrap_angle(angle)) == pytest.approx(wrapped, rel=0, abs=4e-15)


@DTYPES
def test_the_derivative_of_a_wrapped_angle_is_one_everywhere(dtype):
    special = np.arange(-9, 10) * (math.pi / 2)
    angle = jnp.asarray(np.concatenate([special, angles(np.float64)[::500]]).astype(dtype))
    for derivative in (jax.grad, jax.jacfwd, jax.jacrev):
        np.testing.assert_array_equal(jax.vmap(derivative(wrap_angle))(angle), np.ones(angle.shape, dtype))
