"""Firmware around a controller that wants the whole state: an estimator before it, the dead band's inverse after it."""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float

from cpjax.checks import call, pair, real
from cpjax.controllers.protocol import Controller, Law, ModalController, as_sampled
from cpjax.errors import InputError
from cpjax.numeric.selection import where
from cpjax.plant.state import State
from cpjax.pytree import Scalar, count, number, part, pytree


@runtime_checkable
class Estimator(Protocol):
    """Reconstructs the state from measurements, once per control period.

    For a `Digital` with a delay it is a `Predictor`.
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


@runtime_checkable
class Predictor(Estimator, Protocol):
    """An estimator with a model of the plant, whose memory has a `state`; `update` is `advance`, then `correct`."""

    def advance(self, memory: Any, command: Scalar) -> Any:
        """Returns the memory a control period on, under a command [V]; before the first measurement as it is."""
        ...

    def correct(self, memory: Any, measurement: Any) -> Any:
        """Returns the memory after a measurement."""
        ...

    def predict(self, state: State, command: Scalar) -> State:
        """Returns the state after a control period under a command [V]."""
        ...


class DigitalMemory(NamedTuple):
    """Memory of a `Digital`."""

    estimator: Any
    """The estimator's; with a delay that of the next control instant, before its measurement."""
    controller: Any
    commands: tuple[Float[Array, ""], ...]
    """Commands that do not act yet, and without a delay the one that acts, as they were sent; the newest first [V]."""


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
        if self.delay and not isinstance(self.estimator, Predictor):
            raise InputError("Digital.estimator", self.estimator, "one with a model of the plant, for a delay")

    def init(self, measurement: Any) -> DigitalMemory:
        """Returns the memory before the first update."""
        first = State(measurement.x, 0.0 * measurement.x, measurement.theta, 0.0 * measurement.theta)
        inner = call("controller", as_sampled(self.controller), "init", first)
        memory = call("estimator", self.estimator, "init", measurement)
        return DigitalMemory(memory, inner, (jnp.zeros_like(jnp.asarray(measurement.x)),) * max(self.delay, 1))

    def update(self, memory: DigitalMemory, measurement: Any) -> tuple[DigitalMemory, Scalar]:
        """Returns the new memory and the command [V]."""
        *later, acting = memory.commands
        estimator: Any
        if isinstance(self.estimator, Predictor) and self.delay:
            # The estimate a period on is computed here and kept: the next update needs it as well.
            estimator = self.estimator.advance(self.estimator.correct(memory.estimator, measurement), acting)
            state = estimator.state
            for command in reversed(later):
                state = self.estimator.predict(state, command)
        else:
            returned = call("estimator", self.estimator, "update", memory.estimator, measurement, acting)
            estimator, state = pair("estimator.update", returned, "the new memory and the state")
        returned = call("controller", as_sampled(self.controller), "update", memory.controller, state)
        inner, command = pair("controller.update", returned, "the new memory and the command")
        command = real("controller.update", command)
        least = self.dead_band * (1.0 + 1e-6)  # the band's edge itself gives 0 V
        # What the estimator is told is what the drive applies: in the band that is its edge, not the controller's wish.
        sent = where(jnp.abs(command) < least, jnp.sign(command) * least, command)
        return DigitalMemory(estimator, inner, (sent, *later)), sent
