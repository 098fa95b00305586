"""Firmware around a controller that wants the whole state: an estimator before it, the dead band's inverse after it."""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float

from cpjax.checks import call, pair, real
from cpjax.controllers.protocol import Controller, Law, ModalController, as_sampled
from cpjax.errors import InputError
from cpjax.plant.state import State
from cpjax.pytree import Scalar, count, number, part, pytree


@runtime_checkable
class Estimator(Protocol):
    """Reconstructs the state from measurements, once per control period.

    For a `Digital` with a delay it also has `predict(state, command)`, the state after a control period.
    """

    def init(self, measurement: Any) -> Any:
        """Returns the memory before the first update, given the first measurement."""
        ...

    def update(self, memory: Any, measurement: Any, command: Scalar) -> tuple[Any, State]:
        """Returns the new memory and the estimate of the state.

        Args:
          memory: of the last update.
          measurement: with `x` [m] and `theta` [rad].
          command: the command that has acted since the last update [V], before the clip; 0 before the first.
        """
        ...


class DigitalMemory(NamedTuple):
    """Memory of a `Digital`."""

    estimator: Any
    controller: Any
    commands: tuple[Float[Array, ""], ...]
    """Last commands as they were sent, the newest first [V]: those still under way, and the one that acts."""


@pytree
class Digital:
    """Firmware: an estimator, a controller that wants the whole state, and the inverse of the drive's dead band.

    With a `delay` the estimate is predicted over the commands still under way, so that the controller acts on the state
    at which its command takes effect.
    """

    controller: Controller | ModalController | Law = part("a controller, or a law")
    estimator: Estimator = part("an estimator, such as a cpjax.FilteredDerivative", "init", "update")
    dead_band: Scalar = number(
        "V", "a command other than 0 is raised to just beyond this magnitude", default=0.0, at_least=0.0
    )
    delay: int = count("control periods until a command acts, as the firmware knows it", default=0, at_most=1000)

    def __post_init__(self) -> None:
        if self.delay and not hasattr(self.estimator, "predict"):
            raise InputError("Digital.estimator", self.estimator, "one with predict(state, command), for a delay")

    def init(self, measurement: Any) -> DigitalMemory:
        """Returns the memory before the first update."""
        first = State(measurement.x, 0.0 * measurement.x, measurement.theta, 0.0 * measurement.theta)
        inner = call("controller", as_sampled(self.controller), "init", first)
        memory = call("estimator", self.estimator, "init", measurement)
        return DigitalMemory(memory, inner, (jnp.zeros_like(jnp.asarray(measurement.x)),) * (self.delay + 1))

    def update(self, memory: DigitalMemory, measurement: Any) -> tuple[DigitalMemory, Scalar]:
        """Returns the new memory and the command [V]."""
        *under_way, acting = memory.commands
        returned = call("estimator", self.estimator, "update", memory.estimator, measurement, acting)
        estimator, state = pair("estimator.update", returned, "the new memory and the state")
        for command in reversed(under_way):
            state = call("estimator", self.estimator, "predict", state, command)
        returned = call("controller", as_sampled(self.controller), "update", memory.controller, state)
        inner, command = pair("controller.update", returned, "the new memory and the command")
        command = real("controller.update", command)
        least = self.dead_band * (1.0 + 1e-6)  # the band's edge itself gives 0 V
        # What the estimator is told is what the drive applies: in the band that is its edge, not the controller's wish.
        sent = jnp.where(jnp.abs(command) < least, jnp.sign(command) * least, command)
        return DigitalMemory(estimator, inner, (sent, *under_way)), sent
