"""Linear algebra of many small matrices: the matrix axes come first, any batch axes come last.

Compilers vectorise along the last axis. With a batch there, every line below is a loop over contiguous numbers, which
suits vector units on a CPU as on a GPU, where a call into LAPACK takes microseconds for each 4 x 4 matrix. Without a
batch the functions are plain matrix functions. `batch_last` turns a function of such arrays into one that `vmap` may
batch.

The eliminations and the accurate product are loops of the program and are not unrolled: XLA would fuse the unrolled
steps and recompute each of them wherever a later one reads it.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from cpjax.numeric import double_word as dw
from cpjax.numeric.double_word import DoubleWord
from cpjax.numeric.selection import where

Matrix: TypeAlias = Float[Array, "_ _ ..."]
"""A matrix of any size, with any batch axes."""

M = TypeVar("M", Matrix, DoubleWord)


def transpose(a: M) -> M:
    """Exchanges the matrix axes of a plain or double-word matrix."""
    exchanged: M = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), a)
    return exchanged


def identity_like(a: Float[Array, "n n *batch"]) -> Float[Array, "n n *batch"]:
    """Returns the identity with the size, dtype and batch of a square matrix."""
    n = a.shape[0]
    return jnp.broadcast_to(jnp.eye(n, dtype=a.dtype).reshape((n, n) + (1,) * (a.ndim - 2)), a.shape)


def symmetric(a: Float[Array, "n n *batch"]) -> Float[Array, "n n *batch"]:
    """Returns the symmetric part (a + a') / 2."""
    return 0.5 * (a + transpose(a))


def diagonal(a: Float[Array, "n n *batch"]) -> Float[Array, " n *batch"]:
    """Returns the diagonal."""
    return jnp.stack([a[i, i] for i in range(a.shape[0])])


def largest(a: Float[Array, "_ _ *batch"]) -> Float[Array, "*batch"]:
    """Returns the largest absolute value among a matrix's elements."""
    return jnp.max(jnp.abs(a), axis=(0, 1))


def product(*factors: Matrix) -> Matrix:
    """Multiplies the factors from left to right."""

    def times(a: Matrix, b: Matrix) -> Matrix:
        return functools.reduce(jnp.add, [a[:, i, None] * b[None, i] for i in range(a.shape[1])])

    return functools.reduce(times, factors)


def solve(a: Float[Array, "n n *batch"], b: Float[Array, "n k *batch"]) -> Float[Array, "n k *batch"]:
    """Computes a^-1 b by Gauss-Jordan elimination with partial pivoting; a singular `a` gives infinities or NaN."""
    reduced, _ = _eliminate(jnp.concatenate([a, b], axis=1))
    return reduced[:, a.shape[0] :]


def inverse(a: Float[Array, "n n *batch"]) -> Float[Array, "n n *batch"]:
    """Computes a^-1; see `solve`."""
    return solve(a, identity_like(a))


def log_abs_determinant(a: Float[Array, "n n *batch"]) -> Float[Array, "*batch"]:
    """Computes log |det a|; -inf for a singular matrix."""
    return _eliminate(a)[1]


def is_positive_definite(a: Float[Array, "n n *batch"]) -> Bool[Array, "*batch"]:
    """Returns whether a symmetric matrix is positive definite: its pivots, in order, are all positive."""

    def step(k: jax.Array, carry: tuple[Matrix, jax.Array]) -> tuple[Matrix, jax.Array]:
        rows, positive = carry
        pivot_row = _row(rows, k)
        pivot = _row(pivot_row, k)
        return rows - _column(rows, k)[:, None] * (pivot_row / pivot), positive & (pivot > 0.0)

    return lax.fori_loop(0, a.shape[0], step, (a, jnp.ones(a.shape[2:], dtype=bool)))[1]


def _eliminate(rows: Matrix) -> tuple[Matrix, jax.Array]:
    """Reduces the first n columns of the rows (n, n + k, ...) to the identity; also returns log |det| of them."""
    n = rows.shape[0]
    numbers = jnp.arange(n).reshape((n,) + (1,) * (rows.ndim - 1))

    def step(k: jax.Array, carry: tuple[Matrix, jax.Array]) -> tuple[Matrix, jax.Array]:
        rows, log_determinant = carry
        row_k = _row(rows, k)

        def search(i: jax.Array, found: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            row, index = found
            candidate = _row(rows, i)
            better = jnp.abs(_row(candidate, k)) > jnp.abs(_row(row, k))
            return where(better, candidate, row), where(better, i, index)

        row, index = lax.fori_loop(k + 1, n, search, (row_k, jnp.full(rows.shape[2:], k)))
        pivot = _row(row, k)
        pivot_row = row / pivot
        rows = where(numbers == index, row_k, rows)  # row k replaces the pivot row
        rows = where(numbers == k, pivot_row, rows - _column(rows, k)[:, None] * pivot_row)
        # After a pivot of zero the rows are NaN, but the determinant is known.
        return rows, where(log_determinant == -jnp.inf, -jnp.inf, log_determinant + jnp.log(jnp.abs(pivot)))

    return lax.fori_loop(0, n, step, (rows, jnp.zeros_like(rows[0, 0])))


def _row(a: jax.Array, i: jax.Array) -> jax.Array:
    return lax.dynamic_index_in_dim(a, i, axis=0, keepdims=False)


def _column(a: jax.Array, i: jax.Array) -> jax.Array:
    return lax.dynamic_index_in_dim(a, i, axis=1, keepdims=False)


def accurate_product(a: DoubleWord, b: DoubleWord) -> DoubleWord:
    """Computes a b in double-word arithmetic."""

    def add_term(i: jax.Array, total: DoubleWord) -> DoubleWord:
        column = DoubleWord(*(_column(x, i)[:, None] for x in a))
        row = DoubleWord(*(_row(x, i)[None] for x in b))
        return dw.add(total, dw.multiply(column, row))

    zero = jnp.zeros((a.high.shape[0], *b.high.shape[1:]), dtype=a.high.dtype)
    return lax.fori_loop(0, a.high.shape[1], add_term, DoubleWord(zero, zero))


def accurate_solve(a: DoubleWord, b: DoubleWord) -> DoubleWord:
    """Computes a^-1 b in double-word arithmetic, by Gauss-Jordan elimination with partial pivoting."""
    n = a.high.shape[0]
    rows = DoubleWord(*(jnp.concatenate([x, y], axis=1) for x, y in zip(a, b, strict=True)))
    numbers = jnp.arange(n).reshape((n,) + (1,) * (rows.high.ndim - 1))

    def step(k: jax.Array, rows: DoubleWord) -> DoubleWord:
        row_k = DoubleWord(*(_row(x, k) for x in rows))

        def search(i: jax.Array, found: tuple[DoubleWord, jax.Array]) -> tuple[DoubleWord, jax.Array]:
            row, index = found
            candidate = DoubleWord(*(_row(x, i) for x in rows))
            better = jnp.abs(_row(candidate.high, k)) > jnp.abs(_row(row.high, k))
            row = DoubleWord(*(where(better, x, y) for x, y in zip(candidate, row, strict=True)))
            return row, where(better, i, index)

        row, index = lax.fori_loop(k + 1, n, search, (row_k, jnp.full(rows.high.shape[2:], k)))
        pivot_row = dw.divide(row, DoubleWord(*(_row(x, k) for x in row)))
        rows = DoubleWord(*(where(numbers == index, x, y) for x, y in zip(row_k, rows, strict=True)))
        column = DoubleWord(*(-_column(x, k)[:, None] for x in rows))
        reduced = dw.add(rows, dw.multiply(column, pivot_row))
        return DoubleWord(*(where(numbers == k, x, y) for x, y in zip(pivot_row, reduced, strict=True)))

    rows = lax.fori_loop(0, n, step, rows)
    return DoubleWord(*(x[:, n:] for x in rows))


def batch_last(function: Callable[..., Any]) -> Callable[..., Any]:
    """Wraps a function of arrays with their own axes first, so that `vmap` passes it a batch as the last axis.

    Not differentiable: for use inside a function with a derivative rule of its own.
    """
    batched = jax.custom_batching.custom_vmap(function)

    @batched.def_vmap
    def rule(size: int, in_batched: Sequence[Any], *arguments: Any) -> tuple[Any, Any]:
        def moved(x: jax.Array, mapped: bool) -> jax.Array:
            return jnp.moveaxis(x, 0, -1) if mapped else jnp.broadcast_to(x[..., None], (*x.shape, size))

        outputs = function(*jax.tree.map(moved, tuple(arguments), tuple(in_batched)))
        outputs = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), outputs)
        return outputs, jax.tree.map(lambda _: True, outputs)

    return functools.wraps(function)(batched)


@batch_last
@jax.jit
def _solve(a: Matrix, b: Matrix) -> Matrix:
    return solve(a, b)


def linear_solve(a: Float[Array, "n n"], b: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Computes a^-1 b of plain matrices; differentiable to any order, fast under `vmap`."""
    return lax.custom_linear_solve(
        lambda x: a @ x, b, lambda _, b: _solve(a, b), transpose_solve=lambda _, b: _solve(a.T, b)
    )
