"""Against NumPy's linear algebra, and against exact fractions where digits beyond the floats' count."""

import itertools
from fractions import Fraction

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from oracles import jacobian, relative_error

from cpjax.numeric import small_matrices as sm
from cpjax.numeric.double_word import DoubleWord, double_word

DTYPES = pytest.mark.parametrize("dtype", [np.float64, np.float32])


def last(x):
    """The batch axis moved from the front to the back, as the functions want it."""
    return jnp.moveaxis(jnp.asarray(x), 0, -1)


def front(x):
    return np.moveaxis(np.asarray(x), -1, 0)


@jax.jit
def everything(a, b, symmetric):
    return sm.solve(a, b), sm.log_abs_determinant(a), sm.is_positive_definite(symmetric)


@pytest.mark.parametrize(
    ("n", "dtype"),
    [
        *((n, np.float64) for n in (1, 2, 4, 8)),
        (4, np.float32),
        *(pytest.param(n, np.float64, marks=pytest.mark.slow) for n in (3, 5, 6, 11, 16)),
        pytest.param(16, np.float32, marks=pytest.mark.slow),
    ],
)
def test_a_batch_is_solved_and_judged_as_numpy_does(n, dtype):
    rng = np.random.default_rng(5)
    a, b = rng.normal(size=(40, n, n)).astype(dtype), rng.normal(size=(40, n, 3)).astype(dtype)
    symmetric = (a @ np.swapaxes(a, 1, 2) - np.eye(n) * np.linspace(0, 2, 40)[:, None, None] / n).astype(dtype)
    x, log_determinant, positive = everything(last(a), last(b), last(symmetric))
    assert (x.dtype, log_determinant.dtype, positive.dtype) == (dtype, dtype, bool)
    log_determinant = np.asarray(log_determinant, dtype=np.float64)

    wide = a.astype(np.float64)
    condition = np.linalg.cond(wide)
    right = np.linalg.solve(wide, b.astype(np.float64))
    errors = np.linalg.norm(front(x) - right, axis=(1, 2)) / np.linalg.norm(right, axis=(1, 2))
    assert np.max(errors / condition) <= 4 * np.finfo(dtype).eps
    assert np.max(np.abs(log_determinant - np.linalg.slogdet(wide)[1]) / condition) <= 8 * np.finfo(dtype).eps

    smallest = np.linalg.eigvalsh(symmetric.astype(np.float64))[:, 0]
    clear = np.abs(smallest) > 1e-4 * np.max(np.abs(symmetric), axis=(1, 2))
    assert np.array_equal(np.asarray(positive)[clear], smallest[clear] > 0)
    assert np.sum(clear) >= 30
    assert n == 1 or 0 < np.sum(smallest > 0) < 40


def test_a_batch_of_any_axes_or_none_is_many_single_matrices():
    rng = np.random.default_rng(5)
    a, b = jnp.asarray(rng.normal(size=(3, 3, 2, 3))), jnp.asarray(rng.normal(size=(3, 2, 2, 3)))
    x, product, symmetric = sm.solve(a, b), sm.product(a, a, b), sm.symmetric(a)
    log_determinant, largest, diagonal = sm.log_abs_determinant(a), sm.largest(a), sm.diagonal(a)
    single = jax.jit(sm.solve)
    for i, j in itertools.product(range(2), range(3)):
        one, other = np.asarray(a[..., i, j]), np.asarray(b[..., i, j])
        np.testing.assert_allclose(x[..., i, j], single(one, other), rtol=1e-13)
        np.testing.assert_allclose(x[..., i, j], np.linalg.solve(one, other), rtol=1e-11)
        np.testing.assert_allclose(product[..., i, j], one @ one @ other, rtol=1e-12)
        np.testing.assert_array_equal(symmetric[..., i, j], (one + one.T) / 2)
        np.testing.assert_array_equal(sm.transpose(a)[..., i, j], one.T)
        np.testing.assert_array_equal(diagonal[:, i, j], np.diag(one))
        assert float(largest[i, j]) == np.max(np.abs(one))
        assert float(log_determinant[i, j]) == pytest.approx(np.linalg.slogdet(one)[1], rel=1e-12)
        np.testing.assert_array_equal(sm.identity_like(a)[..., i, j], np.eye(3))


