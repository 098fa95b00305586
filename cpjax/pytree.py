"""Frozen dataclasses registered with JAX as pytrees, with unit and range declared beside each field.

A class decorated with `pytree` is an immutable dataclass whose fields are JAX leaves or hold such classes; a choice,
such as a gate's kind, is a class of its own. Values that a user passes to a constructor are checked against the
declared ranges; values with which JAX rebuilds a tree are not, because JAX fills the leaves with tracers, `None`, axis
numbers and zeros of an optimiser. A rollout checks its arguments once more. The command line's options, the files' keys
and the documentation use the same declarations, so that a parameter is described in one place.
"""

import dataclasses
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np

from cpjax.errors import InputError
from cpjax.fields import (
    RULE,
    Choice,
    Count,
    JaxOrNumpy,
    Matrix,
    Number,
    Scalar,
    Scalars,
    choice,
    count,
    fits,
    is_traced,
    matrix,
    normalise_fields,
    number,
    numbers,
    part,
    present,
    rules,
)

__all__ = [
    "JaxOrNumpy",
    "Matrix",
    "Number",
    "Scalar",
    "Scalars",
    "as_arguments",
    "as_array",
    "cast",
    "check",
    "choice",
    "count",
    "hide",
    "is_component",
    "is_number",
    "is_traced",
    "matrix",
    "number",
    "numbers",
    "part",
    "present",
    "pytree",
    "reveal",
    "rules",
]

T = TypeVar("T")


@dataclass_transform(frozen_default=True, kw_only_default=False, field_specifiers=(number, matrix, part, count, choice))
def pytree(cls: type[T]) -> type[T]:
    """Makes a class a frozen dataclass that is registered with JAX and checked when a user constructs it.

    Fields declared by `count` or `choice` are part of the tree's structure: constants of a compilation, and no leaves.

    Raises (from the constructor):
      InputError: a concrete value outside its declared range, not a number, or of the wrong shape or dtype.
    """
    own_check = getattr(cls, "__post_init__", None)

    def post_init(self: Any) -> None:
        normalise_fields(self, f"{cls.__name__}.")
        if own_check is not None:
            own_check(self)

    made: Any = cls
    made.__post_init__ = post_init
    # Equality stays identity: comparing fields that hold arrays has no single truth value.
    made = dataclasses.dataclass(frozen=True, eq=False)(cls)
    declared = rules(made)
    constant = [name for name, rule in declared.items() if isinstance(rule, (Choice, Count))]
    names = [field.name for field in dataclasses.fields(made) if field.name not in constant]

    def constants(tree: Any) -> tuple[Any, ...]:
        return tuple(getattr(tree, name) for name in constant)

    def flatten_with_keys(tree: Any) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
        return [(jax.tree_util.GetAttrKey(name), getattr(tree, name)) for name in names], constants(tree)

    def flatten(tree: Any) -> tuple[list[Any], tuple[Any, ...]]:
        return [getattr(tree, name) for name in names], constants(tree)

    def unflatten(constants: tuple[Any, ...], leaves: Any) -> T:
        # Bypasses __init__ and with it the checks: JAX's leaves may be anything.
        tree = object.__new__(made)
        for name, value in (*zip(names, leaves, strict=True), *zip(constant, constants, strict=True)):
            object.__setattr__(tree, name, value)
        return tree

    jax.tree_util.register_pytree_with_keys(made, flatten_with_keys, unflatten, flatten)
    fields = dataclasses.fields(made)
    _COMPONENTS[made] = tuple(
        f.name
        for f in fields
        if RULE not in f.metadata and f.type in (Scalar, Scalars, float, "Scalar", "Scalars", "float")
    )
    return made


def check(name: str, tree: Any, batch: int | None = None) -> list[bool]:
    """Refuses a component that no rollout can run, because JAX may have rebuilt it with arbitrary leaves.

    Fields with a declared rule, and those annotated as `Scalar` or `Scalars`, are checked against it. Everything else
    that a user's own component holds (arrays of any shape, trees of them, functions) is accepted as it is.

    Args:
      name: the component's name in error messages.
      tree: a component, or a tree of components and numbers.
      batch: how many components the tree may hold: declared fields may have a leading axis of this length.

    Returns:
      For each number among the leaves, in order, whether it has that axis.

    Raises:
      InputError: a leaf that is neither a number nor a choice (a function, a text), a number or matrix with an extra
        leading axis (which only `vmap` may remove), or a concrete one outside its declared range.
    """
    if is_component(tree):
        return _check_fields(name, tree, batch)
    batched: list[bool] = []
    for path, node in jax.tree_util.tree_leaves_with_path(tree, is_leaf=is_component):
        where = f"{name}{jax.tree_util.keystr(path)}"
        if is_component(node):
            batched += _check_fields(where, node, batch)
        elif is_number(node):
            batched.append(False)
        elif not (path and _is_choice(node)):
            allowed = (
                "a number; a class of your own is made a component by the decorator cpjax.pytree.pytree, or by "
                "registering it with JAX as a pytree"
            )
            raise InputError(where, node, allowed)
    return batched


def is_component(node: Any) -> bool:
    """Returns whether `node` is an instance of a class made by `pytree`."""
    return type(node) in _COMPONENTS


