"""Firmware around a controller that wants the whole state: an estimator before it, the dead band's inverse after it."""

import dataclasses
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float

from cpjax.checks import call, pair, real
from cpjax.controllers.protocol import Controller, Law, ModalController, as_sampled
from cpjax.errors import InputError
from cpjax.plant.state import State
from cpjax.pytree import Scalar, number, part, pytree


@runtime_checkable
class Estimator(Protocol):
    """Reconstructs the state from measurements, once per control period."""

    def init(self, measurement: Any) -> Any:
        """Returns the memory before the first update, given the first measurement."""
        ...

    def update(self, memory: Any, measurement: Any, command: Scalar) -> tuple[Any, State]:
        """Returns the new memory and the estimate of the state.

        Args:
          memory: of the last update.
          measurement: with `x` [m] and `theta` [rad].
          command: the last command [V], 0 before the first.
        """
        ...


class DerivativeMemory(NamedTuple):
    """Memory of a `FilteredDerivative`."""

    x: Float[Array, ""]
    """Last measured cart position [m]."""
    theta: Float[Array, ""]
    """Last measured angle [rad]."""
    x_dot: Float[Array, ""]
    """Last estimate of its rate [m/s]."""
    theta_dot: Float[Array, ""]
    """Last estimate of its rate [rad/s]."""


@pytree
class FilteredDerivative:
    """Estimator of rates by differences of positions, smoothed by a first-order low-pass filter.

    v_k = a v_(k-1) + (1 - a) (y_k - y_(k-1)) / T with a = exp(-cutoff T) and v_0 = 0; positions are as measured.
    """

    cutoff: Scalar = number("rad/s", "corner frequency of the low-pass filter", above=0.0, infinite=True)
    period: Scalar | None = None
    """Control period of the loop [s], set by the rollout."""

    def at_period(self, period: Scalar) -> "FilteredDerivative":
        """Returns the filter for a control period [s]."""
        return dataclasses.replace(self, period=period)

    def init(self, measurement: Any) -> DerivativeMemory:
        """Returns the memory at the first measurement, with both rates zero."""
        x, theta = jnp.asarray(measurement.x), jnp.asarray(measurement.theta)
        return DerivativeMemory(x, theta, jnp.zeros_like(x), jnp.zeros_like(theta))

    def update(self, memory: DerivativeMemory, measurement: Any, command: Scalar) -> tuple[DerivativeMemory, State]:
        """Returns the new memory and the estimate."""
        if self.period is None:
            raise InputError("FilteredDerivative.period", None, "known: use the filter in a rollout, or at_period(...)")
        kept = jnp.exp(-self.cutoff * self.period)
        x_dot = kept * memory.x_dot + (1.0 - kept) * (measurement.x - memory.x) / self.period
        theta_dot = kept * memory.theta_dot + (1.0 - kept) * (measurement.theta - memory.theta) / self.period
        memory = DerivativeMemory(measurement.x, measurement.theta, x_dot, theta_dot)
        return memory, State(measurement.x, x_dot, measurement.theta, theta_dot)


class DigitalMemory(NamedTuple):
    """Memory of a `Digital`."""

    estimator: Any
    controller: Any
    command: Float[Array, ""]
    """Last command, before the dead band's inverse [V]."""


@pytree
class Digital:
    """Firmware: an estimator, a controller that wants the whole state, and the inverse of the drive's dead band."""

    controller: Controller | ModalController | Law = part("a controller, or a law")
    estimator: Estimator = part("an estimator, such as a cpjax.FilteredDerivative", "init", "update")
    dead_band: Scalar = number(
        "V", "a command other than 0 is raised to just beyond this magnitude", default=0.0, at_least=0.0
    )

    def init(self, measurement: Any) -> DigitalMemory:
        """Returns the memory before the first update."""
        first = State(measurement.x, 0.0 * measurement.x, measurement.theta, 0.0 * measurement.theta)
        inner = call("controller", as_sampled(self.controller), "init", first)
        memory = call("estimator", self.estimator, "init", measurement)
        return DigitalMemory(memory, inner, jnp.zeros_like(jnp.asarray(measurement.x)))

    def update(self, memory: DigitalMemory, measurement: Any) -> tuple[DigitalMemory, Scalar]:
        """Returns the new memory and the command [V]."""
        returned = call("estimator", self.estimator, "update", memory.estimator, measurement, memory.command)
        estimator, state = pair("estimator.update", returned, "the new memory and the state")
        returned = call("controller", as_sampled(self.controller), "update", memory.controller, state)
        inner, command = pair("controller.update", returned, "the new memory and the command")
        command = real("controller.update", command)
        least = self.dead_band * (1.0 + 1e-6)  # the band's edge itself gives 0 V
        raised = jnp.where(jnp.abs(command) < least, jnp.sign(command) * least, command)
        return DigitalMemory(estimator, inner, command), raised
