"""Angles modulo a turn."""

import math

import jax
import jax.numpy as jnp
from jax import lax

from cpjax.pytree import Scalar


def wrap_angle(angle: Scalar) -> jax.Array:
    """Returns `angle` [rad] minus the nearest whole number of turns, in [-pi, pi] up to about eps |angle|.

    The derivative is 1 everywhere.
    """
    angle = jnp.asarray(angle)
    turns = lax.round(angle * (0.5 / math.pi), lax.RoundingMethod.TO_NEAREST_EVEN)
    return angle - turns * (2.0 * math.pi)  # lax.round has derivative zero
