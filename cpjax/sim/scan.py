"""A scan whose reverse mode remembers little."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from cpjax.sim.settings import Checkpoint


def scan(body: Callable[[Any, Any], Any], carry: Any, xs: jax.Array, checkpoint: Checkpoint) -> Any:
    """`lax.scan(body, carry, xs)`, whose reverse mode computes again what it needs from carries that it kept.

    Args:
      checkpoint: which carries. "every_step": each. "segments": one in about sqrt(n), from which those in between are
        computed once more: memory grows with sqrt(n), and each step is computed three times, not twice.
    """
    body = jax.checkpoint(body, prevent_cse=False)
    if checkpoint == "every_step":
        return lax.scan(body, carry, xs)
    length = math.isqrt(xs.shape[0])
    count = xs.shape[0] // length
    segment = jax.checkpoint(lambda carry, xs: lax.scan(body, carry, xs), prevent_cse=False)
    carry, ys = lax.scan(segment, carry, xs[: count * length].reshape(count, length))
    carry, rest = lax.scan(body, carry, xs[count * length :])
    return carry, jax.tree.map(lambda y, z: jnp.concatenate([y.reshape(-1, *y.shape[2:]), z]), ys, rest)
