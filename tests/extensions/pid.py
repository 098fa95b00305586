"""A PID controller of the pole's angle, with back-calculation against windup."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

import cpjax
from cpjax.pytree import Scalar, number, pytree


class Memory(NamedTuple):
    integral: jax.Array
    before: jax.Array


@pytree
class PID:
    """u = P e + I integral + D (e - e_before) / T, clipped; the integral is corrected by what the clip took."""

    proportional: Scalar = number("V/rad", "P")
    integral: Scalar = number("V/(rad s)", "I")
    derivative: Scalar = number("V s/rad", "D")
    tracking: Scalar = number("s", "time constant of the correction", above=0.0)
    limit: Scalar = number("V", "of the firmware's clip", above=0.0)
    period: Scalar = number("s", "control period", above=0.0)

    def init(self, measurement):
        return Memory(0.0, measurement.theta)

    def update(self, memory, measurement):
        error = measurement.theta
        rate = (error - memory.before) / self.period
        wanted = self.proportional * error + self.integral * memory.integral + self.derivative * rate
        command = jnp.clip(wanted, -self.limit, self.limit)
        correction = (command - wanted) / self.tracking
        return Memory(memory.integral + self.period * (error + correction), error), command


def example():
    return PID(60.0, 20.0, 8.0, 0.2, 12.0, 0.002), cpjax.State(0.0, 0.0, 0.05, 0.0)
