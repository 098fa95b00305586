"""Where a function of time crosses zero inside a step, with a derivative.

The crossing is found on the cubic through the values and slopes at both ends (fourth-order accurate), by a fixed number
of operations and without a derivative. The derivative enters with a Newton correction: with g(t, p) the function,

    dt/dp = -(dg/dp) / (dg/dt)

which is what the implicit function theorem says about the time t at which g(t, p) = 0.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from cpjax.pytree import Scalar

_ITERATIONS = 8


def crossing_fraction(start: Scalar, start_slope: Scalar, end: Scalar, end_slope: Scalar) -> jax.Array:
    """Where in [0, 1] the cubic with these end values, and slopes per unit, falls below zero.

    Presumes `end` < 0. `start` counts as positive whatever it is: at rounding's distance from zero it may have either
    sign, and if the cubic is nowhere above zero the result is close to 0. No derivative; works under `jit` and `vmap`.

    Method: Newton's, kept inside a bracket by bisection, from the secant's crossing.
    """
    start, start_slope, end, end_slope = (lax.stop_gradient(x) for x in (start, start_slope, end, end_slope))
    rise = end - start
    third = start_slope + end_slope - 2.0 * rise
    second = rise - start_slope - third
    low, high = jnp.zeros_like(rise), jnp.ones_like(rise)
    above = jnp.maximum(start, 0.0)
    # A start on the boundary is a root, but not the one that is sought if the function rises from there.
    t = jnp.where(above > 0.0, above / jnp.where(above > end, above - end, 1.0), 0.5)
    for _ in range(_ITERATIONS):
        value = start + t * (start_slope + t * (second + t * third))
        slope = start_slope + t * (2.0 * second + t * (3.0 * third))
        low, high = jnp.where(value >= 0.0, t, low), jnp.where(value >= 0.0, high, t)
        newton = t - value / slope
        t = jnp.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
    return t


def newton_correction(value: Scalar, slope: Scalar, steepness: Scalar) -> jax.Array:
    """The step from a time at which a falling function has this `value` to where it is zero: -value / slope.

    Its derivative is -1 / slope, as the implicit function theorem has it; the slope's own derivative is left out, for
    it is multiplied by `value`, which is almost zero. So first derivatives are exact, and only those. (Of
    two corrections, one after the other, second derivatives are exact too.)

    Args:
      slope: dg/dt there [per unit of time]. One that is not clearly negative, as where g only touches zero, is taken
        for -1e-6 `steepness`, so that value and derivative stay finite.
      steepness: a typical |slope| of the function nearby, to tell small from large.
    """
    value = jnp.asarray(value)
    least = 1e-6 * lax.stop_gradient(steepness) + float(np.finfo(value.dtype).tiny) ** 0.25
    return -value / jnp.minimum(lax.stop_gradient(slope), -least)
