"""The larger and the smaller of two numbers, in one instruction.

`jnp.maximum` returns NaN if either is NaN, for which processors take three instructions; these ask only what one does.
"""

import jax
import jax.numpy as jnp

from cpjax.pytree import Scalar


@jax.custom_jvp
def fast_maximum(a: Scalar, b: Scalar) -> jax.Array:
    """The larger of the two, b where either is NaN. The derivative is that of `jnp.maximum`: half each where equal."""
    return jnp.where(a > b, a, b)


@jax.custom_jvp
def fast_minimum(a: Scalar, b: Scalar) -> jax.Array:
    """The smaller of the two, b where either is NaN. The derivative is that of `jnp.minimum`: half each where equal."""
    return jnp.where(a < b, a, b)


@fast_maximum.defjvp
def _larger_jvp(primals: tuple[Scalar, Scalar], tangents: tuple[Scalar, Scalar]) -> tuple[jax.Array, jax.Array]:
    _, tangent = jax.jvp(jnp.maximum, primals, tangents)
    return fast_maximum(*primals), tangent


@fast_minimum.defjvp
def _smaller_jvp(primals: tuple[Scalar, Scalar], tangents: tuple[Scalar, Scalar]) -> tuple[jax.Array, jax.Array]:
    _, tangent = jax.jvp(jnp.minimum, primals, tangents)
    return fast_minimum(*primals), tangent
