"""Moves out of a loop what is the same in each of its steps, before JAX differentiates and compiles it.

A step of a simulation computes much from parameters alone: inertias, the motor's damping, a gate's edges. XLA moves
that out of a loop by itself, but only after JAX has differentiated the step, these expressions included: at every step
a derivative then follows the chain rule down to each parameter. Moved out before, the loop adds up derivatives in a few
intermediate numbers, and the chain rule follows once. What JAX differentiates and the compiler sees is smaller, too.
"""

from collections.abc import Callable, Hashable, Sequence
from itertools import islice
from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun

from cpjax.backend.single_kernel import is_identity

_Values: TypeAlias = list[Any]
_Memory: TypeAlias = dict[Hashable, tuple[Any, _Values]]
"""Results of operations that have been computed, with their arguments, whose identities are part of the key."""


def hoisted(function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """Returns an equal function; what of it does not depend on its arguments is computed here, once.

    Args:
      function: of pytrees of arrays; it may use arrays of its environment.
      arguments: of the form of those that it will be called with.
    """
    closed, form = jax.make_jaxpr(function, return_shape=True)(*arguments)
    split = _Split(closed.jaxpr, (False,) * len(closed.jaxpr.invars), {})
    early = split.early_values(closed.consts, [], {})
    structure = jax.tree.structure(form)

    def rest(*arguments: Any) -> Any:
        return jax.tree.unflatten(structure, split.late_values(early, jax.tree.leaves(arguments)))

    return rest


class _Split:
    """The operations of a function that JAX has traced: early ones, of known values alone, and late ones."""

    def __init__(self, jaxpr: Jaxpr, known: Sequence[bool], functions: "_Functions") -> None:
        self._jaxpr, self._results = jaxpr, jaxpr.outvars
        self._known = [*jaxpr.constvars, *_where(known, jaxpr.invars)]
        self._unknown = _where(_not(known), jaxpr.invars)
        self._early: list[JaxprEqn] = []
        self._late: list[JaxprEqn] = []
        self._calls: dict[int, _Call] = {}
        """Calls with early operations among the late ones, by place."""
        available = set(self._known)
        used: list[Var] = []
        for equation in jaxpr.eqns:
            variables = [atom for atom in equation.invars if isinstance(atom, Var)]
            given = [isinstance(atom, Var) and atom in available for atom in equation.invars]
            if sum(given) == len(variables) > 0 and not equation.effects:
                self._early.append(equation)
                available.update(equation.outvars)
            elif any(given) and is_identity(equation.primitive):
                for here, operations in ((given, self._early), (_not(given), self._late)):
                    ends = _where(here, equation.invars), _where(here, equation.outvars)
                    operations.append(equation.replace(invars=ends[0], outvars=ends[1]))
                available.update(_where(given, equation.outvars))
            else:
                call = _call(equation, given, functions) if any(given) else None
                if call:
                    self._calls[len(self._late)] = call
                else:
                    used += variables
                self._late.append(equation)
        used += [atom for atom in self._results if isinstance(atom, Var)]
        self._needed = [variable for variable in dict.fromkeys(used) if variable in available]

    @property
    def size(self) -> int:
        """Number of early values that the late operations need."""
        return len(self._needed) + sum(call.split.size for call in self._calls.values())

    @property
    def is_trivial(self) -> bool:
        """Returns whether there are no early operations."""
        return not self._early and not self._calls

    def early_values(self, constants: Sequence[Any], known: Sequence[Any], memory: _Memory) -> _Values:
        """Computes the early operations; returns what the late ones need of them, that of calls last."""
        values = dict(zip(self._known, (*constants, *known), strict=True))
        for equation in self._early:
            arguments = [_value(atom, values) for atom in equation.invars]
            is_mark = is_identity(equation.primitive)
            results = arguments if is_mark else _computed_once(self._jaxpr, equation, arguments, memory)
            values.update(zip(equation.outvars, results, strict=True))
        found = [values[variable] for variable in self._needed]
        for place, call in self._calls.items():
            given = [values[atom] for atom in _where(call.given, self._late[place].invars)]
            found += call.split.early_values(call.constants, given, memory)
        return found

    def late_values(self, early: Sequence[Any], unknown: Sequence[Any]) -> _Values:
        """Computes the function's results from what `early_values` returned."""
        rest = iter(early)
        given = islice(rest, len(self._needed))
        values = dict(zip((*self._needed, *self._unknown), (*given, *unknown), strict=True))
        memory: _Memory = {}
        for place, equation in enumerate(self._late):
            if call := self._calls.get(place):
                others = _where(_not(call.given), equation.invars)
                results = call.late(list(islice(rest, call.split.size)), [_array(atom, values) for atom in others])
            else:
                arguments = [_value(atom, values) for atom in equation.invars]
                results = _computed_once(self._jaxpr, equation, arguments, memory)
            values.update(zip(equation.outvars, results, strict=True))
        return [_value(atom, values) for atom in self._results]


class _Call(NamedTuple):
    """A call of a compiled function with some known arguments."""

    given: Sequence[bool]
    """Which arguments are known."""
    constants: Sequence[Any]
    split: _Split
    late: Callable[[_Values, _Values], _Values]
    """`split.late_values`, a compiled function of its own: all equal calls share it."""


_Functions: TypeAlias = dict[Hashable, _Call]


def _call(equation: JaxprEqn, given: Sequence[bool], functions: _Functions) -> _Call | None:
    """Returns the operation as a call, or None if it is none, or has no early operations."""
    if equation.primitive.name not in ("jit", "pjit") or equation.effects:
        return None
    closed = equation.params["jaxpr"]
    key = (id(closed), tuple(given))
    if key not in functions:
        split = _Split(closed.jaxpr, given, functions)

        def late(early: _Values, unknown: _Values) -> _Values:
            return split.late_values(early, unknown)

        late.__name__ = equation.params["name"]
        functions[key] = _Call(given, closed.consts, split, jax.jit(late))
    call = functions[key]
    return None if call.split.is_trivial else call


def _where(chosen: Sequence[bool], items: Sequence[Any]) -> list[Any]:
    return [item for item, is_chosen in zip(items, chosen, strict=True) if is_chosen]


def _not(chosen: Sequence[bool]) -> list[bool]:
    return [not is_chosen for is_chosen in chosen]


def _value(atom: Any, values: dict[Any, Any]) -> Any:
    return atom.val if isinstance(atom, Literal) else values[atom]


def _array(atom: Any, values: dict[Any, Any]) -> Any:
    aval: Any = atom.aval
    return np.asarray(atom.val, aval.dtype) if isinstance(atom, Literal) else values[atom]


def _computed(jaxpr: Jaxpr, equation: JaxprEqn, arguments: _Values) -> _Values:
    """Returns the results of an operation of this function."""
    values = {v: value for v, value in zip(equation.invars, arguments, strict=True) if isinstance(v, Var)}
    words = jaxpr.debug_info._replace(arg_names=None, result_paths=None)
    alone = Jaxpr((), list(values), equation.outvars, [equation], equation.effects, words)
    return list(jaxpr_as_fun(ClosedJaxpr(alone, ()))(*values.values()))


def _computed_once(jaxpr: Jaxpr, equation: JaxprEqn, arguments: _Values, memory: _Memory) -> _Values:
    """Returns what `_computed` does; of equal operations on the same values the first result."""
    atoms = zip(equation.invars, arguments, strict=True)
    # By their bits: equal numbers may differ (0.0 and -0.0), and different ones may print alike.
    same = [(np.asarray(a.val).tobytes(), str(a.aval)) if isinstance(a, Literal) else id(v) for a, v in atoms]
    if equation.effects:
        return _computed(jaxpr, equation, arguments)
    key = (equation.primitive, tuple(sorted(equation.params.items(), key=lambda item: item[0])), tuple(same))
    try:
        hash(key)
    except TypeError:  # a parameter without a hash
        return _computed(jaxpr, equation, arguments)
    if key not in memory:
        memory[key] = (arguments, _computed(jaxpr, equation, arguments))
    return memory[key][1]
