"""Frozen dataclasses registered with JAX as pytrees, with unit and range declared beside each field.

A class decorated with `pytree` is an immutable dataclass whose fields are JAX leaves or hold such classes; a choice,
such as a gate's kind, is a class of its own. Values that a user passes to a constructor are checked against the
declared ranges; values with which JAX rebuilds a tree are not, because JAX fills the leaves with tracers, `None`, axis
numbers and zeros of an optimiser. A rollout checks its arguments once more. The command line's options, the files' keys
and the documentation use the same declarations, so that a parameter is described in one place.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, Literal, TypeAlias, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np

from cpjax.errors import InputError

Array: TypeAlias = jax.Array | np.ndarray[Any, Any]
"""An array that JAX accepts. Classes hold NumPy arrays until a rollout casts them: no JAX backend starts before."""

Scalar: TypeAlias = Array | float
"""One real number: a Python float, or an array of shape () that JAX may trace. Batches appear only under `vmap`."""

Size: TypeAlias = float | Callable[[Any], Any]
"""A size in the parameter's unit: a number, or a function of the component; for a motor's parameter, of the plant."""

T = TypeVar("T")
_RULE = "cpjax"  # key of a field's declaration in dataclasses' metadata


@dataclasses.dataclass(frozen=True)
class Number:
    """Declaration of a real-valued field, with everything that other modules need about the parameter.

    Attributes:
      unit: SI unit, as text.
      help: description in one line.
      above, at_least, below, at_most: open (`above`, `below`) or closed ends of the range.
      infinite: whether an infinity is allowed.
      typical: size at which the parameter matters; used as its scale where its value is zero, because a share of zero
        is zero. 1 in the parameter's unit if not declared.
      linear: whether the linear model about upright may depend on it; audits of printed gains vary such parameters.
      uncertain: whether its value is uncertain on a real rig: `sample_plants` draws it at random, and audits of
        gradients vary it.
      drawn: where the value of an uncertain one is zero, its spread is a share of this; `typical` if not declared.
      change: where its value is zero, the change that audits of gradients take as its scale; `typical` if not declared.
      neutral: value at which the plant moves as if it had no such parameter. A bridge that cannot express the
        parameter refuses any other value.
    """

    unit: str
    help: str
    above: float = -math.inf
    at_least: float = -math.inf
    below: float = math.inf
    at_most: float = math.inf
    infinite: bool = False
    typical: Size | None = None
    linear: bool = True
    uncertain: bool = False
    drawn: Size | None = None
    change: Size | None = None
    neutral: float = 0.0

    def size(self, owner: Any, use: Literal["typical", "drawn", "change"] = "typical") -> float:
        """Returns the scale of the parameter where its value is zero, in the parameter's unit.

        Args:
          owner: argument of a `Size` that is a function: the component, or the plant for a motor's parameter.
          use: the declared size; without one of its own it is `typical`.
        """
        own = getattr(self, use)
        size = self.typical if own is None else own
        return 1.0 if size is None else float(size(owner) if callable(size) else size)

    @property
    def scales(self) -> bool:
        """Whether the range contains all positive numbers, so that a value may be multiplied by any positive factor."""
        return max(self.above, self.at_least) <= 0.0 and min(self.below, self.at_most) == math.inf

    def allowed(self) -> str:
        """Returns the range in words, as error messages and `--help` print it."""
        ends = [
            f"above {self.above:g}" if self.above > -math.inf else "",
            f"at least {self.at_least:g}" if self.at_least > -math.inf else "",
            f"below {self.below:g}" if self.below < math.inf else "",
            f"at most {self.at_most:g}" if self.at_most < math.inf else "",
        ]
        kind = "a number" if self.infinite else "a finite number"
        return " ".join([kind, " and ".join(e for e in ends if e), f"[{self.unit}]"]).replace("  ", " ")

    def normalise(self, name: str, value: Any) -> Any:
        if isinstance(value, np.generic):
            value = value.item()
        if isinstance(value, int) and not isinstance(value, bool):
            try:
                value = float(value)
            except OverflowError as problem:
                raise InputError(name, value, self.allowed()) from problem
        if isinstance(value, float):  # a rollout checks dozens of floats per call: faster without NumPy
            good = self._holds(value)
        else:
            numbers = _concrete_reals(name, value, self)
            good = numbers is None or (numbers.size > 0 and bool(np.all(self._holds(numbers))))
        if not good:
            raise InputError(name, value, self.allowed())
        return value

    def _holds(self, v: Any) -> Any:
        """Returns whether a float, or each number of an array, is in the range."""
        real = v == v if self.infinite else abs(v) < math.inf
        # A closed end such as pi stays allowed after rounding to float32.
        low, high = self.at_least - 1e-6 * abs(self.at_least), self.at_most + 1e-6 * abs(self.at_most)
        inside = ((v > self.above) | (self.above == -math.inf)) & ((v < self.below) | (self.below == math.inf))
        return real & inside & (v >= low) & (v <= high)


@dataclasses.dataclass(frozen=True)
class Matrix:
    """Declaration of an array-valued field: its last axes have `shape`; axes before them are a batch.

    None in `shape` stands for any length of at least 1.
    """

    shape: tuple[int | None, ...]
    unit: str
    help: str
    symmetric: bool = False

    def allowed(self) -> str:
        kind = "symmetric finite" if self.symmetric else "finite"
        shape = str(self.shape).replace("None", "n")
        return f"a {kind} array of shape {shape} [{self.unit}]"

    def normalise(self, name: str, value: Any) -> Any:
        if isinstance(value, (list, tuple)):
            value = jnp.asarray(value) if _holds_tracers(value) else _from_list(name, value, self.allowed())
        if not hasattr(value, "shape"):
            raise InputError(name, value, self.allowed())
        if self.shape[0] == 1 and len(self.shape) > 1 and _fits(value.shape, self.shape[1:]):
            value = value.reshape((1, *value.shape))  # a vector is accepted for a one-row matrix
        if not _fits(value.shape[-len(self.shape) :], self.shape):
            raise InputError(name, f"array of shape {value.shape}", self.allowed())
        numbers = _concrete_reals(name, value, self)
        if numbers is None:
            return value
        finite = numbers.size > 0 and bool(np.all(np.isfinite(numbers)))
        if not finite or (self.symmetric and not _is_symmetric(numbers)):
            raise InputError(name, value, self.allowed())
        return value


@dataclasses.dataclass(frozen=True)
class Part:
    """Declaration of a field that holds another component, which must have all methods and attributes in `needs`."""

    help: str
    needs: tuple[str, ...]

    def normalise(self, name: str, value: Any) -> Any:
        missing = [attribute for attribute in self.needs if not hasattr(value, attribute)]
        if missing:
            raise InputError(name, value, f"{self.help} (with {', '.join(self.needs)})")
        return value


Rule: TypeAlias = Number | Matrix | Part


def number(unit: str, help: str, *, default: Any = dataclasses.MISSING, **more: Any) -> Any:
    """Declares a real-valued field; `more` are the remaining attributes of `Number`."""
    return dataclasses.field(default=default, metadata={_RULE: Number(unit, help, **more)})


def matrix(shape: tuple[int | None, ...], unit: str, help: str, *, symmetric: bool = False) -> Any:
    """Declares an array-valued field (see `Matrix`)."""
    return dataclasses.field(metadata={_RULE: Matrix(shape, unit, help, symmetric)})


def part(help: str, *needs: str, default: Any = dataclasses.MISSING, default_factory: Any = dataclasses.MISSING) -> Any:
    """Declares a field that holds another component, which must have the attributes `needs` (see `Part`)."""
    rule = {_RULE: Part(help, needs)}
    if default_factory is not dataclasses.MISSING:
        return dataclasses.field(default_factory=default_factory, metadata=rule)
    return dataclasses.field(default=default, metadata=rule)


def rules(cls: type) -> dict[str, Rule]:
    """Returns the declarations of a `pytree` class, by field name, in order; the dictionary must not be changed."""
    return _rules(cls)


def numbers(*classes: type) -> dict[str, Number]:
    """Returns the declared numbers of `pytree` classes, by field name, in order; other classes contribute none."""
    known = [cls for cls in classes if dataclasses.is_dataclass(cls)]
    return {name: rule for cls in known for name, rule in rules(cls).items() if isinstance(rule, Number)}


@functools.cache
def _rules(cls: Any) -> dict[str, Rule]:
    return {f.name: f.metadata[_RULE] for f in dataclasses.fields(cls) if _RULE in f.metadata}


@dataclass_transform(frozen_default=True, kw_only_default=False, field_specifiers=(number, matrix, part))
def pytree(cls: type[T]) -> type[T]:
    """Makes a class a frozen dataclass that is registered with JAX and checked when a user constructs it.

    Raises (from the constructor):
      InputError: a concrete value outside its declared range, not a number, or of the wrong shape or dtype.
    """
    own_check = getattr(cls, "__post_init__", None)

    def post_init(self: Any) -> None:
        for name, rule in rules(cls).items():
            object.__setattr__(self, name, rule.normalise(f"{cls.__name__}.{name}", getattr(self, name)))
        if own_check is not None:
            own_check(self)

    cls.__post_init__ = post_init  # type: ignore[attr-defined]  # mypy does not see attributes added to a class
    # Equality stays identity: comparing fields that hold arrays has no single truth value.
    made: Any = dataclasses.dataclass(frozen=True, eq=False)(cls)
    names = [field.name for field in dataclasses.fields(made)]

    def flatten_with_keys(tree: Any) -> tuple[list[tuple[Any, Any]], None]:
        return [(jax.tree_util.GetAttrKey(name), getattr(tree, name)) for name in names], None

    def flatten(tree: Any) -> tuple[list[Any], None]:
        return [getattr(tree, name) for name in names], None

    def unflatten(_: None, leaves: Any) -> T:
        # Bypasses __init__ and with it the checks: JAX's leaves may be anything.
        tree = object.__new__(made)
        for name, value in zip(names, leaves, strict=True):
            object.__setattr__(tree, name, value)
        return tree

    jax.tree_util.register_pytree_with_keys(made, flatten_with_keys, unflatten, flatten)
    fields = dataclasses.fields(made)
    _COMPONENTS[made] = tuple(
        f.name for f in fields if _RULE not in f.metadata and f.type in (Scalar, float, "Scalar", "float")
    )
    return made


def is_traced(value: Any) -> bool:
    """Returns whether JAX is tracing `value`, so that it has no concrete number to check."""
    return isinstance(value, jax.core.Tracer)


def check(name: str, tree: Any, batch: int | None = None) -> list[bool]:
    """Refuses a component that no rollout can run, because JAX may have rebuilt it with arbitrary leaves.

    Fields with a declared rule, and those annotated as `Scalar`, are checked against it. Everything else that a user's
    own component holds (arrays of any shape, trees of them, functions) is accepted as it is.

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
        elif isinstance(rule, (Number, Matrix)) or (field.name in scalars and is_number(value)):
            expected = rule.shape if isinstance(rule, Matrix) else ()
            shape = () if isinstance(value, float) else np.shape(value)
            fits = _fits(shape, expected)
            batched.append(not fits)
            if not fits and (batch is None or not _fits(shape, (batch, *expected))):
                more = (
                    "batches go through jax.vmap" if batch is None else f"or {(batch, *expected)}, one for each start"
                )
                raise InputError(path, f"array of shape {shape}", f"of shape {expected}; {more}")
            if rule is not None:
                rule.normalise(path, value)
        elif value is not None and not (_is_choice(value) and _is_leaf(value)):
            batched += check(path, value, batch)
    return batched


