"""Declarations of fields: unit, range, help and sizes of a parameter, in one place beside it.

The constructors of components, a rollout, the command line's options, the files' keys and the documentation use them.
"""

import dataclasses
import functools
import inspect
import math
import warnings
from collections.abc import Callable
from typing import Any, Literal, TypeAlias, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cpjax.errors import InputError

T = TypeVar("T")

RULE = "cpjax"
"""Key of a field's declaration in the metadata of dataclasses."""

JaxOrNumpy: TypeAlias = Array | np.ndarray
"""An array that JAX accepts. Classes hold NumPy arrays until a rollout casts them: no JAX backend starts before."""

Scalar: TypeAlias = Float[JaxOrNumpy, ""] | np.floating | float
"""One real number: a float of Python or NumPy, or an array of shape () that JAX may trace."""

Scalars: TypeAlias = Float[JaxOrNumpy, "*batch"] | np.floating | float
"""One real number, as `Scalar` in a rollout and under `vmap`, or a batch of them, element by element."""

Size: TypeAlias = float | Callable[[Any], Any]
"""A size in the parameter's unit: a number, or a function of the component; for a motor's parameter, of the plant."""


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
      optional: whether the value may be None: the component has no such part, which then costs nothing.
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
    optional: bool = False

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
        if value is None and self.optional:
            return None
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

    None in `shape` stands for any length of at least 1. An `optional` field may be None, its default.
    """

    shape: tuple[int | None, ...]
    unit: str
    help: str
    symmetric: bool = False
    optional: bool = False

    def allowed(self) -> str:
        kind = "symmetric finite" if self.symmetric else "finite"
        shape = str(self.shape).replace("None", "n")
        return f"a {kind} array of shape {shape} [{self.unit}]"

    def normalise(self, name: str, value: Any) -> Any:
        if value is None and self.optional:
            return None
        if isinstance(value, (list, tuple)):
            value = jnp.asarray(value) if _holds_tracers(value) else _from_list(name, value, self.allowed())
        if not hasattr(value, "shape"):
            raise InputError(name, value, self.allowed())
        if self.shape[0] == 1 and len(self.shape) > 1 and fits(value.shape, self.shape[1:]):
            value = value.reshape((1, *value.shape))  # a vector is accepted for a one-row matrix
        if not fits(value.shape[-len(self.shape) :], self.shape):
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
    unit: str = ""

    def normalise(self, name: str, value: Any) -> Any:
        missing = [attribute for attribute in self.needs if not hasattr(value, attribute)]
        if missing:
            raise InputError(name, value, f"{self.help} (with {', '.join(self.needs)})")
        return value


@dataclasses.dataclass(frozen=True)
class Count:
    """Declaration of a field that holds a whole number."""

    help: str
    at_least: int = 0
    at_most: int | float = 10_000_000  # beyond it what is counted would not fit in memory
    unit: str = ""

    def allowed(self) -> str:
        """Returns the range in words."""
        most = f" and at most {self.at_most}" if self.at_most < math.inf else ""
        return f"a whole number, at least {self.at_least}{most}"

    def normalise(self, name: str, value: Any) -> Any:
        if isinstance(value, bool) or not isinstance(value, int) or not self.at_least <= value <= self.at_most:
            raise InputError(name, value, self.allowed())
        return value


@dataclasses.dataclass(frozen=True)
class Choice:
    """Declaration of a field that holds one of several words."""

    help: str
    options: tuple[str, ...]
    unit: str = ""

    def allowed(self) -> str:
        """Returns the words."""
        return "one of " + ", ".join(self.options)

    def normalise(self, name: str, value: Any) -> Any:
        if not isinstance(value, str) or value not in self.options:
            raise InputError(name, value, self.allowed())
        return value


Rule: TypeAlias = Number | Matrix | Part | Count | Choice


def number(unit: str, help: str, *, default: Any = dataclasses.MISSING, **more: Any) -> Any:
    """Declares a real-valued field; `more` are the remaining attributes of `Number`."""
    return dataclasses.field(default=default, metadata={RULE: Number(unit, help, **more)})


def matrix(
    shape: tuple[int | None, ...], unit: str, help: str, *, symmetric: bool = False, default: Any = dataclasses.MISSING
) -> Any:
    """Declares an array-valued field (see `Matrix`); a `default` of None makes it optional."""
    return dataclasses.field(default=default, metadata={RULE: Matrix(shape, unit, help, symmetric, default is None)})


def part(help: str, *needs: str, default: Any = dataclasses.MISSING, default_factory: Any = dataclasses.MISSING) -> Any:
    """Declares a field that holds another component, which must have the attributes `needs` (see `Part`)."""
    rule = {RULE: Part(help, needs)}
    if default_factory is not dataclasses.MISSING:
        return dataclasses.field(default_factory=default_factory, metadata=rule)
    return dataclasses.field(default=default, metadata=rule)


def count(help: str, *, default: int, **more: Any) -> Any:
    """Declares a field that holds a whole number; `more` are the remaining attributes of `Count`."""
    return dataclasses.field(default=default, metadata={RULE: Count(help, **more)})


def choice(help: str, options: tuple[str, ...], *, default: str) -> Any:
    """Declares a field that holds one of the words `options`."""
    return dataclasses.field(default=default, metadata={RULE: Choice(help, options)})


def normalise_fields(component: Any, prefix: str = "") -> None:
    """Checks the declared fields of a frozen dataclass and normalises their values in place.

    Args:
      component: the dataclass's instance, during its construction.
      prefix: of the fields' names in error messages.

    Raises:
      InputError: a value outside its declared range.
    """
    for name, rule in rules(type(component)).items():
        object.__setattr__(component, name, rule.normalise(prefix + name, getattr(component, name)))


@dataclass_transform(frozen_default=True, field_specifiers=(number, count, choice, dataclasses.field))
def config(cls: type[T]) -> type[T]:
    """Makes a class a frozen dataclass whose declared fields are checked; its docstring lists them.

    Raises (from the constructor):
      InputError: a value outside its declared range.
    """
    own_check = getattr(cls, "__post_init__", None)

    def post_init(self: Any) -> None:
        normalise_fields(self)
        if own_check is not None:
            own_check(self)

    made: Any = cls
    made.__post_init__ = post_init
    made = dataclasses.dataclass(frozen=True)(cls)
    lines = [f"  {name}: {r.help}{f' [{r.unit}]' if r.unit else ''}." for name, r in rules(made).items()]
    made.__doc__ = "\n".join([inspect.cleandoc(made.__doc__), "", "Attributes:", *lines])
    checked: type[T] = made
    return checked


def renamed(**names: str) -> Callable[[type[T]], type[T]]:
    """Makes a dataclass accept old names of fields, given as old="new", for one release; it warns.

    The command line's options and the files' keys accept them too.
    """

    def accept(cls: type[T]) -> type[T]:
        make = cls.__init__

        @functools.wraps(make)
        def init(self: Any, *values: Any, **given: Any) -> None:
            for old in names.keys() & given.keys():
                message = f"{cls.__name__}.{old} is now {names[old]}; the old name goes with version 0.3"
                warnings.warn(message, DeprecationWarning, stacklevel=2)
                given[names[old]] = given.pop(old)
            make(self, *values, **given)

        changed: Any = cls
        changed.__init__, changed.RENAMED = init, names
        return cls

    return accept


def rules(cls: type) -> dict[str, Rule]:
    """Returns the declarations of a `pytree` class, by field name, in order; the dictionary must not be changed."""
    return _rules(cls)


def numbers(*classes: type) -> dict[str, Number]:
    """Returns the declared numbers of `pytree` classes, by field name, in order; other classes contribute none."""
    known = [cls for cls in classes if dataclasses.is_dataclass(cls)]
    return {name: rule for cls in known for name, rule in rules(cls).items() if isinstance(rule, Number)}


def present(component: Any) -> dict[str, Number]:
    """Returns the declared numbers that a component has, by field name: without those that are None."""
    return {name: rule for name, rule in numbers(type(component)).items() if getattr(component, name) is not None}


@functools.cache
def _rules(cls: Any) -> dict[str, Rule]:
    return {f.name: f.metadata[RULE] for f in dataclasses.fields(cls) if RULE in f.metadata}


def is_traced(value: Any) -> bool:
    """Returns whether JAX is tracing `value`, so that it has no concrete number to check."""
    return isinstance(value, jax.core.Tracer)


def fits(shape: tuple[int, ...], expected: tuple[int | None, ...]) -> bool:
    """Returns whether a shape matches the expected one, in which None stands for any length."""
    if shape == expected:
        return True
    return len(shape) == len(expected) and all(
        wanted in (None, length) for length, wanted in zip(shape, expected, strict=True)
    )


def _from_list(name: str, value: Any, allowed: str) -> np.ndarray:
    """Converts a nested list of Python numbers to a float array."""
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "fiu":  # rejects text, booleans, complex numbers, uneven nesting
            raise ValueError
        return array.astype(np.float64)
    except (TypeError, ValueError, OverflowError) as problem:
        raise InputError(name, value, allowed) from problem


def _is_symmetric(matrices: np.ndarray) -> bool:
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
