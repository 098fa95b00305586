"""Derivatives on the sampled clock, where a change of mode falls on a control instant.

Such an instant does not move with a parameter, so plain automatic differentiation leaves out what a change of mode
does. The mean over initial states moves all the same: the crossing's phase within the control period is as good as
random, so that a crossing which comes later by dt* delays the change of mode by one whole period T in a share dt*/T of
all runs. In the mean, the first command of the new mode is thus replaced, to first order, by the one of the old mode to
the share

    d(dt*)/T,    dt*/dp = -(dg/dp) / (dg/dt)    where g, the margin of the old mode, crosses zero.

This is smoothed perturbation analysis (Gong and Ho, 1987) of the hybrid loop. The crossing is where the straight line
through the margins at the two control instants about it vanishes, so both values and derivatives are those at the
crossing, to first order in T.

A command that is held over a period acts in its middle on average, half a period after the change of mode that it
stands for. So 3/2 of the difference is put into the period of the change, and -1/2 into the next, whose mean is the
instant of the change. That makes the error of the mean one of second order in T.

Whatever sits in the loop, estimator, delay or memory, the command that the old mode would have led to is found by
running the controller a second time with its mode held. The parts that have a mode are found inside any controller and
replaced, by one that also tracks its margin (`Tracked`) and one that holds its mode (`Holding`).

Two limits. The plant has to be affine in its input, as any with a motor is. And a command that a controller keeps in
its memory, to return it later, as a dead time does, is replaced to first order only: a metric that is not linear in the
voltage, such as the effort, then has the slope of its integrand where it should have the difference.
"""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from cpjax.controllers.protocol import (
    ModeMemory,
    Sampled,
    SingleLaw,
    SmoothController,
    demand,
    modes_in,
    start_memory,
)
from cpjax.errors import DerivativeWarning, InputError
from cpjax.pytree import Scalar, part, pytree
from cpjax.returned import call, real

_NEEDS = ("start_mode", "next_mode", "mode_voltage", "margin", "successor")


@pytree
class Tracked:
    """A controller with modes that remembers its margin, and says by how much its last change of mode moves."""

    controller: SmoothController = part("a controller with modes", *_NEEDS)

    def init(self, measurement: Any) -> ModeMemory:
        mode = start_memory(self.controller, measurement).mode
        margin = _margin(self.controller, measurement, mode)
        return ModeMemory(mode, margin, jnp.zeros_like(margin))

    def update(self, memory: ModeMemory, measurement: Any) -> tuple[ModeMemory, Scalar]:
        mode = jnp.asarray(call("controller", self.controller, "next_mode", measurement, memory.mode), dtype=jnp.int32)
        before, after = memory.margin, _margin(self.controller, measurement, memory.mode)
        assert before is not None
        crossed = (mode != memory.mode) & (before > 0.0) & (after < 0.0)
        fraction = before / jnp.where(crossed, before - after, 1.0)
        shift = jnp.where(crossed, fraction - lax.stop_gradient(fraction), 0.0)
        margin = _margin(self.controller, measurement, mode)
        return ModeMemory(mode, margin, shift), demand(self.controller, measurement, mode)


@pytree
class Holding:
    """The same controller with its mode held: what it would have commanded, had the mode not changed."""

    controller: SmoothController = part("a controller with modes", *_NEEDS)

    def init(self, measurement: Any) -> ModeMemory:
        return Tracked(self.controller).init(measurement)

    def update(self, memory: ModeMemory, measurement: Any) -> tuple[ModeMemory, Scalar]:
        return memory, demand(self.controller, measurement, memory.mode)


def tracked(controller: Any) -> Any:
    """Returns the controller with every part that has a mode tracked."""
    return _replaced(controller, Tracked)


def holding(controller: Any) -> Any:
    """Returns the controller with every part that has a mode holding it."""
    return _replaced(controller, Holding)


def shift_of(memory: Any) -> jax.Array:
    """Returns by how much of a control period the change of mode at this instant moves: value 0, with a derivative.

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
def shifted(new: Any, old: Any, shift: jax.Array) -> Any:
    """Returns `new`, whose derivative is also that of replacing it by `old` to the share `shift`, which is 0.

    Args:
      new, old: trees of one structure.
    """
    return new


@shifted.defjvp
def _shifted_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    new, old, _ = primals
    d_new, _, d_shift = tangents

    def moved(new: jax.Array, old: jax.Array, tangent: Any) -> Any:
        if not jnp.issubdtype(jnp.asarray(new).dtype, jnp.floating):
            return tangent
        jump = old - new  # of two infinities, such as a settling time that is not known yet, it is NaN
        return tangent + jnp.where(jnp.isfinite(jump), jump, 0.0) * d_shift

    return new, jax.tree.map(moved, new, old, d_new)


def difference(held: Any, updated: Any) -> Any:
    """Returns by how much a controller's memory would differ, had its mode been held: of the float leaves.

    None stands for other leaves, and for modes and their margins, which belong to the mode that was chosen.
    """

    def is_mode(node: Any) -> bool:
        return isinstance(node, ModeMemory)

    def less(a: Any, b: Any) -> Any:
        return None if is_mode(a) or not jnp.issubdtype(jnp.asarray(a).dtype, jnp.floating) else a - b

    return jax.tree.map(less, held, updated, is_leaf=is_mode)


def may_switch(controller: Any) -> bool:
    """Whether a controller has a part with modes, as far as can be seen."""
    return any(_has_modes(one) for one in jax.tree.leaves(controller, is_leaf=_has_modes))


def watched(tree: Any) -> Any:
    """Returns the tree; differentiating it warns that the derivative misses the change of mode."""
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


def _margin(controller: SmoothController, state: Any, mode: jax.Array) -> jax.Array:
    dtype = jnp.asarray(jax.tree.leaves(state)[0]).dtype
    return real("controller.margin", call("controller", controller, "margin", state, mode), dtype)


def _has_modes(node: Any) -> bool:
    return isinstance(node, (SmoothController, Sampled)) and not isinstance(node, (type, SingleLaw))


def _replaced(controller: Any, kind: type) -> Any:
    def replace(node: Any) -> Any:
        inner = node.controller if isinstance(node, Sampled) else node
        return kind(inner) if _has_modes(node) and isinstance(inner, SmoothController) else node

    return jax.tree.map(replace, controller, is_leaf=_has_modes)
