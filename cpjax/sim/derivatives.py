"""Derivatives on the sampled clock, where a change of mode falls on a control instant.

Such an instant does not move with a parameter, so plain automatic differentiation omits the effect of a change of
mode. The mean over initial states still depends on it: the crossing's phase within the control period is practically
random, so that a crossing delayed by dt* delays the change of mode by one whole period T in a fraction dt*/T of all
runs. In the mean, the first command of the new mode is thus replaced, to first order, by that of the old mode in the
fraction

    d(dt*)/T,    dt*/dp = -(dg/dp) / (dg/dt)    where g, the margin of the old mode, crosses zero.

This is smoothed perturbation analysis (Gong and Ho, 1987) of the hybrid loop. The crossing is located at the zero of
the straight line through the margins at the two neighbouring control instants, so both values and derivatives are those
at the crossing, to first order in T.

A command held over a period acts on average at the period's middle, half a period after the change of mode that it
represents. So 3/2 of the difference is assigned to the period of the change and -1/2 to the next one; their weighted
mean is the instant of the change. This makes the error of the mean second order in T.

For any controller, also with estimator, delay or memory, the command of the old mode is computed by running the
controller a second time with its mode held. The parts with a mode are found inside any controller and replaced by one
that also tracks its margin (`Tracked`) and by one that holds its mode (`Holding`).

There are three limitations. The plant must be affine in its input, as any plant with a motor is. A metric receives the
difference between two voltages, but a function of a saved trajectory's voltage receives the slope there. And a command
that a controller stores in its memory to return it later, as a dead time does, is replaced to first order only: a
metric that is not linear in the voltage, such as the effort, then uses the slope of its integrand instead of the
difference.
"""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from cpjax.checks import arrays, call, integer, real
from cpjax.controllers.hybrid import Hybrid
from cpjax.controllers.protocol import (
    Controller,
    ModalController,
    ModeMemory,
    Sampled,
    SingleLaw,
    SmoothController,
    demand,
    modes_in,
    start_memory,
)
from cpjax.errors import DerivativeWarning, InputError
from cpjax.numeric.selection import where
from cpjax.pytree import Scalar, part, pytree

_NEEDS = ("start_mode", "next_mode", "mode_voltage", "margin", "successor")


@pytree
class Tracked:
    """A controller with modes whose memory also holds its margin and the shift of its last change of mode."""

    controller: SmoothController = part("a controller with modes", *_NEEDS)

    def __getattr__(self, name: str) -> Any:
        return getattr(object.__getattribute__(self, "controller"), name)

    def init(self, measurement: Any) -> ModeMemory:
        mode = start_memory(self.controller, measurement).mode
        margin = _margin(self.controller, measurement, mode)
        return ModeMemory(mode, margin, jnp.zeros_like(margin))

    def update(self, memory: ModeMemory, measurement: Any) -> tuple[ModeMemory, Scalar]:
        mode = integer(
            "controller.next_mode", call("controller", self.controller, "next_mode", measurement, memory.mode)
        )
        before, after = memory.margin, _margin(self.controller, measurement, memory.mode)
        assert before is not None
        crossed = (mode != memory.mode) & (before > 0.0) & (after < 0.0)
        shift = _moved_crossing(before, after, crossed)
        margin = _margin(self.controller, measurement, mode)
        return ModeMemory(mode, margin, shift), demand(self.controller, measurement, mode)


@pytree
class Holding:
    """The same controller with its mode held: it returns the command for an unchanged mode."""

    controller: SmoothController = part("a controller with modes", *_NEEDS)

    def __getattr__(self, name: str) -> Any:
        return getattr(object.__getattribute__(self, "controller"), name)

    def init(self, measurement: Any) -> ModeMemory:
        return Tracked(self.controller).init(measurement)

    def update(self, memory: ModeMemory, measurement: Any) -> tuple[ModeMemory, Scalar]:
        return memory, demand(self.controller, measurement, memory.mode)


def tracked(controller: Any) -> Any:
    """Returns the controller with every part that has a mode wrapped in `Tracked`."""
    return _replaced(controller, Tracked)


def holding(controller: Any) -> Any:
    """Returns the controller with every part that has a mode wrapped in `Holding`."""
    return _replaced(controller, Holding)


def shift_of(memory: Any) -> Float[Array, ""]:
    """Returns the shift of a change of mode at this instant, in control periods: value 0, with a derivative.

    Raises:
      InputError: a part of the controller has a mode, and its margin is not tracked.
    """
    total: Any = 0.0
    for node in modes_in(memory):
        if node.shift is None:
            allowed = "pathwise: a part of this controller has a mode, but hides it from JAX or has no margin"
            raise InputError("derivative", "mean", allowed)
        total = total + node.shift
    return jnp.asarray(total)


@jax.custom_jvp
def _moved_crossing(before: Float[Array, ""], after: Float[Array, ""], crossed: Bool[Array, ""]) -> Float[Array, ""]:
    """Returns 0 with, where `crossed`, the derivative of the crossing's position in the period between the two margins,
    `before / (before - after)`."""
    return where(crossed, jnp.zeros_like(before), jnp.zeros_like(before))


@_moved_crossing.defjvp
def _moved_crossing_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    before, after, crossed = primals
    d_before, d_after, _ = tangents
    over = where(crossed, 1.0 / where(crossed, before - after, 1.0) ** 2, 0.0)
    return _moved_crossing(*primals), over * (before * d_after - after * d_before)


@jax.custom_jvp
def shifted(new: Any, old: Any, shift: Float[Array, ""]) -> Any:
    """Returns `new` with the derivative of `(1 - shift) * new + shift * old` at `shift` = 0.

    Args:
      new, old: trees of one structure.
    """
    # Written with `where` so that under vmap the value is batched wherever its derivative is.
    return jax.tree.map(lambda a: where(shift == 0.0, a, a), new)


