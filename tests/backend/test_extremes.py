import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cpjax.backend.extremes import fast_maximum, fast_minimum

PAIRS = [
    (1.0, 2.0),
    (2.0, 1.0),
    (-3.0, 3.0),
    (1.5, 1.5),
    (0.0, -0.0),
    (math.inf, 1.0),
    (-math.inf, 1.0),
    (1e38, 1e-38),
]
BOTH = [(fast_maximum, jnp.maximum), (fast_minimum, jnp.minimum)]


@pytest.mark.parametrize(("ours", "theirs"), BOTH)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_values_and_derivatives_are_those_of_jax(ours, theirs, dtype):
    a, b = (np.asarray(column, dtype) for column in zip(*PAIRS, strict=True))
    np.testing.assert_array_equal(jax.jit(ours)(a, b), theirs(a, b))
    assert ours(a, b).dtype == dtype
    for mode in (jax.jacfwd, jax.jacrev):
        for argument in (0, 1):
            one, other = (jax.vmap(mode(f, argument))(a, b) for f in (ours, theirs))
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("ours", [fast_maximum, fast_minimum])
def test_the_second_of_the_two_where_one_is_nan(ours):
    assert float(ours(math.nan, 1.0)) == 1.0
    assert math.isnan(ours(1.0, math.nan))


def test_python_numbers_are_welcome_beside_arrays():
    assert float(jax.grad(lambda x: fast_maximum(x, 0.0) ** 3)(2.0)) == 12.0
    assert float(jax.grad(jax.grad(lambda x: fast_minimum(x * x, 9.0)))(2.0)) == 2.0
