"""Marks that make XLA's CPU compiler compile a whole loop as a single kernel.

By default it splits one step of a simulation into many small functions and calls them one by one at every step, which
takes longer than the arithmetic. `single_kernel` makes the whole loop one function. In that function several results
with a common part each recompute it, unless the part is a function of its own: `outline`. (With the options that
`cpjax.configure_cpu` sets, the compiler does both better by itself, and nothing is done here.)

Both set attributes on the call of one `jax.jit` inside another. XLA does not document these attributes: they are set
only for versions of jaxlib and around operations that they were tested with, which excludes calls into other libraries
(a solver, a callback). Only speed depends on them, and the last bits of results.
"""

import functools
import math
import warnings
from collections.abc import Callable
from typing import Any

import jax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxlib.mlir import ir
from jaxlib.mlir.dialects import func

from cpjax.backend import runtime
from cpjax.errors import PerformanceWarning
from cpjax.pytree import hide, reveal

LARGEST = 1 << 14
"""Largest number of elements in a result of a marked call. Above it, XLA divides each operation among the cores."""

LARGEST_SUM = 1 << 12
"""Number of elements from which on XLA hands a reduction to another library, which no marked function may contain."""

_ALLOWED = """
func.func func.call func.return stablehlo.return stablehlo.while stablehlo.case stablehlo.if stablehlo.reduce
stablehlo.abs stablehlo.add stablehlo.and stablehlo.atan2 stablehlo.bitcast_convert stablehlo.broadcast_in_dim
stablehlo.cbrt stablehlo.ceil stablehlo.clamp stablehlo.compare stablehlo.concatenate stablehlo.constant
stablehlo.convert stablehlo.cosine stablehlo.divide stablehlo.dynamic_slice stablehlo.dynamic_update_slice
stablehlo.exponential stablehlo.exponential_minus_one stablehlo.floor stablehlo.iota stablehlo.is_finite
stablehlo.log stablehlo.log_plus_one stablehlo.logistic stablehlo.maximum stablehlo.minimum stablehlo.multiply
stablehlo.negate stablehlo.not stablehlo.or stablehlo.pad stablehlo.popcnt stablehlo.power stablehlo.remainder
stablehlo.reshape stablehlo.reverse stablehlo.round_nearest_afz stablehlo.round_nearest_even stablehlo.rsqrt
stablehlo.select stablehlo.shift_left stablehlo.shift_right_arithmetic stablehlo.shift_right_logical
stablehlo.sign stablehlo.sine stablehlo.slice stablehlo.sqrt stablehlo.subtract stablehlo.tan stablehlo.tanh
stablehlo.transpose stablehlo.xor
"""
"""Operations that the compiler can combine into one function. (Padding inside a loop is excluded: with jaxlib 0.10.2
the sum of padded arrays, by which reverse mode collects the derivatives of a vector's elements, came out wrong there.)
"""


def single_kernel(function: Callable[..., Any], *, stacks: bool = False) -> Callable[..., Any]:
    """Wraps `function` so that it is compiled as one kernel on a CPU: forward, and in each pass of a derivative.

    Call the result under `jax.jit`, with everything that is differentiated among the arguments.

    Args:
      function: a function of pytrees.
      stacks: whether `function` returns a pair whose second part is stacked by a loop and may be large.
    """
    return function if runtime.compiler_fuses_loops() else _called(function, _whole, stacks)


def outline(function: Callable[..., Any]) -> Callable[..., Any]:
    """Wraps `function` so that it stays a function of its own where the compiler would otherwise recompute it."""
    return function if runtime.compiler_fuses_loops() else _called(function, _part, False)


def is_identity(primitive: Any) -> bool:
    """Returns whether an operation is one of this module's marks, which return each argument as it is."""
    return any(primitive in (marks.results, marks.arguments, marks.cotangents) for marks in (_whole, _part))


