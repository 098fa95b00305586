"""What can go wrong in a rollout. Inside `jit` nothing raises, so it is written down instead."""

import enum
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cpjax.pytree import is_number


class Flag(enum.IntFlag):
    """Bits of `Trajectory.flag` and `Metrics.flag`; 0 is a clean run."""

    RUNAWAY = 1
    """The state left, or was about to leave, the bounds of the plant (`limits`). It was held at its last value
    inside."""

    NON_FINITE = 2
    """A parameter or the next state was NaN or infinite. The state was held at its last finite value."""

    CHATTERING = 4
    """The mode changed at CHATTER_LENGTH control instants in a row, or, located, gate and clip so many times within one
    step. The run went on; a gate wants hysteresis."""

    OVERFLOW = 8
    """Located switching used up its spare steps, by many crossings or by chattering. The state was held there."""


STOPPED = int(Flag.RUNAWAY | Flag.NON_FINITE | Flag.OVERFLOW)
"""Flags after which the state is held, and the run is no success."""

CHATTER_LENGTH = 8

NEEDS_RECOMPUTE = 1 << 30
"""Beside the flags, for `sweep` alone, which then computes the start again: see `Settings.fast_path`."""


def describe(flag: int) -> str:
    """The flag in words, such as "runaway" or "clean"."""
    names = [bit.name.lower().replace("_", "-") for bit in Flag if int(np.asarray(flag)) & bit and bit.name]
    return ", ".join(names) or "clean"


def nonfinite_flag(tree: Any) -> jax.Array:
    """Returns NON_FINITE if a number of the tree is NaN, else 0; int32."""
    leaves = jnp.stack([jnp.any(jnp.isnan(leaf)) for leaf in jax.tree.leaves(tree) if is_number(leaf)])
    return jnp.where(jnp.any(leaves), int(Flag.NON_FINITE), 0).astype(jnp.int32)
