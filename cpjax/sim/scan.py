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
      checkpoint: which carries. "segments": one in about sqrt(n), from which those in between are computed once more:
        memory grows with sqrt(n), and each step is computed three times. "every_step": each, so that each step is
        computed twice.
    """
    body = jax.checkpoint(body, prevent_cse=False)
    if checkpoint == "every_step":
        return lax.scan(body, carry, xs)
    length = _segment(xs.shape[0])
    count = xs.shape[0] // length
    segment = jax.checkpoint(lambda carry, xs: lax.scan(body, carry, xs), prevent_cse=False)
    carry, ys = lax.scan(segment, carry, xs[: count * length].reshape(count, length))
    ys = jax.tree.map(lambda y: y.reshape(-1, *y.shape[2:]), ys)
    if count * length == xs.shape[0]:
        return carry, ys
    carry, rest = lax.scan(body, carry, xs[count * length :])
    return carry, jax.tree.map(lambda y, z: jnp.concatenate([y, z]), ys, rest)


def _segment(steps: int) -> int:
    """About sqrt(steps), and a divisor of it if there is one."""
    root = math.isqrt(steps)
    return next((length for length in range(root, root // 2, -1) if steps % length == 0), root)
