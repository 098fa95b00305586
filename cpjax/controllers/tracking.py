"""Integral action against constant disturbances, and a reference for the cart that moves."""

import csv
import dataclasses
import math
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Real

from cpjax.checks import call, pair, real
from cpjax.controllers.feedback import StateFeedback
from cpjax.controllers.hybrid import Hybrid
from cpjax.controllers.protocol import REGULATE, Controller, Law, ModalController, as_sampled, modes_in
from cpjax.controllers.signal import SignalMemory, VoltageSignal
from cpjax.errors import InputError
from cpjax.linear.lqr import lqr
from cpjax.numeric.selection import where
from cpjax.plant import CartPole, linearize
from cpjax.plant.state import State
from cpjax.pytree import Number, Scalar, number, part, pytree


class IntegralMemory(NamedTuple):
    """Memory of an `IntegralAction`."""

    controller: Any
    integral: Float[Array, ""]
    """Integral of the cart's error [m s]."""


@pytree
class IntegralAction:
    """A controller with integral action on the cart's position: u = u_controller - gain integral of (x - reference_x).

    It removes the offset that a tilted rail or a constant force causes. It integrates only while the controller
    regulates (a controller without modes always does), and starts from 0 at each catch, so that a swing-up leaves
    nothing in it. Against windup, the error is not integrated while the cart is fast, as in a catch or after a step of
    the reference, nor where the command is beyond `voltage_limit` and the integral would drive it further (conditional
    integration; Astrom and Hagglund, 1995).
    """

    controller: Controller | ModalController | Law = part("a controller, or a law")
    gain: Scalar = number("V/(m s)", "voltage per integral of the cart's error", default=0.0)
    reference_x: Scalar = number("m", "where the cart is to be", default=0.0)
    voltage_limit: Scalar = number("V", "beyond it the drive clips", default=12.0, above=0.0, infinite=True)
    slow: Scalar = number("m/s", "speed of the cart up to which it integrates", default=0.1, above=0.0, infinite=True)
    period: Scalar | None = None
    """Control period of the loop [s], set by the rollout."""

    @classmethod
    def designed(
        cls,
        controller: Hybrid,
        plant: CartPole,
        Q: Real[ArrayLike, "4 4"],
        R: Real[ArrayLike, ""] | float,
        *,
        integral_weight: float,
    ) -> "IntegralAction":
        """Returns `controller` with an LQR for the plant extended by the integral of x, as regulator and integral gain.

        Args:
          controller: a hybrid, whose swing-up law and gate stay.
          plant: the plant.
          Q: state weight.
          R: weight of the voltage.
          integral_weight: weight of the integral [1/(m s)^2].

        Raises:
          InputError: as `cpjax.lqr` does, another controller than a `Hybrid` with a `StateFeedback`, or a weight that
            is not above 0.
        """
        if not isinstance(controller, Hybrid) or not isinstance(controller.regulator, StateFeedback):
            raise InputError("controller", controller, "a cpjax.Hybrid with a cpjax.StateFeedback")
        Number("1/(m s)^2", "weight of the integral", above=0.0).normalise("integral_weight", integral_weight)
        A, B = linearize(plant)
        wide = jnp.zeros((5, 5), A.dtype).at[:4, :4].set(A).at[4, 0].set(1.0)
        weight = jnp.zeros((5, 5), A.dtype).at[:4, :4].set(jnp.asarray(Q, A.dtype)).at[4, 4].set(integral_weight)
        K = lqr(wide, jnp.concatenate([B, jnp.zeros((1, 1), B.dtype)]), weight, R).K
        reference = controller.regulator.reference
        regulator = StateFeedback(np.asarray(K[:, :4]), reference)
        limit = plant.motor.voltage_limit
        hybrid = dataclasses.replace(controller, regulator=regulator)
        return cls(hybrid, float(K[0, 4]), reference_x=reference.x, voltage_limit=limit)

    def at_period(self, period: Scalar) -> "IntegralAction":
        """Returns the controller for a control period [s]."""
        return dataclasses.replace(self, period=period)

    def init(self, measurement: State) -> IntegralMemory:
        """Returns the memory before the first update."""
        inner = call("controller", as_sampled(self.controller), "init", measurement)
        return IntegralMemory(inner, jnp.zeros_like(jnp.asarray(measurement.x)))

    def update(self, memory: IntegralMemory, measurement: State) -> tuple[IntegralMemory, Scalar]:
        """Returns the new memory and the command [V]."""
        if self.period is None:
            raise InputError("IntegralAction.period", None, "known: use the controller in a rollout, or at_period(...)")
        returned = call("controller", as_sampled(self.controller), "update", memory.controller, measurement)
        inner, wanted = pair("controller.update", returned, "the new memory and the command")
        wanted = real("controller.update", wanted)
        modes = modes_in(inner)
        regulates = jnp.asarray(True) if not modes else modes[0].mode == REGULATE
        integral = where(regulates, memory.integral, 0.0)
        command = wanted - self.gain * integral
        error = measurement.x - self.reference_x
        further = -self.gain * error * jnp.sign(command) > 0.0
        grows = (
            regulates & (jnp.abs(measurement.x_dot) <= self.slow) & ~((jnp.abs(command) > self.voltage_limit) & further)
        )
        return IntegralMemory(inner, integral + where(grows, self.period * error, 0.0)), command


