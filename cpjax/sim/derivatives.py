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

Three limits. The plant has to be affine in its input, as any with a motor is. A metric gets the difference between two
voltages, but a function of a saved trajectory's voltage gets the slope there. And a command that a controller keeps in
its memory, to return it later, as a dead time does, is replaced to first order only: a metric that is not linear in the
voltage, such as the effort, then has the slope of its integrand where it should have the difference.
"""

import warnings
from typing import Any

import jax
import jax.numpy as jnp

from cpjax.checks import call, integer, real
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
from cpjax.pytree import Scalar, part, pytree

_NEEDS = ("start_mode", "next_mode", "mode_voltage", "margin", "successor")


@pytree
class Tracked:
    """A controller with modes that remembers its margin, and says by how much its last change of mode moves."""

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
    """The same controller with its mode held: what it would have commanded, had the mode not changed."""

    controller: SmoothController = part("a controller with modes", *_NEEDS)

    def __getattr__(self, name: str) -> Any:
        return getattr(object.__getattribute__(self, "controller"), name)

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
def _moved_crossing(before: jax.Array, after: jax.Array, crossed: jax.Array) -> jax.Array:
    """Returns 0, with the derivative of `before / (before - after)` where a crossing is, which is where in the period
    between two margins the crossing is."""
    return jnp.where(crossed, jnp.zeros_like(before), jnp.zeros_like(before))


@_moved_crossing.defjvp
def _moved_crossing_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    before, after, crossed = primals
    d_before, d_after, _ = tangents
    over = jnp.where(crossed, 1.0 / jnp.where(crossed, before - after, 1.0) ** 2, 0.0)
    return _moved_crossing(*primals), over * (before * d_after - after * d_before)


@jax.custom_jvp
def shifted(new: Any, old: Any, shift: jax.Array) -> Any:
    """Returns `new`, whose derivative is also that of replacing it by `old` to the share `shift`, which is 0.

    Args:
      new, old: trees of one structure.
    """
    # Written as a choice so that under vmap the value is a batch wherever its derivative is one.
    return jax.tree.map(lambda a: jnp.where(shift == 0.0, a, a), new)


@shifted.defjvp
def _shifted_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    new, old, shift = primals
    d_new, _, d_shift = tangents

    def moved(new: jax.Array, old: jax.Array, tangent: Any) -> Any:
        if not jnp.issubdtype(jnp.asarray(new).dtype, jnp.floating):
            return tangent
        jump = _once(old - new)  # of two infinities, such as a settling time that is not known yet, it is NaN
        return tangent + jnp.where(jnp.isfinite(jump), jump, 0.0) * d_shift

    return shifted(new, old, shift), jax.tree.map(moved, new, old, d_new)


@jax.custom_jvp
def _once(jump: jax.Array) -> jax.Array:
    """Returns its argument, which must not be differentiated again."""
    return jump


@_once.defjvp
def _once_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    allowed = "first derivatives only. For second derivatives ask for switching='located', on the continuous clock"
    raise InputError("derivative", "mean", allowed)


def difference(held: Any, updated: Any) -> tuple[jax.Array, ...]:
    """Returns by how much a controller's memory would differ, had its mode been held: each of its float leaves.

    Modes and their margins are left out: they belong to the mode that was chosen.
    """
    pairs = zip(_parts(held), _parts(updated), strict=True)
    return tuple(a - b for a, b in pairs if _is_float(b))


def with_zeros(memory: Any, zeros: tuple[jax.Array, ...]) -> Any:
    """Returns a memory with zeros added to its float leaves, for their derivative; as many as `difference` returns."""
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
    """Whether a controller has a mode, as far as can be seen: a part with modes, or a memory with one."""

    def is_modal(node: Any) -> bool:
        return isinstance(node, ModalController) and not isinstance(node, (type, SingleLaw))

    if any(is_modal(node) for node in jax.tree.leaves(controller, is_leaf=is_modal)):
        return True
    if not isinstance(controller, Controller):
        return False
    return bool(modes_in(jax.eval_shape(lambda: call("controller", controller, "init", start))))


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


def _replaced(controller: Any, kind: type) -> Any:
    """Returns the controller with every part whose whole memory is a mode in a `kind`.

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
