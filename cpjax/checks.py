"""Checks of the values that a user's law, gate, plant, controller or metric returns, made once, while JAX traces it.

Without these checks a wrong shape or a missing argument causes an error of JAX that points to a line of the library.
"""

import inspect
from typing import Any

import jax
import jax.numpy as jnp

from cpjax.errors import InputError


def call(name: str, component: Any, method: str, *arguments: Any) -> Any:
    """Calls a method of a user's component and returns its result; `name` is the component's name in error messages.

    Raises:
      InputError: the method does not accept this number of arguments.
    """
    function = getattr(component, method)
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # no signature, as for some functions in C: Python's own error applies
        return function(*arguments)
    try:
        signature.bind(*arguments)
    except TypeError as problem:
        count = len(arguments)
        allowed = f"a method that can be called with {count} argument{'s' * (count != 1)} ({problem})"
        raise InputError(f"{name}.{method}", f"{method}{signature}", allowed) from problem
    return function(*arguments)


def real(name: str, value: Any, dtype: Any = None) -> jax.Array:
    """Converts a number that a component returned to an array of shape (), of `dtype` if one is given.

    Raises:
      InputError: the value is not a real scalar.
    """
    return _scalar(name, value, "a scalar, a real number of shape ()", jnp.integer, jnp.floating, dtype=dtype)


def integer(name: str, value: Any) -> jax.Array:
    """Converts a mode that a component returned to an int32 array of shape ().

    Raises:
      InputError: the value is not an integer scalar.
    """
    return _scalar(name, value, "a mode, an integer of shape ()", jnp.integer, dtype=jnp.int32)


def _scalar(name: str, value: Any, allowed: str, *kinds: Any, dtype: Any) -> jax.Array:
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError, OverflowError) as problem:
        raise InputError(name, _kind_of(value), allowed) from problem
    if array.shape != () or not any(jnp.issubdtype(array.dtype, kind) for kind in kinds):
        raise InputError(name, f"array of shape {array.shape} and dtype {array.dtype}", allowed)
    return array if dtype is None else array.astype(dtype)


def like(name: str, value: Any, expected: Any) -> Any:
    """Returns a tree that a component returned, after comparing its structure, shapes and dtypes with `expected`.

    Raises:
      InputError: they differ; the first difference is named.
    """
    wanted: Any = jax.tree.structure(expected)
    found = jax.tree.structure(value)
    if wanted != found:
        raise InputError(name, f"a tree {found}", f"of the structure {wanted}")
    leaves = jax.tree_util.tree_leaves_with_path(expected)
    for (path, leaf), other in zip(leaves, jax.tree.leaves(value), strict=True):
        here, there = jax.typeof(jnp.asarray(other)), jax.typeof(jnp.asarray(leaf))
        if (here.shape, here.dtype) != (there.shape, there.dtype):
            where = f"{name}{jax.tree_util.keystr(path)}"
            allowed = f"of shape {there.shape} and dtype {there.dtype}, as before"
            raise InputError(where, f"array of shape {here.shape} and dtype {here.dtype}", allowed)
    return value


def arrays(name: str, value: Any, *, keys: bool = True) -> Any:
    """Returns a tree that a component returned, after checking that JAX takes each of its leaves as an array.

    Args:
      keys: whether leaves may be random keys (`jax.random.key`).

    Raises:
      InputError: a leaf is neither a number nor an array of numbers or random keys; it is named.
    """
    for path, leaf in jax.tree_util.tree_leaves_with_path(value):
        where = f"{name}{jax.tree_util.keystr(path)}"
        try:
            array = jnp.asarray(leaf)
        except (TypeError, ValueError, OverflowError) as problem:
            raise InputError(where, _kind_of(leaf), "a number or an array of numbers") from problem
        if not keys and jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
            raise InputError(where, "a random key", "a number or an array of numbers")
    return value


def pair(name: str, value: Any, what: str) -> tuple[Any, Any]:
    """Returns a pair that a component returned; `what` describes its content in error messages.

    Raises:
      InputError: the value is not a tuple of length 2.
    """
    if not isinstance(value, tuple) or len(value) != 2:
        raise InputError(name, _kind_of(value), f"a pair, {what}")
    return value


def _kind_of(value: Any) -> str:
    return f"a {type(value).__name__}"