class _Marks:
    """Three identity primitives. `results` marks the call whose results it receives. `arguments`, applied to a call's
    arguments, becomes `cotangents` in a reverse pass, where the cotangents are results of the call's transpose."""

    def __init__(self, kind: str, mark: Callable[[Any, list[Any]], None]) -> None:
        self.results: Any = Primitive(f"results_of_{kind}")
        self.arguments: Any = Primitive(f"arguments_of_{kind}")
        self.cotangents: Any = Primitive(f"cotangents_of_{kind}")
        _define(self.results, None)  # their cotangents are results of other calls, which are not to be marked
        _define(self.arguments, self.cotangents)
        _define(self.cotangents, self.arguments)

        def lower(context: Any, *values: Any) -> list[Any]:
            if max(aval.size for aval in context.avals_in) <= LARGEST and runtime.jaxlib_is_tested():
                mark(context.module_context.symbol_table, [value.owner for value in values])
            return list(values)

        for primitive in (self.results, self.cotangents):
            mlir.register_lowering(primitive, lower, platform="cpu", cacheable=False)


def _called(function: Callable[..., Any], marks: _Marks, stacks: bool) -> Callable[..., Any]:
    jitted = jax.jit(_revealed(function))

    def called(*args: Any) -> Any:
        results = jitted(*_bind(marks.arguments, hide(args)))
        return (_bind(marks.results, results[0]), results[1]) if stacks else _bind(marks.results, results)

    return called


