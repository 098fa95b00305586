"""Zero crossing of a function of time inside a step, with a derivative.

The crossing is found on the cubic through the values and slopes at both ends (fourth-order accurate), by a fixed number
of operations and without a derivative. A Newton correction supplies the derivative: for a function g(t, p),

    dt/dp = -(dg/dp) / (dg/dt)

by the implicit function theorem at the time t at which g(t, p) = 0.
"""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from cpjax.numeric.selection import where
from cpjax.pytree import Scalar

_ITERATIONS = 8


def crossing_fraction(start: Scalar, start_slope: Scalar, end: Scalar, end_slope: Scalar) -> Float[Array, ""]:
    """Returns the fraction in [0, 1] at which the cubic with these end values and slopes falls below zero.

    `start` counts as positive whatever its sign, because within rounding of zero it may have either; if the cubic is
    nowhere above zero the result is close to 0. Has no derivative; works under `jit` and `vmap`.

    Method: Newton's method, kept inside a bracket by bisection, from the secant's crossing.

    Args:
      start, start_slope: value and slope (per unit of the fraction) at 0.
      end, end_slope: value, below 0, and slope at 1.

    Returns:
      The fraction [1].
    """
    # Only a guess: `newton_correction` supplies the root's derivative.
    start, start_slope, end, end_slope = (lax.stop_gradient(x) for x in (start, start_slope, end, end_slope))
    rise = end - start
    third = start_slope + end_slope - 2.0 * rise
    second = rise - start_slope - third
    low, high = jnp.zeros_like(rise), jnp.ones_like(rise)
    above = jnp.maximum(start, 0.0)
    # A start value of zero is a root, but not the wanted one if the function rises from there.
    t = where(above > 0.0, above / where(above > end, above - end, 1.0), 0.5)
    for _ in range(_ITERATIONS):
        value = start + t * (start_slope + t * (second + t * third))
        slope = start_slope + t * (2.0 * second + t * (3.0 * third))
        low, high = where(value >= 0.0, t, low), where(value >= 0.0, high, t)
        newton = t - value / slope
        t = where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
    return t


def newton_correction(value: Scalar, slope: Scalar, steepness: Scalar) -> Float[Array, ""]:
    """Returns the Newton step -value / slope from a time at which a falling function has `value` to its zero.

    Its derivative is -1 / slope, by the implicit function theorem; the slope's own derivative is left out, because it
    is multiplied by `value`, which is almost zero. So first derivatives are exact, and only those. (With two
    corrections in succession, second derivatives are exact too.)

    Args:
      value: the function g at that time.
      slope: dg/dt there [unit of `value` per unit of time]. A slope that is not clearly negative, as where g only
        touches zero, is replaced by -1e-6 `steepness`, so that value and derivative stay finite.
      steepness: a typical |slope| of the function nearby, the scale for a small slope.

    Returns:
      The step [unit of time].
    """
    value = jnp.asarray(value)
    # The slope's derivative would be multiplied by a value that is almost zero; the scale changes no result.
    least = 1e-6 * lax.stop_gradient(steepness) + float(np.finfo(value.dtype).tiny) ** 0.25
    return -value / jnp.minimum(lax.stop_gradient(slope), -least)
