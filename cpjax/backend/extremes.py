"""Maximum and minimum of two numbers in one processor instruction.

`jnp.maximum` returns NaN if either number is NaN, which takes three instructions; these functions do not.
"""

import jax
import jax.numpy as jnp

from cpjax.pytree import Scalar


@jax.custom_jvp
def fast_maximum(a: Scalar, b: Scalar) -> jax.Array:
    """Returns max(a, b), or b where either is NaN; the derivative is that of `jnp.maximum`: 1/2 each where equal."""
    return jnp.where(a > b, a, b)


@jax.custom_jvp
def fast_minimum(a: Scalar, b: Scalar) -> jax.Array:
    """Returns min(a, b), or b where either is NaN; the derivative is that of `jnp.minimum`: 1/2 each where equal."""
    return jnp.where(a < b, a, b)


@fast_maximum.defjvp
def _larger_jvp(primals: tuple[Scalar, Scalar], tangents: tuple[Scalar, Scalar]) -> tuple[jax.Array, jax.Array]:
    _, tangent = jax.jvp(jnp.maximum, primals, tangents)
    return fast_maximum(*primals), tangent


@fast_minimum.defjvp
def _smaller_jvp(primals: tuple[Scalar, Scalar], tangents: tuple[Scalar, Scalar]) -> tuple[jax.Array, jax.Array]:
    _, tangent = jax.jvp(jnp.minimum, primals, tangents)
    return fast_minimum(*primals), tangent