_COMPONENTS: dict[type, tuple[str, ...]] = {}
"""Classes made by `pytree`, with the names of their fields that hold one number each and declare no range."""


def is_number(leaf: Any) -> bool:
    """Returns whether a leaf of a tree is a number or an array of numbers."""
    return isinstance(leaf, (int, float)) or hasattr(leaf, "dtype")


def _is_choice(leaf: Any) -> bool:
    return callable(leaf) or isinstance(leaf, str)


def _check_fields(name: str, tree: Any, batch: int | None) -> list[bool]:
    declared, scalars = rules(type(tree)), _COMPONENTS[type(tree)]
    batched: list[bool] = []
    for field in dataclasses.fields(tree):
        path, value, rule = f"{name}.{field.name}", getattr(tree, field.name), declared.get(field.name)
        if is_component(value):
            batched += _check_fields(path, value, batch)
        elif isinstance(rule, (Choice, Count)) or (isinstance(rule, Matrix) and rule.optional and value is None):
            rule.normalise(path, value)
        elif value is None and isinstance(rule, Number) and rule.optional:
            continue
        elif isinstance(rule, (Number, Matrix)) or (field.name in scalars and is_number(value)):
            expected = rule.shape if isinstance(rule, Matrix) else ()
            shape = () if isinstance(value, float) else np.shape(value)
            alone = fits(shape, expected)
            batched.append(not alone)
            if not alone and (batch is None or not fits(shape, (batch, *expected))):
                more = (
                    "batches go through jax.vmap"
                    if batch is None
                    else f"or {(batch, *expected)}, one for each initial state"
                )
                raise InputError(path, f"array of shape {shape}", f"of shape {expected}; {more}")
            if rule is not None:
                rule.normalise(path, value)
        elif value is not None and not (_is_choice(value) and _is_leaf(value)):
            batched += check(path, value, batch)
    return batched


def _is_leaf(value: Any) -> bool:
    return jax.tree_util.all_leaves([value])


class Hidden:
    """A non-numeric leaf (a function, a text) as a pytree without leaves, so that it is static under `jit`."""

    def __init__(self, value: Any) -> None:
        self.value = value


jax.tree_util.register_pytree_node(Hidden, lambda node: ((), node.value), lambda value, _: Hidden(value))


class KeyData:
    """A typed random key (`jax.random.key`) as its raw integers, which NumPy can hold."""

    def __init__(self, data: Any, kind: str) -> None:
        self.data, self.kind = data, kind


jax.tree_util.register_pytree_node(KeyData, lambda node: ((node.data,), node.kind), lambda kind, d: KeyData(*d, kind))


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def hide(tree: T) -> T:
    """Returns the tree with its non-numeric leaves hidden from JAX (see `Hidden`)."""
    leaves, structure = jax.tree.flatten(tree)
    if all(is_number(leaf) for leaf in leaves):
        return tree
    hidden: T = jax.tree.unflatten(structure, [leaf if is_number(leaf) else Hidden(leaf) for leaf in leaves])
    return hidden


def as_arguments(name: str, tree: T, dtype: Any) -> T:
    """Converts a tree to what JAX can trace: numbers as by `cast`, random keys as integers, other leaves hidden.

    Args:
      name: the component's name in error messages.
      tree: a component, or a tree of components and numbers.
      dtype: floating-point dtype of the real numbers.

    Raises:
      InputError: a non-numeric leaf that cannot be hashed.
    """

    def convert(leaf: Any) -> Any:
        if _is_key(leaf):
            return KeyData(jax.random.key_data(leaf), str(jax.random.key_impl(leaf)))
        if is_number(leaf):
            return _cast(leaf, dtype)
        try:
            hash(leaf)
        except TypeError as problem:
            raise InputError(name, leaf, "a component whose choices can be hashed") from problem
        return Hidden(leaf)

    converted: T = jax.tree.map(convert, tree)
    return converted


def reveal(tree: T) -> T:
    """Restores the leaves and random keys that `hide` or `as_arguments` has wrapped."""

    def show(node: Any) -> Any:
        if isinstance(node, KeyData):
            return jax.random.wrap_key_data(node.data, impl=node.kind)
        return node.value if isinstance(node, Hidden) else node

    revealed: T = jax.tree.map(show, tree, is_leaf=lambda node: isinstance(node, (Hidden, KeyData)))
    return revealed


def cast(tree: T, dtype: Any) -> T:
    """Returns the tree with every real leaf as an array of `dtype`; integers and booleans are unchanged.

    Traced leaves are converted too, with their derivatives.
    """
    converted: T = jax.tree.map(lambda leaf: _cast(leaf, dtype), tree)
    return converted


def _cast(leaf: Any, dtype: Any) -> Any:
    real = isinstance(leaf, float) or jnp.issubdtype(getattr(leaf, "dtype", int), jnp.floating)
    return as_array(leaf, dtype) if real else leaf


def as_array(value: Any, dtype: Any) -> JaxOrNumpy:
    """Converts like `jnp.asarray`, but leaves values from outside JAX in NumPy and returns matching arrays unchanged.

    A rollout is called with dozens of numbers, and this takes a tenth of the time.
    """
    if not isinstance(value, jax.Array):
        return np.asarray(value, dtype=dtype)
    ready = value.dtype == dtype and not value.weak_type
    return value if ready else jnp.asarray(value, dtype=dtype)
