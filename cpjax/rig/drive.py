"""Drive: what stands between the firmware's command and the motor's terminals."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from cpjax.numeric.quantisation import quantize
from cpjax.numeric.selection import where
from cpjax.pytree import Scalar, number, pytree


@pytree
class Drive:
    """Imperfections of amplifier and motor, acting on the command after its clip.

    In this order: noise, the delay, the clip, the steps of the pulse width, the dead band, the lag.
    """

    delay: Scalar = number(
        "s", "a command takes effect so long after its measurement; a whole number of steps", default=0.0, at_least=0.0
    )
    dead_band: Scalar = number("V", "commands of at most this magnitude give 0 V", default=0.0, at_least=0.0)
    lag: Scalar | None = number(
        "s", "time constant of the voltage's first-order response", default=None, above=0.0, optional=True
    )
    voltage_step: Scalar | None = number(
        "V", "step of the pulse width modulation", default=None, above=0.0, optional=True
    )
    noise: Scalar = number(
        "V", "standard deviation of white noise on the command, once per control period", default=0.0, at_least=0.0
    )
    source_resistance: Scalar | None = number(
        "ohm",
        "resistance of battery and amplifier, by which the supply sags",
        default=None,
        at_least=0.0,
        optional=True,
    )

    def apply(self, voltage: Scalar) -> Scalar:
        """Returns the terminal voltage [V] for a clipped command [V]; its derivative is 0 inside the dead band."""
        if self.voltage_step is not None:
            voltage = quantize(voltage, self.voltage_step, derivative="straight_through")
        return where(jnp.abs(voltage) <= self.dead_band, 0.0 * voltage, voltage)


def line_of_decay(ratio: Scalar) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Returns value at 0 and slope of the line over [0, 1] with the mean and the first moment of exp(-ratio s).

    A decay that is fast against a step has its effect in it all the same: mean and first moment over the step are what
    velocity and position at its end depend on.
    """
    ratio = jnp.asarray(ratio)
    slow = ratio < 0.03  # the closed forms below cancel
    some = where(slow, 1.0, ratio)
    left = jnp.exp(-some)
    mean = -jnp.expm1(-some) / some
    slope = 12.0 * ((mean - left) / some - 0.5 * mean)
    first = terms = jnp.ones_like(ratio)
    for share in (1 / 7, 1 / 6, 1 / 5, 1 / 4, 1 / 3, 1 / 2):  # Taylor series
        first = 1.0 - ratio * share * first
    for share in (3 / 20, 5 / 28, 2 / 9, 3 / 10, 1 / 2):
        terms = 1.0 - ratio * share * terms
    mean = where(slow, first, mean)
    slope = where(slow, -ratio * terms, slope)
    return mean - 0.5 * slope, slope
