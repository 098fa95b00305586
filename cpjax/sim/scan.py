"""Scan with checkpointing, which bounds the memory of reverse mode, and with invariants moved out of the loop."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from cpjax.backend.stacks import apart, together
from cpjax.sim.invariants import hoisted
from cpjax.sim.settings import Checkpoint


def scan(body: Callable[[Any, Any], Any], carry: Any, xs: Int[Array, " steps"], checkpoint: Checkpoint) -> Any:
    """Computes `lax.scan(body, carry, xs)`, whose reverse mode recomputes intermediate values from stored carries.

    Args:
      body: function from the carry and one of `xs` to the new carry and what is stacked.
      carry: the first carry, a pytree of arrays.
      xs: numbers of the steps.
      checkpoint: which carries are stored. "segments": one in about sqrt(n), from which those in between are
        recomputed: memory grows with sqrt(n), and each step is computed three times. "every_step": all of them, so that
        each step is computed twice.
    """
    step = hoisted(body, carry, xs[0])

    def step_of_leaves(leaves: Any, x: Any) -> tuple[Any, Any]:
        after, y = step(together(leaves, carry), x)
        return apart(after), y

    leaves, ys = _scan(jax.checkpoint(step_of_leaves, prevent_cse=False), apart(carry), xs, checkpoint)
    return together(leaves, carry), ys


def _scan(body: Callable[[Any, Any], Any], carry: Any, xs: Int[Array, " steps"], checkpoint: Checkpoint) -> Any:
    """Computes `lax.scan(body, carry, xs)`, in segments whose inner carries are recomputed if `checkpoint` says so."""
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
    """Returns a segment length of about sqrt(steps), a divisor of `steps` if there is one."""
    root = math.isqrt(steps)
    return next((length for length in range(root, root // 2, -1) if steps % length == 0), root)
