"""Parts shared by all tunings of many controllers at once: optimiser steps, evaluation in blocks, derived seeds."""

import operator
from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float

from cpjax.numeric.selection import where

OptimiserState: TypeAlias = Any
"""State of an optax optimiser: a pytree of arrays."""


def step(
    optimiser: optax.GradientTransformation,
    vectors: Float[Array, "vectors parameters"],
    state: OptimiserState,
    slope: Float[Array, "vectors parameters"],
) -> tuple[Float[Array, "vectors parameters"], OptimiserState]:
    """Returns the vectors and the optimiser's state after a step; elements that would not be finite do not move.

    Args:
      optimiser: an optax transformation.
      vectors: free parameters.
      state: the optimiser's state.
      slope: gradients.
    """
    with jax.numpy_dtype_promotion("standard"):  # optax's own arithmetic mixes dtypes
        change, state = optimiser.update(slope, state)
        moved = optax.apply_updates(vectors, change)
    return where(jnp.isfinite(moved), moved, vectors), state


def clip_factors(
    slopes: Float[Array, "starts parameters"], sound: Bool[Array, " starts"], clip: float
) -> Float[Array, " starts"]:
    """Returns factors that scale each gradient down to at most `clip` times the median norm of the sound ones.

    Args:
      slopes: gradients, finite.
      sound: which gradients count for the median.
      clip: largest norm, relative to the median [1].
    """
    norms = jnp.sqrt(jnp.sum(slopes * slopes, axis=1))
    median = jnp.nan_to_num(jnp.nanmedian(where(sound, norms, jnp.nan)))
    tiny = float(np.finfo(norms.dtype).tiny)
    return jnp.minimum(1.0, clip * median / jnp.maximum(norms, tiny))


def in_blocks(function: Callable[..., Any], block: int, *trees: Any) -> Any:
    """Applies a batched function block by block, so that it is compiled for one batch size only.

    Args:
      function: maps trees of arrays (block, ...) to a tree of arrays (block, ...).
      block: batch size; the last block is padded with copies of the last element.
      trees: the arguments, trees of arrays (n, ...).

    Returns:
      The results as NumPy arrays (n, ...).
    """
    count = jax.tree.leaves(trees)[0].shape[0]
    parts = []
    for begin in range(0, count, block):
        members = np.minimum(np.arange(begin, begin + block), count - 1)
        parts.append(jax.tree.map(np.asarray, function(*jax.tree.map(operator.itemgetter(members), trees))))
    return jax.tree.map(lambda *columns: np.concatenate(columns)[:count], *parts)


def derive_seed(seed: int, purpose: int, number: int) -> int:
    """Derives a seed of at least 2**32, so that tuning does not reuse the initial states of an evaluation.

    Args:
      seed: the configuration's seed.
      purpose: what the random numbers are for.
      number: distinguishes seeds of one purpose, such as the step.
    """
    return 2**32 + int(np.random.SeedSequence([seed, purpose, number]).generate_state(1)[0])
