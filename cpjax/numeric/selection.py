"""Selection between two values by a condition, as one operation."""

from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Num

from cpjax.pytree import JaxOrNumpy, Scalar

_Value: TypeAlias = bool | int | Scalar | np.number[Any] | np.bool | Num[JaxOrNumpy, "..."] | Bool[JaxOrNumpy, "..."]


def where(
    condition: bool | np.bool | Bool[JaxOrNumpy, "..."], x: _Value, y: _Value
) -> Num[Array, "..."] | Bool[Array, "..."]:
    """Returns `x` where the condition holds, else `y`; results and errors are those of `jnp.where`.

    Every `jnp.where` is a function of its own to JAX, which differentiates and lowers it as such. A rollout has
    hundreds of them, and is traced faster without them.

    Args:
      condition: of bool, any shape.
      x, y: numbers, or arrays that broadcast with it.
    """
    one, other = _like(x, y), _like(y, x)
    chosen = isinstance(condition, jax.Array) and condition.dtype == jnp.bool_ and condition.shape in ((), one.shape)
    if not chosen or one.dtype != other.dtype or one.shape != other.shape:
        return jnp.where(condition, x, y)
    return lax.select(condition, one, other)


def _like(value: _Value, other: _Value) -> Array:
    """Returns a value as an array: a number in the form of the other one, if JAX would give it that dtype as well."""
    # By type: NumPy's float64 is a float to Python, but has a dtype of its own.
    if type(value) not in (int, float) or type(other) in (int, float):
        return jnp.asarray(value)
    form = jnp.asarray(other)
    floats, whole = (jnp.issubdtype(form.dtype, kind) for kind in (jnp.floating, jnp.signedinteger))
    return lax.full_like(form, value) if floats or (whole and isinstance(value, int)) else jnp.asarray(value)
