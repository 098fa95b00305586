import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cpjax.numeric.roots import crossing_fraction, newton_correction


def ends(coefficients):
    """Values and slopes at 0 and 1 of a polynomial, lowest power first."""
    p = np.polynomial.Polynomial(coefficients)
    return p(0.0), p.deriv()(0.0), p(1.0), p.deriv()(1.0)


def random_cubics(count, seed):
    rng = np.random.default_rng(seed)
    found = []
    while len(found) < count:
        coefficients = rng.normal(size=4)
        if ends(coefficients)[0] > 0 > ends(coefficients)[2]:
            found.append(coefficients)
    return np.array(found)


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-14), (np.float32, 2e-6)])
def test_a_cubic_is_zero_at_its_crossing(dtype, tolerance):
    cubics = random_cubics(2000, seed=1)
    values = np.array([ends(c) for c in cubics]).T.astype(dtype)
    t = np.asarray(jax.vmap(crossing_fraction)(*map(jnp.asarray, values)))
    assert t.dtype == dtype
    assert np.all((t >= 0) & (t <= 1))
    residuals = np.array([np.polynomial.Polynomial(c)(at) for c, at in zip(cubics, t.astype(np.float64), strict=True)])
    assert np.max(np.abs(residuals)) <= tolerance * np.max(np.abs(cubics))


@pytest.mark.parametrize(
    ("start", "start_slope", "end", "end_slope", "where"),
    [
        (0.0, -1.0, -1.0, -1.0, 0.0),  # begins on the boundary and leaves at once
        (-1e-18, -1.0, -1.0, -1.0, 0.0),
        (1e-18, -1.0, -1.0, -1.0, 0.0),
        (0.0, 3.0, -1.0, -5.0, 0.75),  # begins on the boundary, goes in and comes back: 3 t - 4 t^2
        (1e-18, 3.0, -1.0, -5.0, 0.75),
        (-1e-18, 3.0, -1.0, -5.0, 0.75),
        (1.0, -1.0, -1e-18, -1.0, 1.0),  # ends on the boundary
        (1.0, 0.0, -1.0, 0.0, 0.5),
    ],
)
def test_at_the_ends_of_the_step_it_is_the_crossing_that_counts(start, start_slope, end, end_slope, where):
    t = float(crossing_fraction(*(jnp.asarray(x) for x in (start, start_slope, end, end_slope))))
    assert t == pytest.approx(where, abs=1e-12)


def test_the_located_fraction_has_no_derivative_and_none_that_is_nan():
    for values in ((0.0, 0.0, 0.0, 0.0), (1.0, -1.0, -1.0, -3.0), (0.0, 0.0, -1.0, 0.0)):
        gradient = jax.grad(crossing_fraction, argnums=(0, 1, 2, 3))(*values)
        assert gradient == (0.0, 0.0, 0.0, 0.0)


def test_one_newton_correction_has_the_derivative_of_the_implicit_function_theorem():
    def time(p):  # where p - t^2 is zero, from a time that is known and has no derivative
        known = jax.lax.stop_gradient(jnp.sqrt(p))
        return known + newton_correction(p - known * known, -2.0 * known, 1.0)

    assert float(jax.grad(time)(2.0)) == pytest.approx(0.5 / 2.0**0.5, rel=1e-15)


@pytest.mark.parametrize("slope", [0.0, 1.0, -1e-300])
def test_where_a_function_only_touches_zero_value_and_derivative_stay_finite(slope):
    value, derivative = jax.value_and_grad(lambda v: newton_correction(v, slope, 1.0))(1e-9)
    assert np.isfinite(value)
    assert np.isfinite(derivative)
    assert abs(float(derivative)) <= 1.001e6