def test_the_inverse_of_any_permutation_is_its_transpose():
    permutations = np.stack([np.eye(4)[list(order)] for order in itertools.permutations(range(4))])
    np.testing.assert_array_equal(front(sm.inverse(last(permutations))), np.swapaxes(permutations, 1, 2))
    exact = sm.accurate_solve(double_word(last(permutations)), double_word(sm.identity_like(last(permutations))))
    np.testing.assert_array_equal(front(exact.high), np.swapaxes(permutations, 1, 2))
    assert np.all(np.asarray(exact.low) == 0.0)
    np.testing.assert_array_equal(sm.log_abs_determinant(last(permutations)), np.zeros(24))


def test_a_small_pivot_is_not_divided_by():
    a = np.array([[1e-20, 1.0, 0.0], [1.0, 1e-20, 1.0], [1.0, 1.0, 1e-20]])
    np.testing.assert_allclose(sm.inverse(jnp.asarray(a)), np.linalg.inv(a), rtol=1e-15, atol=1e-15)


SINGULAR = {
    "zero": np.zeros((3, 3)),
    "two equal rows": np.array([[1.0, 2.0, 3.0], [1.0, 2.0, 3.0], [0.0, 1.0, 5.0]]),
    "rank one": np.ones((3, 3)),
    "zero first column": np.array([[0.0, 2.0, 3.0], [0.0, 1.0, 3.0], [0.0, 1.0, 5.0]]),
    "zero in the middle": np.diag([1.0, 0.0, 2.0]),
    "zero at the end": np.diag([1.0, 2.0, 0.0]),
}


def test_singular_matrices_have_no_finite_inverse_and_other_batch_elements_do():
    batch = last(np.stack([2.0 * np.eye(3), *SINGULAR.values(), np.eye(3)]))
    plain = sm.inverse(batch)
    accurate = sm.accurate_solve(double_word(batch), double_word(sm.identity_like(batch))).high
    for inverse in (front(plain), front(accurate)):
        assert not np.any(np.all(np.isfinite(inverse[1:-1]), axis=(1, 2)))
        np.testing.assert_array_equal(inverse[[0, -1]], np.stack([0.5 * np.eye(3), np.eye(3)]))


def test_the_logarithm_of_a_singular_matrixs_determinant_is_minus_infinity():
    found = sm.log_abs_determinant(last(np.stack(list(SINGULAR.values()))))
    assert dict(zip(SINGULAR, found.tolist(), strict=True)) == dict.fromkeys(SINGULAR, -np.inf)


def test_what_has_no_pivots_is_not_positive_definite():
    for a in (
        [[0.0, 1.0], [1.0, 0.0]],
        [[1.0, 1.0], [1.0, 1.0]],
        [[0.0, 0.0], [0.0, 1.0]],
        [[np.nan, 0.0], [0.0, 1.0]],
    ):
        assert not sm.is_positive_definite(jnp.asarray(a))
    assert not sm.is_positive_definite(jnp.asarray([[1.0, 2.0], [2.0, 1.0]]))
    assert sm.is_positive_definite(jnp.asarray([[1.0, 0.999], [0.999, 1.0]]))


def as_fractions(x):
    return np.vectorize(lambda high, low: Fraction(float(high)) + Fraction(float(low)))(x.high, x.low)


@DTYPES
def test_the_accurate_product_is_right_to_a_few_units_of_eps_squared_of_its_terms(dtype):
    rng = np.random.default_rng(5)
    a, b = (
        DoubleWord(jnp.asarray(high), jnp.asarray(high * rng.uniform(-0.2, 0.2, high.shape).astype(dtype) * eps))
        for eps in [np.finfo(dtype).eps]
        for high in (rng.normal(size=(3, 8)).astype(dtype), rng.normal(size=(8, 2)).astype(dtype))
    )
    right, terms = as_fractions(a) @ as_fractions(b), np.abs(as_fractions(a)) @ np.abs(as_fractions(b))
    for function in (sm.accurate_product, jax.jit(sm.accurate_product)):
        errors = np.abs(as_fractions(function(a, b)) - right) / terms
        assert np.max(errors) <= 8 * Fraction(float(np.finfo(dtype).eps)) ** 2


