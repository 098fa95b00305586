"""What every tuning of many controllers side by side does: steps, blocks, and starts of its own."""

import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax


def step(optimiser: optax.GradientTransformation, vectors: jax.Array, state: Any, slope: jax.Array) -> Any:
    """Vectors (n, d) and the optimiser's memory after a step; what would become infinite or NaN stays."""
    with jax.numpy_dtype_promotion("standard"):  # optax's own arithmetic mixes dtypes
        change, state = optimiser.update(slope, state)
        moved = optax.apply_updates(vectors, change)
    return jnp.where(jnp.isfinite(moved), moved, vectors), state


def clip_factors(slopes: jax.Array, sound: jax.Array, clip: float) -> jax.Array:
    """Factors (n,) that bring each gradient of (n, d) down to `clip` times the median norm of those that are sound."""
    norms = jnp.sqrt(jnp.sum(slopes * slopes, axis=1))
    median = jnp.nan_to_num(jnp.nanmedian(jnp.where(sound, norms, jnp.nan)))
    tiny = float(np.finfo(norms.dtype).tiny)
    return jnp.minimum(1.0, clip * median / jnp.maximum(norms, tiny))


def in_blocks(function: Any, block: int, *trees: Any) -> Any:
    """`function` of (n, ...) arrays, as NumPy arrays, by blocks of one size, so that it is compiled once."""
    count = jax.tree.leaves(trees)[0].shape[0]
    parts = []
    for begin in range(0, count, block):
        members = np.minimum(np.arange(begin, begin + block), count - 1)
        parts.append(jax.tree.map(np.asarray, function(*jax.tree.map(operator.itemgetter(members), trees))))
    return jax.tree.map(lambda *columns: np.concatenate(columns)[:count], *parts)


def derive_seed(seed: int, purpose: int, number: int) -> int:
    """A seed that no person types in: of starts that no evaluation uses."""
    return 2**32 + int(np.random.SeedSequence([seed, purpose, number]).generate_state(1)[0])