def _is_leaf(value: Any) -> bool:
    return jax.tree_util.all_leaves([value])


def _fits(shape: tuple[int, ...], expected: tuple[int | None, ...]) -> bool:
    """Returns whether a shape matches the expected one, in which None stands for any length."""
    if shape == expected:
        return True
    return len(shape) == len(expected) and all(
        wanted in (None, length) for length, wanted in zip(shape, expected, strict=True)
    )


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


def as_array(value: Any, dtype: Any) -> Array:
    """Converts like `jnp.asarray`, but leaves values from outside JAX in NumPy and returns matching arrays unchanged.

    A rollout is called with dozens of numbers, and this takes a tenth of the time.
    """
    if not isinstance(value, jax.Array):
        return np.asarray(value, dtype=dtype)
    ready = value.dtype == dtype and not value.weak_type
    return value if ready else jnp.asarray(value, dtype=dtype)


def _from_list(name: str, value: Any, allowed: str) -> np.ndarray[Any, Any]:
    """Converts a nested list of Python numbers to a float array."""
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "fiu":  # rejects text, booleans, complex numbers, uneven nesting
            raise ValueError
        return array.astype(np.float64)
    except (TypeError, ValueError, OverflowError) as problem:
        raise InputError(name, value, allowed) from problem


def _is_symmetric(matrices: np.ndarray[Any, Any]) -> bool:
    difference = np.abs(matrices - np.swapaxes(matrices, -1, -2))
    return bool(np.max(difference) <= 1e-6 * np.max(np.abs(matrices)))


def _holds_tracers(value: Any) -> bool:
    return any(is_traced(leaf) for leaf in jax.tree.leaves(value))


def _concrete_reals(name: str, value: Any, rule: Number | Matrix) -> np.ndarray | None:
    """Returns `value` as a float array, or None where it is traced and has no concrete numbers."""
    if is_traced(value):
        return None
    dtype = getattr(value, "dtype", None)
    if dtype is None or not jnp.issubdtype(dtype, jnp.floating):
        kind = f" of dtype {dtype}" if dtype is not None else ""
        raise InputError(name, f"{value}{kind}" if kind else value, f"{rule.allowed()}, of a floating-point dtype")
    return np.asarray(value, dtype=np.float64)
