"""What every design function does with its arguments: matrices of one floating dtype, of shapes that fit."""

from collections.abc import Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from cpjax.errors import InputError
from cpjax.pytree import Array, is_traced

MatrixLike: TypeAlias = Array | Sequence[Sequence[float]] | Sequence[float]
"""A matrix as an array or as a nested list; a plain list where one column is meant."""


def matrices(**given: Any) -> list[jax.Array]:
    """The given arrays, nested lists or numbers as JAX arrays of one floating dtype, in order.

    The dtype is the widest among the arrays; lists and whole numbers take it, or JAX's default if there is none.

    Raises:
      InputError: not real numbers, or a concrete one that is not finite.
    """
    allowed = "an array of finite real numbers"
    arrays = {}
    for name, value in given.items():
        if not hasattr(value, "dtype"):
            if any(is_traced(leaf) for leaf in jax.tree.leaves(value)):
                value = jnp.asarray(value)
            else:
                try:
                    value = np.asarray(value)
                except ValueError as problem:  # an uneven nesting
                    raise InputError(name, value, allowed) from problem
                if value.dtype.kind not in "fiu":
                    raise InputError(name, given[name], allowed)
                value = value.astype(np.int64) if value.dtype.kind in "iu" else value.tolist()
        if not jnp.issubdtype(getattr(value, "dtype", float), jnp.number) or jnp.iscomplexobj(value):
            raise InputError(name, value, allowed)
        arrays[name] = value
    dtypes = [jax.dtypes.canonicalize_dtype(a.dtype) for a in arrays.values() if hasattr(a, "dtype")]
    widest = [d for d in dtypes if jnp.issubdtype(d, jnp.floating)]
    dtype = np.result_type(*widest) if widest else jnp.result_type(float)
    if dtype not in (jnp.float32, jnp.float64):
        raise InputError(next(iter(given)), f"array of dtype {dtype}", "of dtype float32 or float64")
    converted = {name: jnp.asarray(value).astype(dtype) for name, value in arrays.items()}
    for name, array in converted.items():
        if not is_traced(array) and not np.all(np.isfinite(array)):
            raise InputError(name, given[name], allowed)
    return list(converted.values())


def square(name: str, matrix: jax.Array) -> int:
    """The size of a square matrix.

    Raises:
      InputError: it is not square, or empty.
    """
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or matrix.shape[0] == 0:
        allowed = "a square matrix of shape (n, n); batches go through jax.vmap"
        raise InputError(name, f"array of shape {matrix.shape}", allowed)
    return matrix.shape[0]


def shaped(name: str, matrix: jax.Array, shape: tuple[int, ...]) -> None:
    """Refuses a matrix of another shape.

    Raises:
      InputError: the shape differs.
    """
    if matrix.shape != shape:
        raise InputError(name, f"array of shape {matrix.shape}", f"of shape {shape}; batches go through jax.vmap")


def column(name: str, matrix: jax.Array, n: int) -> jax.Array:
    """A single input's matrix as (n, 1); a plain vector (n,) is welcome.

    Raises:
      InputError: another shape.
    """
    if matrix.shape == (n,):
        return matrix[:, None]
    if matrix.shape != (n, 1):
        raise InputError(name, f"array of shape {matrix.shape}", f"one input: of shape ({n}, 1) or ({n},)")
    return matrix
