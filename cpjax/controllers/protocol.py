"""Interfaces of controllers in a rollout.

On the sampled clock a `Controller` corresponds to firmware: once per control period it takes a measurement and its
memory, any pytree, and returns the new memory and a command. Examples are a memoryless law, a hybrid with its mode, a
PID with its integral and an observer with its estimate.

The continuous clock, on which a change of mode can be located inside a step, requires more: a law for each mode, and a
smooth function that vanishes where a mode ends (`ModalController`, `SmoothController`). It supports no controller
memory other than the mode.

Any class that is a pytree to JAX can be used: one made by `cpjax.pytree.pytree`, a dataclass registered with JAX, an
`equinox.Module`.
"""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Int32

from cpjax.checks import call, integer, real
from cpjax.errors import InputError
from cpjax.plant.state import State
from cpjax.pytree import Scalar, part, pytree

SWING_UP = 0
"""Mode in which the swing-up law acts. A controller of a single law is always in mode 0."""

REGULATE = 1
"""Mode in which the regulator acts."""


@runtime_checkable
class Law(Protocol):
    """A memoryless law."""

    def voltage(self, state: State) -> Scalar:
        """Returns the demanded terminal voltage [V], a scalar; the motor clips it."""
        ...


@runtime_checkable
class Controller(Protocol):
    """A controller with memory, on the sampled clock."""

    def init(self, measurement: Any) -> Any:
        """Returns the memory before the first update, given the first measurement."""
        ...

    def update(self, memory: Any, measurement: Any) -> tuple[Any, Scalar]:
        """Returns the new memory, of the same structure, shapes and dtypes, and the command [V], a scalar.

        The result takes effect once per control period: the drive clips the command and holds it until the next one.
        (`update` is evaluated at every step of the integrator; results between control instants are discarded.)
        """
        ...


@runtime_checkable
class ModalController(Protocol):
    """A law for each mode, and the rule that chooses the mode. Modes are int32 scalars."""

    def start_mode(self, state: State) -> Int[Array, ""]:
        """Returns the mode at the start of a rollout, where there is no earlier mode."""
        ...

    def next_mode(self, state: State, mode: Int[Array, ""]) -> Int[Array, ""]:
        """Returns the mode from this control instant on, given the mode until now."""
        ...

    def mode_voltage(self, state: State, mode: Int[Array, ""]) -> Scalar:
        """Returns the demanded terminal voltage [V] of the law that acts in `mode`; the motor clips it."""
        ...


@runtime_checkable
class SmoothController(ModalController, Protocol):
    """A controller whose mode ends where a smooth function vanishes, so that the instant can be located."""

    def margin(self, state: State, mode: Int[Array, ""]) -> Scalar:
        """Returns a scalar that is at least 0 while `mode` lasts, smooth in the state near 0."""
        ...

    def successor(self, mode: Int[Array, ""]) -> Int[Array, ""]:
        """Returns the mode after `mode`, once its margin has vanished."""
        ...


@runtime_checkable
class Clocked(Protocol):
    """A part of a controller that depends on the control period, such as a filter, or on time."""

    def at_period(self, period: Scalar) -> Any:
        """Returns the part to use instead in a loop with this control period [s].

        A rollout calls this once, before its first step, on every such part of a controller.
        """
        ...


class ModeMemory(NamedTuple):
    """Memory of a controller with modes. The loop finds it inside any controller's memory and records the mode.

    Attributes:
      mode: since the last update.
      margin: of that mode at the last update; only if the derivative of the mean is requested, else None.
      shift: of the last change of mode, as a fraction of the control period: value 0, with the derivative of the
        instant of crossing; only if the derivative of the mean is requested, else None.
    """

    mode: Int32[Array, ""]
    margin: Float[Array, ""] | None = None
    shift: Float[Array, ""] | None = None


def modes_in(memory: Any) -> list[ModeMemory]:
    """Returns every `ModeMemory` in a controller's memory, in the order of its leaves."""
    nodes = jax.tree.leaves(memory, is_leaf=lambda node: isinstance(node, ModeMemory))
    return [node for node in nodes if isinstance(node, ModeMemory)]