def test_a_system_that_floats_cannot_solve_is_solved_in_double_words():
    n = 10
    hilbert = [[Fraction(1, i + j + 1) for j in range(n)] for i in range(n)]
    high = np.array(hilbert, dtype=np.float64)
    low = np.array(
        [
            [float(x - Fraction(y)) for x, y in zip(*rows, strict=True)]
            for rows in zip(hilbert, high.tolist(), strict=True)
        ]
    )
    a = DoubleWord(jnp.asarray(high), jnp.asarray(low))
    x = sm.accurate_solve(a, double_word(jnp.ones((n, 1))))
    with mpmath.workdps(60):
        right = np.array(mpmath.lu_solve(mpmath.hilbert(n), mpmath.ones(n, 1)).tolist(), dtype=np.float64)
    condition = np.linalg.cond(high)
    assert condition > 1e13
    assert relative_error(x.high, right) <= 1e-15
    assert relative_error(np.linalg.solve(high, np.ones((n, 1))), right) > 1e-6


@sm.batch_last
def shapes_of(a, b):
    """A product, and how many axes the function was given."""
    return sm.product(a, b), jnp.full(a.shape[2:], a.ndim, dtype=jnp.int32)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("axes", [(0, 0), (0, None), (None, 0), (2, 1), (None, -1)])
def test_a_function_of_batch_last_arrays_is_batched_by_vmap_over_any_argument(axes, compiled):
    rng = np.random.default_rng(5)
    a, b = (rng.normal(size=(2, 2)) if axis is None else rng.normal(size=(5, 2, 2)) for axis in axes)
    given = [x if axis is None else np.moveaxis(x, 0, axis) for x, axis in zip((a, b), axes, strict=True)]
    batched = jax.vmap(shapes_of, in_axes=axes)
    product, count = (jax.jit(batched) if compiled else batched)(*map(jnp.asarray, given))
    np.testing.assert_allclose(product, a @ b, rtol=1e-14, atol=1e-14)
    np.testing.assert_array_equal(count, np.full(5, 3))
    assert int(shapes_of(jnp.eye(2), jnp.eye(2))[1]) == 2


def test_nested_vmap_is_two_loops():
    rng = np.random.default_rng(5)
    a, b = rng.normal(size=(3, 2, 2)), rng.normal(size=(4, 2, 1))
    nested = jax.vmap(jax.vmap(shapes_of, in_axes=(None, 0)), in_axes=(0, None))
    product, _ = jax.jit(nested)(jnp.asarray(a), jnp.asarray(b))
    np.testing.assert_allclose(product, a[:, None] @ b[None], rtol=1e-14, atol=1e-14)
    both = jax.vmap(jax.vmap(shapes_of))(jnp.asarray(a[:, None]), jnp.asarray(b[:3, None]))[0]
    np.testing.assert_allclose(both[:, 0], a @ b[:3], rtol=1e-14, atol=1e-14)


def solution(x):
    """Of a (3, 3) and b (3, 2) in one vector."""
    return sm.linear_solve(x[:9].reshape(3, 3), x[9:].reshape(3, 2)).ravel()


def test_derivatives_of_a_solution_agree_with_differences_and_under_vmap():
    rng = np.random.default_rng(5)
    x = rng.normal(size=(4, 15))
    batched = jax.jit(jax.vmap(solution))
    forward, reverse = (jax.jit(jax.vmap(d(solution)))(jnp.asarray(x)) for d in (jax.jacfwd, jax.jacrev))
    for i, solved in enumerate(batched(jnp.asarray(x))):
        a, b = x[i, :9].reshape(3, 3), x[i, 9:].reshape(3, 2)
        assert relative_error(solved, np.linalg.solve(a, b).ravel()) <= 1e-13
        assert relative_error(forward[i], jacobian(batched, x[i], 1e-3, levels=4)) <= 1e-9
        assert relative_error(reverse[i], forward[i]) <= 1e-13
    np.testing.assert_allclose(jax.jit(jax.jacrev(solution))(jnp.asarray(x[0])), reverse[0], rtol=1e-12)


def test_the_second_derivatives_of_a_solution_are_the_differences_of_the_first():
    rng = np.random.default_rng(5)
    x = rng.normal(size=15)

    def scalar(x):
        return jnp.sum(solution(x) ** 2)

    hessian = jax.jit(jax.hessian(scalar))(jnp.asarray(x))
    assert relative_error(hessian, jacobian(jax.jit(jax.vmap(jax.grad(scalar))), x, 1e-3, levels=4)) <= 1e-9
    assert relative_error(hessian, hessian.T) <= 1e-12
