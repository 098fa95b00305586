"""Maps between the unconstrained parameters of an optimiser and the constrained ones of a design."""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from cpjax.errors import InputError
from cpjax.numeric.selection import where
from cpjax.pytree import is_traced


def positive(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Returns exp(x), element by element: a step in x is a relative change of the result, whatever its unit."""
    return jnp.exp(x)


def from_positive(y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Returns the x that `positive` maps to y."""
    return jnp.log(y)


def semidefinite(x: Float[Array, " triangle"]) -> Float[Array, "n n"]:
    """Returns L L', where the n (n + 1) / 2 numbers of x fill the lower triangle L row by row.

    Every symmetric, positive semidefinite matrix has this form, singular ones included. The map is not one to one: a
    column of L may change its sign. At a column of zeros the derivative is zero: an optimiser that starts there stays
    there.

    Raises:
      InputError: the length of x is not n (n + 1) / 2 for any n.
    """
    x = jnp.asarray(x)
    n = int(((8 * x.size + 1) ** 0.5 - 1) / 2)
    if x.ndim != 1 or n == 0 or n * (n + 1) // 2 != x.size:
        raise InputError("x", f"array of shape {x.shape}", "of shape (n (n + 1) / 2,): the rows of a triangle")
    L = jnp.zeros((n, n), dtype=x.dtype).at[jnp.tril_indices(n)].set(x)
    return L @ L.T


def from_semidefinite(Q: Float[Array, "n n"]) -> Float[Array, " triangle"]:
    """Returns an x that `semidefinite` maps to Q: the Cholesky factor, with zeros where a pivot vanishes.

    Raises:
      InputError: a concrete Q that is not symmetric and positive semidefinite. Under jit x is then undefined.
    """
    Q = jnp.asarray(Q)
    n = Q.shape[0]
    if not is_traced(Q):
        numbers = np.asarray(Q, dtype=np.float64)
        room = 16.0 * n * float(np.finfo(Q.dtype).eps) * np.max(np.abs(numbers), initial=0.0)
        if not np.max(np.abs(numbers - numbers.T)) <= room or not np.min(np.linalg.eigvalsh(numbers)) >= -room:
            raise InputError("Q", Q, "symmetric and positive semidefinite")
    # A pivot at rounding level, relative to its diagonal element, counts as zero: otherwise it would be divided by.
    room = float(np.finfo(Q.dtype).eps) * jnp.diagonal(Q)
    rest, columns = Q, []
    for k in range(n):
        pivot = rest[k, k]
        holds = pivot > room[k]
        column = where(holds, rest[:, k] / jnp.sqrt(where(holds, pivot, 1.0)), 0.0)
        # No element of a semidefinite matrix exceeds the geometric mean of its diagonal ones, except by rounding.
        left = lax.stop_gradient(jnp.maximum(jnp.diagonal(rest), 0.0)) ** 0.5
        column = where(jnp.abs(column) > 1.0001 * left, jnp.sign(column) * left, column)
        column = where(jnp.arange(n) >= k, column, 0.0)
        rest = rest - column[:, None] * column[None]
        columns.append(column)
    return jnp.stack(columns, axis=1)[jnp.tril_indices(n)]
