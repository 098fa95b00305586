"""Angles modulo a turn."""

import math

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from cpjax.pytree import Scalars


def wrap_angle(angle: Scalars) -> Float[Array, "*batch"]:
    """Returns an angle minus the nearest whole number of turns.

    The derivative is 1 everywhere.

    Args:
      angle: [rad].

    Returns:
      In [-pi, pi] up to about eps |angle| [rad].
    """
    angle = jnp.asarray(angle)
    turns = lax.round(angle * (0.5 / math.pi), lax.RoundingMethod.TO_NEAREST_EVEN)
    return angle - turns * (2.0 * math.pi)  # lax.round has derivative zero
