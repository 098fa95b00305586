"""Rounding to the steps of an encoder, a converter or a PWM, with a choice of derivative."""

from typing import Literal, TypeAlias

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from cpjax.errors import InputError
from cpjax.pytree import Scalar, Scalars

QuantiserDerivative: TypeAlias = Literal["zero", "straight_through"]


def quantize(value: Scalars, step: Scalar, *, derivative: QuantiserDerivative) -> Float[Array, "*batch"]:
    """Returns the multiple of `step` that is nearest to `value`; of two equally near ones, the even one.

    Args:
      value: in any unit.
      step: above 0, in the unit of `value`.
      derivative: with respect to `value`. "zero" is exact wherever the derivative exists, and gives a tuner no
        information. "straight_through" is 1, the derivative of the mean result if the position of the value between two
        steps can be taken as random. (The derivative with respect to `step` is `result / step` for either.)

    Returns:
      The rounded value, in the unit of `value`.

    Raises:
      InputError: another derivative.
    """
    if derivative not in ("zero", "straight_through"):
        raise InputError("derivative", derivative, "zero or straight_through")
    value, step = jnp.asarray(value), jnp.asarray(step)
    # Rounding has no derivative of use; the one that is asked for is added below.
    result = step * lax.round(lax.stop_gradient(value / step), lax.RoundingMethod.TO_NEAREST_EVEN)
    return result + (value - lax.stop_gradient(value)) if derivative == "straight_through" else result