def update_mode(controller: ModalController, memory: ModeMemory, state: State) -> tuple[ModeMemory, Scalar]:
    """Runs a modal controller for one control period; returns the next mode and the voltage [V] of its law."""
    mode = integer("controller.next_mode", call("controller", controller, "next_mode", state, memory.mode))
    return ModeMemory(mode), demand(controller, state, mode)


def start_memory(controller: ModalController, state: State) -> ModeMemory:
    """Returns a modal controller's memory at the start of a rollout."""
    return ModeMemory(integer("controller.start_mode", call("controller", controller, "start_mode", state)))


def demand(controller: ModalController, state: State, mode: Int[Array, ""]) -> Float[Array, ""]:
    """Returns the voltage [V] that the law of `mode` demands, in the state's dtype."""
    dtype = jnp.asarray(jax.tree.leaves(state)[0]).dtype
    return real("controller.mode_voltage", call("controller", controller, "mode_voltage", state, mode), dtype)


@pytree
class SingleLaw:
    """Adapter of a `Law` to the interface of a controller, always in mode 0."""

    law: Law = part("a law", "voltage")

    def init(self, measurement: State) -> tuple[()]:
        return ()

    def update(self, memory: tuple[()], measurement: State) -> tuple[tuple[()], Scalar]:
        return (), self._voltage(measurement)

    def start_mode(self, state: State) -> Int[Array, ""]:
        return jnp.asarray(SWING_UP, dtype=jnp.int32)

    def next_mode(self, state: State, mode: Int[Array, ""]) -> Int[Array, ""]:
        return mode

    def mode_voltage(self, state: State, mode: Int[Array, ""]) -> Scalar:
        return self._voltage(state)

    def margin(self, state: State, mode: Int[Array, ""]) -> Scalar:
        return 1.0

    def successor(self, mode: Int[Array, ""]) -> Int[Array, ""]:
        return mode

    def _voltage(self, state: State) -> jax.Array:
        return real("controller.voltage", call("controller", self.law, "voltage", state))


@pytree
class Sampled:
    """Adapter of a user's `ModalController` to a `Controller`, whose memory is the mode."""

    controller: ModalController = part("a controller with modes", "start_mode", "next_mode", "mode_voltage")

    def init(self, measurement: State) -> ModeMemory:
        return start_memory(self.controller, measurement)

    def update(self, memory: ModeMemory, measurement: State) -> tuple[ModeMemory, Scalar]:
        return update_mode(self.controller, memory, measurement)


def as_controller(controller: Any) -> Any:
    """Returns `controller` itself, or a bare law wrapped as a controller.

    Raises:
      InputError: it is neither a `Controller`, nor a `ModalController`, nor a `Law`.
    """
    if not isinstance(controller, type):  # a class has the methods too, but no parameters
        if isinstance(controller, (Controller, ModalController)):
            return controller
        if isinstance(controller, Law):
            return SingleLaw(controller)
    allowed = (
        "a controller such as cpjax.Hybrid, or a law with voltage(state), "
        "or a controller with init(measurement) and update(memory, measurement)"
    )
    raise InputError("controller", controller, allowed)


def as_sampled(controller: Any) -> Controller:
    """Returns a law, or a controller of either kind, as a `Controller` with `init` and `update`.

    For controllers that contain another one, such as an observer.

    Raises:
      InputError: as `as_controller` does.
    """
    controller = as_controller(controller)
    return controller if isinstance(controller, Controller) else Sampled(controller)


def at_period(controller: Any, period: Scalar) -> Any:
    """Returns the controller with `at_period(period)` [s] applied to its `Clocked` parts, inner before outer ones."""

    def told(node: Any) -> Any:
        if not _is_clocked(node):
            return node
        inner = jax.tree.map(told, node, is_leaf=lambda one: one is not node and _is_clocked(one))
        return call("controller", inner, "at_period", period)

    return jax.tree.map(told, controller, is_leaf=_is_clocked)


def is_clocked(controller: Any) -> bool:
    """Returns whether any part of a controller depends on the control period."""
    return any(_is_clocked(node) for node in jax.tree.leaves(controller, is_leaf=_is_clocked))


def _is_clocked(node: Any) -> bool:
    return isinstance(node, Clocked) and not isinstance(node, type)