@shifted.defjvp
def _shifted_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    new, old, shift = primals
    d_new, _, d_shift = tangents

    def moved(new: Shaped[Array, "..."], old: Shaped[Array, "..."], tangent: Any) -> Any:
        if not jnp.issubdtype(jnp.asarray(new).dtype, jnp.floating):
            return tangent
        jump = _once(old - new)  # NaN for two infinities, such as a settling time that is not known yet
        return tangent + where(jnp.isfinite(jump), jump, 0.0) * d_shift

    return shifted(new, old, shift), jax.tree.map(moved, new, old, d_new)


@jax.custom_jvp
def _once(jump: Float[Array, "*leaf"]) -> Float[Array, "*leaf"]:
    """Returns its argument; raises InputError when differentiated, as second derivatives are not supported."""
    return jump


@_once.defjvp
def _once_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    allowed = "first derivatives only. For second derivatives ask for switching='located', on the continuous clock"
    raise InputError("derivative", "mean", allowed)


def difference(held: Any, updated: Any) -> tuple[Float[Array, "..."], ...]:
    """Returns, for each float leaf of a controller's memory, the value with the mode held minus the updated value.

    `ModeMemory` nodes are left out: mode and margin belong to the mode that was chosen.
    """
    pairs = zip(_parts(held), _parts(updated), strict=True)
    return tuple(a - b for a, b in pairs if _is_float(b))


def with_zeros(memory: Any, zeros: tuple[Float[Array, "..."], ...]) -> Any:
    """Returns a memory with zeros added to its float leaves for their derivatives, in the order of `difference`."""
    left = iter(zeros)
    parts = [part + next(left) if _is_float(part) else part for part in _parts(memory)]
    return jax.tree.unflatten(jax.tree.structure(memory, is_leaf=_is_mode), parts)


def _parts(memory: Any) -> list[Any]:
    return jax.tree.leaves(memory, is_leaf=_is_mode)


def _is_mode(node: Any) -> bool:
    return isinstance(node, ModeMemory)


def _is_float(part: Any) -> bool:
    return not _is_mode(part) and jnp.issubdtype(jnp.asarray(part).dtype, jnp.floating)


def may_switch(controller: Any, start: Any) -> bool:
    """Returns whether a controller has a mode that can be detected: a part with modes, or a memory with one."""

    def is_modal(node: Any) -> bool:
        return isinstance(node, ModalController) and not isinstance(node, (type, SingleLaw))

    if any(is_modal(node) for node in jax.tree.leaves(controller, is_leaf=is_modal)):
        return True
    if not isinstance(controller, Controller):
        return False
    return bool(
        modes_in(
            jax.eval_shape(lambda: arrays("controller.init: memory", call("controller", controller, "init", start)))
        )
    )


def warn_of_memory() -> None:
    """Warns that a metric of the voltage and a controller with a memory of numbers do not go together well."""
    message = (
        "derivative='mean': the metric depends on the voltage, and the controller keeps numbers in its memory, from "
        "which later voltages follow. Those are replaced to first order only: the derivative of a metric that is not "
        "linear in the voltage, such as the effort, is then approximate, and that of its total variation is wrong. "
        "See docs/gradients.md"
    )
    warnings.warn(message, DerivativeWarning, stacklevel=2)


def watched(tree: Any) -> Any:
    """Returns the tree unchanged; differentiating it warns that the derivative omits the effect of changes of mode."""
    leaves, structure = jax.tree.flatten(tree)
    real_ones = [i for i, leaf in enumerate(leaves) if jnp.issubdtype(getattr(leaf, "dtype", int), jnp.floating)]
    for i, leaf in zip(real_ones, _watched([leaves[i] for i in real_ones]), strict=True):
        leaves[i] = leaf
    return jax.tree.unflatten(structure, leaves)


@jax.custom_jvp
def _watched(leaves: list[Any]) -> list[Any]:
    return leaves


@_watched.defjvp
def _watched_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    message = (
        "the derivative of this loop leaves out how its change of mode moves with the parameters. Ask for "
        "switching='located' (exact, on the continuous clock), derivative='mean' (of the mean over initial states, on "
        "the sampled clock), or, if it is what you want, derivative='pathwise'. See docs/gradients.md"
    )
    warnings.warn(message, DerivativeWarning, stacklevel=2)
    return primals[0], tangents[0]


def _margin(controller: SmoothController, state: Any, mode: Int[Array, ""]) -> Float[Array, ""]:
    dtype = jnp.asarray(jax.tree.leaves(state)[0]).dtype
    return real("controller.margin", call("controller", controller, "margin", state, mode), dtype)


def _replaced(controller: Any, kind: type) -> Any:
    """Returns the controller with every part whose memory is only a mode wrapped in `kind`.

    Raises:
      InputError: a part with modes has a memory of its own beside them.
    """

    def is_modal(node: Any) -> bool:
        return isinstance(node, (SmoothController, Sampled)) and not isinstance(node, (type, SingleLaw))

    def replace(node: Any) -> Any:
        if not is_modal(node):
            return node
        inner = node.controller if isinstance(node, Sampled) else node
        if isinstance(node, Controller) and not isinstance(node, (Hybrid, Sampled)):
            allowed = (
                f"pathwise: {type(node).__name__} has modes and a memory of its own. Let a controller with memory hold "
                "a cpjax.Hybrid instead"
            )
            raise InputError("derivative", "mean", allowed)
        return kind(inner) if isinstance(inner, SmoothController) else node

    return jax.tree.map(replace, controller, is_leaf=is_modal)
