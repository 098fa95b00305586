"""What a rollout asks of a controller.

A `Law` is a function of the state. A `Controller` also has a mode, which the rollout remembers for it between control
instants: a gate with hysteresis depends on where the state came from, so the mode is part of the simulation's state.
"""

from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp

from cpjax.errors import InputError
from cpjax.pytree import Scalar, part, pytree
from cpjax.state import State

SWING_UP = 0
"""Mode in which the swing-up law acts. A controller of a single law is always in mode 0."""

REGULATE = 1
"""Mode in which the regulator acts."""


@runtime_checkable
class Law(Protocol):
    """A memoryless law."""

    def voltage(self, state: State) -> Scalar:
        """Demanded terminal voltage [V]; the motor clips it."""
        ...


@runtime_checkable
class Controller(Protocol):
    """A law for each mode, and the rule that chooses the mode. Modes are int32 scalars."""

    def start_mode(self, state: State) -> jax.Array:
        """Mode at the start of a rollout, when there is no earlier mode to remember."""
        ...

    def next_mode(self, state: State, mode: jax.Array) -> jax.Array:
        """Mode from this control instant on, given the mode until now."""
        ...

    def mode_voltage(self, state: State, mode: jax.Array) -> Scalar:
        """Demanded terminal voltage [V] of the law that acts in `mode`; the motor clips it."""
        ...


@runtime_checkable
class SmoothController(Controller, Protocol):
    """A controller whose mode ends where a smooth function vanishes, so that the moment can be located."""

    def margin(self, state: State, mode: jax.Array) -> Scalar:
        """At least 0 while `mode` lasts, smooth in the state near 0."""
        ...

    def successor(self, mode: jax.Array) -> jax.Array:
        """Mode after `mode`, once its margin has vanished."""
        ...


@pytree
class SingleLaw:
    """A `Law` as a `Controller` that never leaves mode 0."""

    law: Law = part("a law", "voltage")

    def start_mode(self, state: State) -> jax.Array:
        return jnp.zeros_like(state.x, dtype=jnp.int32)

    def next_mode(self, state: State, mode: jax.Array) -> jax.Array:
        return mode

    def mode_voltage(self, state: State, mode: jax.Array) -> Scalar:
        return self.law.voltage(state)

    def margin(self, state: State, mode: jax.Array) -> Scalar:
        return jnp.ones_like(state.x)

    def successor(self, mode: jax.Array) -> jax.Array:
        return mode


def as_controller(controller: Controller | Law) -> Controller:
    """`controller` itself, or a bare law as a controller.

    Raises:
      InputError: it is neither.
    """
    if not isinstance(controller, type):  # a class has the methods too, but no parameters
        if isinstance(controller, Controller):
            return controller
        if isinstance(controller, Law):
            return SingleLaw(controller)
    raise InputError("controller", controller, "a controller such as cpjax.Hybrid, or a law with voltage(state)")