class ReferenceMemory(NamedTuple):
    """Memory of a `MovingReference`."""

    controller: Any
    signal: SignalMemory


@pytree
class MovingReference:
    """A controller whose cart follows a reference: it sees the cart's position relative to where it is to be.

    Swing-up law, gate and regulator all see the relative position. Put it inside a `Digital`, behind the estimator,
    which is to see the measured position.
    """

    controller: Controller | ModalController | Law = part("a controller, or a law")
    signal: VoltageSignal = part("positions of the cart over time, in a cpjax.VoltageSignal", "init", "update")

    @classmethod
    def steps(
        cls, controller: Any, times: Real[ArrayLike, " times"], positions: Real[ArrayLike, " times"]
    ) -> "MovingReference":
        """Returns the controller with a reference that steps to each position [m] at its time [s], from 0.

        Raises:
          InputError: as many positions as times are needed, and times that rise.
        """
        return cls(controller, VoltageSignal(_listed(times), _listed(positions)))

    @classmethod
    def square_wave(
        cls, controller: Any, *, amplitude: float, period: float, duration: float, begin: float = 0.0
    ) -> "MovingReference":
        """Returns the controller with a reference that jumps between +amplitude and -amplitude [m].

        Args:
          controller: the controller.
          amplitude: of the reference [m].
          period: of the wave [s].
          duration: of the wave [s]; the last position is held.
          begin: time of the first step, to +amplitude [s].

        Raises:
          InputError: a number out of its range.
        """
        for name, value in (("period", period), ("duration", duration)):
            Number("s", name, above=0.0).normalise(name, value)
        Number("m", "amplitude").normalise("amplitude", amplitude)
        Number("s", "begin", at_least=0.0).normalise("begin", begin)
        if duration > 1e6 * period:
            raise InputError("duration", duration, "at most a million periods")
        count = max(1, math.ceil(2.0 * duration / period - 1e-9))
        times = begin + 0.5 * period * np.arange(count)
        return cls.steps(controller, times, amplitude * (-1.0) ** np.arange(count))

    @classmethod
    def from_file(cls, controller: Any, path: str | Path) -> "MovingReference":
        """Returns the controller with a reference from a CSV file with the columns `time` [s] and `x` [m].

        Raises:
          InputError: no such file, a column that is missing, or a value that is no number.
        """
        try:
            with Path(path).open(newline="", encoding="utf-8") as file:
                rows = list(csv.DictReader(file))
        except (OSError, UnicodeDecodeError, csv.Error) as problem:
            raise InputError("path", str(path), f"a CSV file that can be read ({problem})") from problem
        columns: dict[str, list[float]] = {"time": [], "x": []}
        for number_of_row, row in enumerate(rows, start=2):
            for name, column in columns.items():
                try:
                    column.append(float(row[name]))
                except (KeyError, TypeError, ValueError) as problem:
                    allowed = "a number, in a file with the columns time and x"
                    raise InputError(f"{path}: line {number_of_row}: {name}", row.get(name), allowed) from problem
        if not rows:
            raise InputError("path", str(path), "a CSV file with at least one row below its header time,x")
        return cls.steps(controller, np.asarray(columns["time"]), np.asarray(columns["x"]))

    def init(self, measurement: State) -> ReferenceMemory:
        """Returns the memory before the first update."""
        signal = self.signal.init(measurement)
        _, position = self.signal.update(signal, measurement)
        inner = call("controller", as_sampled(self.controller), "init", _relative(measurement, position))
        return ReferenceMemory(inner, signal)

    def update(self, memory: ReferenceMemory, measurement: State) -> tuple[ReferenceMemory, Scalar]:
        """Returns the new memory and the command [V]."""
        signal, position = self.signal.update(memory.signal, measurement)
        relative = _relative(measurement, position)
        returned = call("controller", as_sampled(self.controller), "update", memory.controller, relative)
        inner, command = pair("controller.update", returned, "the new memory and the command")
        return ReferenceMemory(inner, signal), command


def _listed(values: Any) -> Any:
    return values if isinstance(values, (list, tuple)) or hasattr(values, "shape") else np.asarray(values, dtype=float)


def _relative(measurement: State, position: Scalar) -> State:
    return dataclasses.replace(measurement, x=measurement.x - position)