@functools.lru_cache(maxsize=256)
def _revealed(function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns `function` for arguments wrapped by `hide`, cached so that JAX traces it once."""

    def revealed(*args: Any) -> Any:
        return function(*reveal(args))

    return functools.update_wrapper(revealed, getattr(function, "func", function))


def _bind(primitive: Any, tree: Any) -> Any:
    leaves, structure = jax.tree.flatten(tree)
    return jax.tree.unflatten(structure, primitive.bind(*leaves)) if leaves else tree


def _define(primitive: Any, transpose: Any) -> None:
    def bind_nonzero(primitive: Any, tangents: Any) -> list[Any]:
        values = list(tangents)
        places = [place for place, value in enumerate(values) if type(value) is not ad.Zero]
        if places:
            for place, value in zip(places, primitive.bind(*[values[place] for place in places]), strict=True):
                values[place] = value
        return values

    def jvp(primals: Any, tangents: Any) -> tuple[list[Any], list[Any]]:
        return primitive.bind(*primals), bind_nonzero(primitive, tangents)

    primitive.multiple_results = True
    primitive.def_impl(lambda *values: list(values))
    primitive.def_abstract_eval(lambda *values: list(values))
    batching.primitive_batchers[primitive] = lambda values, axes: (primitive.bind(*values), axes)
    ad.primitive_jvps[primitive] = jvp
    ad.primitive_transposes[primitive] = lambda cotangents, *_: (
        bind_nonzero(transpose, cotangents) if transpose else list(cotangents)
    )
    mlir.register_lowering(primitive, lambda _, *values: list(values))


def _mark_part(_: Any, owners: list[Any]) -> None:
    for owner in owners:
        # Only with several results: XLA fails where it would divide a marked function of one result among cores.
        if getattr(owner, "name", "") == "func.call" and len(owner.results) > 1:
            owner.attributes["mhlo.frontend_attributes"] = _attributes("inlineable")


def _mark_whole(symbols: Any, owners: list[Any]) -> None:
    calls = [owner for owner in owners if getattr(owner, "name", "") == "func.call"]
    for name in {call.attributes["callee"].value for call in calls}:
        function = symbols[name]
        if f"{name}_whole" in symbols:
            continue
        others = _others(function, symbols)
        if not others:
            _move_body(function, f"{name}_whole", symbols)
        elif slow := sorted(others & _SLOW.keys()):
            message = (
                f"this simulation's loop contains {' and '.join(_SLOW[name] for name in slow)}, which keeps XLA from "
                "compiling it as one function on a CPU: expect it to be several times slower. A small product of "
                "matrices can be written as a sum over products of numbers (docs/performance.md)"
            )
            warnings.warn(message, PerformanceWarning, stacklevel=2)


def _move_body(function: Any, name: str, symbols: Any) -> None:
    """Moves the body of the function to a new, marked function, which the old one calls.

    XLA fails on a marked function if it simplifies an argument away. So the new function returns its arguments too, and
    an optimisation barrier hides which of them are constants.
    """
    inner = function.operation.clone(ip=ir.InsertionPoint(function.operation))
    inner.attributes["sym_name"] = ir.StringAttr.get(name)
    for attribute in ("arg_attrs", "res_attrs"):
        if attribute in inner.attributes:
            del inner.attributes[attribute]
    block, outer = (operation.regions[0].blocks[0] for operation in (inner, function.operation))
    end = block.operations[len(block.operations) - 1]
    arguments, results = list(block.arguments), list(end.operands)
    end.operation.erase()
    kinds = [[value.type for value in values] for values in (arguments, [*results, *arguments])]
    inner.attributes["function_type"] = ir.TypeAttr.get(ir.FunctionType.get(*kinds))
    symbols.insert(inner)
    for operation in reversed(list(outer.operations)):
        operation.operation.erase()
    with function.operation.location:
        with ir.InsertionPoint(block):
            func.ReturnOp([*results, *arguments])
        with ir.InsertionPoint(outer):
            given = list(outer.arguments)
            hidden = ir.Operation.create("stablehlo.optimization_barrier", results=kinds[0], operands=given)
            call = func.CallOp(kinds[1], ir.FlatSymbolRefAttr.get(name), list(hidden.results))
            call.attributes["mhlo.frontend_attributes"] = _attributes("inlineable", "xla_cpu_small_call")
            func.ReturnOp(list(call.results)[: len(results)])


def _attributes(*names: str) -> Any:
    values = {"inlineable": "false", "xla_cpu_small_call": "true"}
    attributes: Any = {name: ir.StringAttr.get(values[name]) for name in names}
    return ir.DictAttr.get(attributes)


_SLOW = {
    "stablehlo.dot_general": "a product of matrices",
    "stablehlo.custom_call": "a call into another library (a solver, a callback)",
    "stablehlo.sort": "a sort",
    "stablehlo.reduce": f"a sum over {LARGEST_SUM} numbers or more, those of all initial states together",
}
"""Unsupported operations that a user's law may contain, in words."""


def _others(function: Any, symbols: Any) -> set[str]:
    """Returns the operations in the function, and in those it calls, that are not known to work."""
    names = _ALLOWED.split()
    waiting, known, others = [(function, False)], {(function.attributes["sym_name"].value, False)}, set()

    def look(operation: Any, in_a_loop: bool) -> Any:
        if operation.name == "func.call":
            called = (operation.attributes["callee"].value, in_a_loop or _is_in_a_loop(operation))
            if called not in known:
                known.add(called)
                waiting.append((symbols[called[0]], called[1]))
        large = operation.name == "stablehlo.reduce" and _size(operation.operands[0]) >= LARGEST_SUM
        wrong = operation.name == "stablehlo.pad" and (in_a_loop or _is_in_a_loop(operation))
        if large or wrong or operation.name not in names:
            others.add(operation.name)
        return ir.WalkResult.ADVANCE

    while waiting:
        next_one, in_a_loop = waiting.pop()
        next_one.operation.walk(functools.partial(look, in_a_loop=in_a_loop))
    return others


def _is_in_a_loop(operation: Any) -> bool:
    parent = operation.parent
    while parent is not None:
        if parent.name == "stablehlo.while":
            return True
        parent = parent.parent
    return False


def _size(value: Any) -> int:
    """Returns the number of elements of an array in a program."""
    return math.prod(ir.RankedTensorType(value.type).shape)


_whole, _part = _Marks("one_function", _mark_whole), _Marks("part_of_step", _mark_part)
