"""Status flags of a rollout. Code under `jit` cannot raise, so failures are reported as bits."""

import enum
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from cpjax.numeric.selection import where
from cpjax.pytree import is_number


class Flag(enum.IntFlag):
    """Bits of `Trajectory.flag` and `Metrics.flag`; 0 is a clean run."""

    RUNAWAY = 1
    """The state left, or was about to leave, the bounds of the plant (`limits`). It was held at its last value within
    them."""

    NON_FINITE = 2
    """A parameter was NaN, or the next state NaN or infinite. The state was held at its last finite value."""

    CHATTERING = 4
    """The mode changed at CHATTER_LENGTH control instants in a row or, with located events, as many crossings occurred
    within one step. The run continued; the usual remedy is hysteresis of the gate."""

    OVERFLOW = 8
    """Located switching used up its spare steps, by many crossings or chattering. The state was held from there on."""


STOPPED = int(Flag.RUNAWAY | Flag.NON_FINITE | Flag.OVERFLOW)
"""Flags that freeze the state and make the run a failure."""

CHATTER_LENGTH = 8

NEEDS_RECOMPUTE = 1 << 30
"""Internal bit beside the flags: `sweep` recomputes such a run without the fast path; see `Settings.fast_path`."""


def describe(flag: Int[ArrayLike, ""]) -> str:
    """Returns the flag in words, such as "runaway" or "clean"."""
    names = [bit.name.lower().replace("_", "-") for bit in Flag if int(np.asarray(flag)) & bit and bit.name]
    return ", ".join(names) or "clean"


def nonfinite_flag(tree: Any) -> Int[Array, ""]:
    """Returns NON_FINITE if a number of the tree is NaN, else 0; int32."""
    leaves = jnp.stack([jnp.any(jnp.isnan(leaf)) for leaf in jax.tree.leaves(tree) if is_number(leaf)])
    return where(jnp.any(leaves), int(Flag.NON_FINITE), 0).astype(jnp.int32)


def nonfinite_input(voltage: Float[Array, ""]) -> Int[Array, ""]:
    """Returns the flag of a run whose applied input is not finite, else 0."""
    return where(jnp.isfinite(voltage), np.int32(0), np.int32(Flag.NON_FINITE))
