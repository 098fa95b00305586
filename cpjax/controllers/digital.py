"""Firmware around a controller that wants the whole state: an estimator before it, the dead band's inverse after it."""

import dataclasses
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cpjax.checks import call, pair, real
from cpjax.controllers.protocol import Controller, Law, ModalController, as_sampled
from cpjax.errors import InputError
from cpjax.linear.discretization import discretize
from cpjax.linear.estimation import dlqe
from cpjax.plant import CartPole, linearize
from cpjax.plant.state import State
from cpjax.pytree import JaxOrNumpy, Number, Scalar, matrix, number, part, pytree


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


class Estimate(NamedTuple):
    """Memory of an `Observer`."""

    state: State
    """Estimate at the last control instant."""
    started: Float[Array, ""]
    """0 before the first update, then 1."""


@pytree
class Observer:
    """Estimator that predicts by cpjax's own plant and corrects by a constant gain.

    The prediction over a control period is one Runge-Kutta step of the plant under the last command, clipped; the
    estimate is the prediction plus `gain` times the error of the predicted positions. Upright it is a Luenberger
    observer, with the gain of `cpjax.dlqe` a steady Kalman filter; elsewhere it follows the plant's own equations.
    """

    model: CartPole = part("plant model of the prediction, a CartPole", "vector_field", "saturate")
    gain: Float[JaxOrNumpy, "*batch 4 2"] = matrix((4, 2), "1 and 1/s", "correction per error of (x, theta)")
    period: Scalar | None = None
    """Control period of the loop [s], set by the rollout."""

    def at_period(self, period: Scalar) -> "Observer":
        """Returns the observer for a control period [s]."""
        return dataclasses.replace(self, period=period)

    def init(self, measurement: Any) -> Estimate:
        """Returns the memory at the first measurement, with both rates zero."""
        nothing = jnp.zeros_like(jnp.asarray(measurement.x))
        return Estimate(State(jnp.asarray(measurement.x), nothing, jnp.asarray(measurement.theta), nothing), nothing)

    def update(self, memory: Estimate, measurement: Any, command: Scalar) -> tuple[Estimate, State]:
        """Returns the new memory and the estimate."""
        if self.period is None:
            raise InputError("Observer.period", None, "known: use the observer in a rollout, or at_period(...)")
        before, voltage, T = memory.state, self.model.saturate(command), self.period

        def along(slope: State, share: float) -> State:
            return jax.tree.map(lambda s, d: s + share * T * d, before, slope)

        k1 = self.model.vector_field(before, voltage)
        k2 = self.model.vector_field(along(k1, 0.5), voltage)
        k3 = self.model.vector_field(along(k2, 0.5), voltage)
        k4 = self.model.vector_field(along(k3, 1.0), voltage)
        slope = jax.tree.map(lambda a, b, c, d: (a + 2.0 * b + 2.0 * c + d) / 6.0, k1, k2, k3, k4)
        predicted = jax.tree.map(lambda s, d: s + memory.started * T * d, before, slope)
        errors = measurement.x - predicted.x, measurement.theta - predicted.theta
        gain = jnp.asarray(self.gain)
        corrected = [
            old + gain[i, 0] * errors[0] + gain[i, 1] * errors[1]
            for i, old in enumerate((predicted.x, predicted.x_dot, predicted.theta, predicted.theta_dot))
        ]
        state = State(*corrected)
        return Estimate(state, jnp.ones_like(memory.started)), state


def kalman_observer(
    model: CartPole,
    *,
    period: float,
    x_deviation: float,
    theta_deviation: float,
    acceleration_deviation: float = 0.3,
    angular_acceleration_deviation: float = 1.0,
) -> Observer:
    """Designs an `Observer` whose gain is that of a steady Kalman filter upright.

    Args:
      model: plant model of the prediction.
      period: control period [s].
      x_deviation: standard deviation of the measured x [m]; of an encoder, step / sqrt(12).
      theta_deviation: standard deviation of the measured theta [rad].
      acceleration_deviation: standard deviation of an unknown cart acceleration, constant over a period [m/s^2].
      angular_acceleration_deviation: the same for the pole [rad/s^2].

    Raises:
      InputError: a period or deviation that is not above 0.
    """
    given = {
        "period": period,
        "x_deviation": x_deviation,
        "theta_deviation": theta_deviation,
        "acceleration_deviation": acceleration_deviation,
        "angular_acceleration_deviation": angular_acceleration_deviation,
    }
    for name, value in given.items():
        Number("SI", name, above=0.0).normalise(name, value)
    A, _ = discretize(*linearize(model), period)
    G = jnp.asarray([[0.5 * period**2, 0.0], [period, 0.0], [0.0, 0.5 * period**2], [0.0, period]], A.dtype)
    C = jnp.asarray([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]], A.dtype)
    QN = jnp.diag(jnp.asarray([acceleration_deviation**2, angular_acceleration_deviation**2], A.dtype))
    RN = jnp.diag(jnp.asarray([x_deviation**2, theta_deviation**2], A.dtype))
    return Observer(model, np.asarray(dlqe(A, G, C, QN, RN).filter))
