"""Round trips and derivatives of the transforms between unconstrained and constrained numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import jacobian, relative_error

from cpjax.numeric.transforms import from_positive, from_semidefinite, positive, semidefinite

DTYPES = pytest.mark.parametrize("dtype", [np.float64, np.float32])
there_and_back = jax.jit(jax.vmap(lambda Q: semidefinite(from_semidefinite(Q))))


def worst_error(found, right):
    """Elements' errors relative to the geometric mean of the diagonal elements on their lines."""
    size = np.sqrt(np.diagonal(right, axis1=-2, axis2=-1).astype(np.float64))
    size = np.where(size > 0, size, 1.0)
    return np.max(np.abs(np.asarray(found, np.float64) - right) / (size[..., :, None] * size[..., None, :]))


@DTYPES
def test_positive_numbers_of_all_sizes_come_back(dtype):
    y = np.geomspace(1e-30, 1e30, 601).astype(dtype)
    x = from_positive(jnp.asarray(y))
    assert x.dtype == positive(x).dtype == dtype
    # The logarithm is rounded at a size of up to 70.
    np.testing.assert_allclose(positive(x), y, rtol=80 * np.finfo(dtype).eps)
    np.testing.assert_allclose(from_positive(positive(x)), x, rtol=0, atol=80 * np.finfo(dtype).eps)


def test_a_step_of_the_unconstrained_number_is_a_relative_change_of_the_positive_one():
    y = jnp.asarray([1e-6, 1.0, 1e6])
    np.testing.assert_allclose(jax.vmap(jax.grad(positive))(from_positive(y)), y, rtol=1e-14)


@DTYPES
@pytest.mark.parametrize("n", [1, 2, 4])
def test_regular_semidefinite_matrices_come_back_to_a_few_roundings(n, dtype):
    rng = np.random.default_rng(6)
    L = rng.normal(size=(200, n, n)) * 10.0 ** rng.uniform(-3, 3, size=(200, n, 1))
    Q = (L @ np.swapaxes(L, 1, 2)).astype(dtype)
    Q = Q[np.linalg.cond(Q / np.sqrt(np.einsum("bi,bj->bij", *[np.diagonal(Q, axis1=1, axis2=2)] * 2))) < 1e4]
    assert len(Q) > 100
    assert worst_error(there_and_back(jnp.asarray(Q)), Q) <= 8 * np.finfo(dtype).eps


@DTYPES
@pytest.mark.parametrize("rank", [0, 1, 2, 3])
def test_singular_semidefinite_matrices_come_back(rank, dtype):
    rng = np.random.default_rng(6)
    C = rng.normal(size=(300, rank, 4)) * 10.0 ** rng.uniform(-2, 2, size=(300, 1, 4))
    Q = (np.swapaxes(C, 1, 2) @ C).astype(dtype)
    back = there_and_back(jnp.asarray(Q))
    assert back.dtype == dtype
    assert worst_error(back, Q) <= (8 * np.finfo(dtype).eps if rank < 2 else np.finfo(dtype).eps ** 0.5)


def test_weights_that_see_few_states_come_back_exactly():
    for weights in ([200.0, 1.0, 1000.0, 1.0], [0.0, 4.0, 0.0, 9.0], [0.0, 0.0, 0.0, 0.0]):
        Q = np.diag(np.square(weights))
        np.testing.assert_array_equal(there_and_back(jnp.asarray(Q)[None])[0], Q)


def test_any_vector_makes_a_symmetric_semidefinite_matrix_filled_row_by_row():
    rng = np.random.default_rng(6)
    x = jnp.asarray([2.0, 3.0, 4.0])
    np.testing.assert_array_equal(semidefinite(x), [[4.0, 6.0], [6.0, 25.0]])
    for Q in np.asarray(jax.jit(jax.vmap(semidefinite))(jnp.asarray(rng.normal(size=(50, 10))))):
        assert np.array_equal(Q, Q.T)
        assert np.min(np.linalg.eigvalsh(Q)) >= -1e-14 * np.max(Q)
    with pytest.raises(ValueError, match="triangle"):
        semidefinite(jnp.zeros(4))


def flat(Q):
    return from_semidefinite(Q.reshape(3, 3))


@pytest.mark.slow
def test_the_derivatives_agree_forward_in_reverse_and_with_differences():
    rng = np.random.default_rng(6)
    x = rng.normal(size=(4, 6))
    for function, points in ((semidefinite, x), (flat, np.stack([np.ravel(semidefinite(jnp.asarray(v))) for v in x]))):
        forward, reverse = (jax.jit(jax.vmap(d(function)))(jnp.asarray(points)) for d in (jax.jacfwd, jax.jacrev))
        batched = jax.jit(jax.vmap(function))
        for i, point in enumerate(points):
            smallest = 1.0 if function is semidefinite else np.linalg.eigvalsh(point.reshape(3, 3))[0]
            differences = jacobian(batched, point, 0.02 * smallest, levels=4)
            assert relative_error(forward[i], differences) <= 1e-8
            assert relative_error(reverse[i], forward[i]) <= 1e-12


def test_a_transform_and_its_inverse_have_derivative_one_and_none_is_nan():
    x = np.array([1.0, 2.0, 3.0, 0.3, -0.4, 0.5])
    singular = np.stack([x * [1, 1, 1, 1, 1, 0], x * [1, 1, 0, 1, 0, 1], 0 * x])
    whole = jax.jit(jax.vmap(jax.jacfwd(lambda x: from_semidefinite(semidefinite(x)))))(jnp.asarray([x, *singular]))
    np.testing.assert_allclose(whole[0], np.eye(6), atol=1e-12)
    made, pulled = jax.jit(jax.vmap(lambda x: (semidefinite(x), jax.jacrev(semidefinite)(x))))(jnp.asarray(singular))
    assert np.all(np.isfinite(whole))
    assert np.all(np.isfinite(pulled))
    assert np.all(np.isfinite(jax.jit(jax.vmap(jax.jacrev(from_semidefinite)))(made)))
