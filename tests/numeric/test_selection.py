"""Selection by a condition: `where` is JAX's own, as one operation."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cpjax.numeric.selection import where

CONDITIONS = [True, np.True_, jnp.asarray(False), jnp.asarray([True, False, True]), np.array([True, False, True])]
VALUES = [
    2,
    -1.5,
    True,
    np.float32(3.0),
    np.float64(0.1),
    np.int32(7),
    jnp.float32(1.25),
    jnp.asarray(0.3),
    jnp.asarray([1.0, 2.0, 3.0]),
    jnp.asarray([1, 2, 3], jnp.int32),
    jnp.asarray([1.0, 2.0, 3.0], jnp.float32),
    jnp.asarray([True, False, False]),
    jnp.asarray([[1.0], [2.0]]),
]


@pytest.mark.parametrize("condition", CONDITIONS, ids=["bool", "numpy bool", "scalar", "vector", "numpy vector"])
def test_values_dtypes_and_errors_are_those_of_jax(condition):
    for x, y in itertools.product(VALUES, VALUES):
        try:
            expected = jnp.where(condition, x, y)
        except Exception as problem:
            with pytest.raises(type(problem)):
                where(condition, x, y)
            continue
        found = where(condition, x, y)
        assert (found.dtype, found.shape, found.weak_type) == (expected.dtype, expected.shape, expected.weak_type)
        np.testing.assert_array_equal(found, expected)


def test_a_selection_is_one_operation_and_has_the_derivatives_of_jax():
    def chosen(select, x, y):
        return select(x > y, x * y, 0.0) + select(x > 1.0, select(y < 0.0, y, x), 2)

    jaxpr = jax.make_jaxpr(lambda x, y: chosen(where, x, y))(1.5, -0.5)
    assert {equation.primitive.name for equation in jaxpr.eqns}.isdisjoint({"pjit", "jit"})
    for x, y in ((1.5, -0.5), (0.5, 0.5), (2.0, 1.0)):
        for derivative in (jax.grad, jax.jacfwd):
            found, expected = (derivative(chosen, argnums=(1, 2))(f, x, y) for f in (where, jnp.where))
            assert found == expected
