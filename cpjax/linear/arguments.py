"""Argument conversion and checks shared by the design functions: one floating dtype, compatible shapes."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Real

from cpjax.errors import InputError
from cpjax.pytree import is_traced

if TYPE_CHECKING:
    MatrixLike: TypeAlias = ArrayLike | Sequence[Sequence[float]] | Sequence[float]
else:
    MatrixLike = ArrayLike  # a list has no shape that a type could state
"""An array, a nested list or a number, as in `Real[MatrixLike, "n n"]`; checkers at run time know no lists."""


def matrices(**given: Real[MatrixLike, "..."]) -> list[Float[Array, "..."]]:
    """Converts the given arrays, nested lists or numbers to JAX arrays of one floating dtype, in order.

    The dtype is the widest among the floating-point arrays; lists and whole numbers take it, or JAX's default if there
    is none.

    Raises:
      InputError: values that are not real, a concrete one that is not finite, or a dtype beside float32 and float64.
    """
    allowed = "an array of finite real numbers"
    arrays, dtypes = {}, []
    value: Any
    for name, value in given.items():
        array: Any
        if any(is_traced(leaf) for leaf in jax.tree.leaves(value)):
            array = jnp.asarray(value)
        elif hasattr(value, "dtype"):
            array = value
        else:
            try:
                array = np.asarray(value)
            except ValueError as problem:  # uneven nesting
                raise InputError(name, value, allowed) from problem
        kind = array.dtype
        if not jnp.issubdtype(kind, jnp.number) or jnp.issubdtype(kind, jnp.complexfloating):
            raise InputError(name, value, allowed)
        if hasattr(value, "dtype") and jnp.issubdtype(kind, jnp.floating):
            dtypes.append(jax.dtypes.canonicalize_dtype(kind))
        # Converts whole numbers of any size before they could overflow JAX's integer types.
        whole = not is_traced(array) and jnp.issubdtype(kind, jnp.integer)
        arrays[name] = np.asarray(array, dtype=np.float64) if whole else array
    dtype = np.result_type(*dtypes) if dtypes else jnp.result_type(float)
    if dtype not in (jnp.float32, jnp.float64):
        raise InputError(next(iter(given)), f"array of dtype {dtype}", "of dtype float32 or float64")
    converted = {name: jnp.asarray(array).astype(dtype) for name, array in arrays.items()}
    for name, array in converted.items():
        if not is_traced(array) and not np.all(np.isfinite(array)):
            raise InputError(name, given[name], allowed)
    return list(converted.values())


def square(name: str, matrix: Float[Array, "..."]) -> int:
    """Returns the size n of a square matrix.

    Raises:
      InputError: the matrix is not square, or is empty.
    """
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or matrix.shape[0] == 0:
        allowed = "a square matrix of shape (n, n); batches go through jax.vmap"
        raise InputError(name, f"array of shape {matrix.shape}", allowed)
    return matrix.shape[0]


def shaped(name: str, matrix: Float[Array, "..."], shape: tuple[int, ...]) -> None:
    """Refuses a matrix of another shape.

    Raises:
      InputError: the shape differs.
    """
    if matrix.shape != shape:
        raise InputError(name, f"array of shape {matrix.shape}", f"of shape {shape}; batches go through jax.vmap")


def columns(name: str, matrix: Float[Array, "..."], n: int) -> Float[Array, "{n} m"]:
    """Returns the input matrix, m at least 1; a plain vector (n,) is taken as that of one input.

    Raises:
      InputError: another shape.
    """
    if matrix.shape == (n,):
        return matrix[:, None]
    if matrix.ndim != 2 or matrix.shape[0] != n or matrix.shape[1] == 0:
        raise InputError(name, f"array of shape {matrix.shape}", f"of shape ({n}, m); batches go through jax.vmap")
    return matrix


def rows(name: str, matrix: Float[Array, "..."], n: int) -> Float[Array, "p {n}"]:
    """Returns the output matrix, or a gain, p at least 1; a plain vector (n,) is taken as one row.

    Raises:
      InputError: another shape.
    """
    if matrix.shape == (n,):
        return matrix[None, :]
    if matrix.ndim != 2 or matrix.shape[1] != n or matrix.shape[0] == 0:
        raise InputError(name, f"array of shape {matrix.shape}", f"of shape (p, {n}); batches go through jax.vmap")
    return matrix


def gain_matrix(name: str, matrix: Float[Array, "..."], m: int, n: int) -> Float[Array, "{m} {n}"]:
    """Returns the gain of m inputs; a plain vector (n,) is taken as that of one input.

    Raises:
      InputError: another shape.
    """
    matrix = matrix[None, :] if m == 1 and matrix.shape == (n,) else matrix
    shaped(name, matrix, (m, n))
    return matrix


def input_weight(name: str, matrix: Float[Array, "..."], m: int) -> Float[Array, "{m} {m}"]:
    """Returns the weight of m inputs; a number is taken as that of one input.

    Raises:
      InputError: another shape.
    """
    matrix = matrix.reshape(1, 1) if matrix.shape == () else matrix
    shaped(name, matrix, (m, m))
    return matrix


def column(name: str, matrix: Float[Array, "..."], n: int) -> Float[Array, "{n} 1"]:
    """Returns the input matrix of a single input; a plain vector (n,) is accepted.

    Raises:
      InputError: another shape.
    """
    if matrix.shape == (n,):
        return matrix[:, None]
    if matrix.shape != (n, 1):
        raise InputError(name, f"array of shape {matrix.shape}", f"one input: of shape ({n}, 1) or ({n},)")
    return matrix
