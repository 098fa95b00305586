"""Unconstrained numbers, which an optimiser may move anywhere, and the constrained ones that a design wants."""

import jax
import jax.numpy as jnp
import numpy as np


def positive(x: jax.Array) -> jax.Array:
    """exp(x), element by element: a step in x is a relative change of the positive number, whatever its unit."""
    return jnp.exp(x)


def from_positive(y: jax.Array) -> jax.Array:
    """The x of which `positive` makes y."""
    return jnp.log(y)


def semidefinite(x: jax.Array) -> jax.Array:
    """L L' (n, n) with the lower triangle L filled with x (n (n + 1) / 2,), row by row: any symmetric, positive
    semidefinite matrix, singular ones included. Not one to one: a column of L may change its sign.
    """
    n = _triangle(x.shape[0])
    L = jnp.zeros((n, n), dtype=x.dtype).at[jnp.tril_indices(n)].set(x)
    return L @ L.T


def from_semidefinite(Q: jax.Array) -> jax.Array:
    """An x of which `semidefinite` makes Q: the Cholesky factor, with a column of zeros where its pivot vanishes."""
    n = Q.shape[0]
    # A pivot that is only rounding would be divided by; relative to its diagonal element it counts as zero.
    room = 8.0 * n * np.finfo(Q.dtype).eps * jnp.diagonal(Q)
    rest, columns = Q, []
    for k in range(n):
        pivot = rest[k, k]
        holds = pivot > room[k]
        column = jnp.where(holds, rest[:, k] / jnp.sqrt(jnp.where(holds, pivot, 1.0)), 0.0)
        column = jnp.where(jnp.arange(n) >= k, column, 0.0)
        rest = rest - column[:, None] * column[None]
        columns.append(column)
    return jnp.stack(columns, axis=1)[jnp.tril_indices(n)]


def _triangle(size: int) -> int:
    n = int(((8 * size + 1) ** 0.5 - 1) / 2)
    if n * (n + 1) // 2 != size:
        raise ValueError(f"{size} numbers fill no triangle")
    return n
