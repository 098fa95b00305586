"""Rounding to the steps of an encoder, a converter or a PWM, with a derivative by name."""

from typing import Literal, TypeAlias

import jax
import jax.numpy as jnp
from jax import lax

from cpjax.errors import InputError
from cpjax.pytree import Scalar

QuantiserDerivative: TypeAlias = Literal["zero", "straight_through"]


def quantize(value: Scalar, step: Scalar, *, derivative: QuantiserDerivative) -> jax.Array:
    """Returns the multiple of `step` that is nearest to `value`; of two that are as near, the even one.

    Args:
      step: above 0, in the unit of `value`.
      derivative: in `value`. "zero" is the true one wherever it exists, and tells a tuner nothing. "straight_through"
        is 1: the derivative of the mean of the result, if where the value lies between two steps is as good as random.
        (The derivative in `step` is that of the result, `result / step`, for either.)

    Raises:
      InputError: another derivative.
    """
    if derivative not in ("zero", "straight_through"):
        raise InputError("derivative", derivative, "zero or straight_through")
    value, step = jnp.asarray(value), jnp.asarray(step)
    result = step * lax.round(lax.stop_gradient(value / step), lax.RoundingMethod.TO_NEAREST_EVEN)
    return result + (value - lax.stop_gradient(value)) if derivative == "straight_through" else result
