"""Sensors: what the firmware measures of the plant's state."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cpjax.numeric.noise import Word, standard_normals
from cpjax.numeric.quantisation import quantize
from cpjax.plant.state import State
from cpjax.pytree import Scalar, is_traced, number, pytree


class Position(NamedTuple):
    """Measured positions."""

    x: Float[Array, ""]
    """Cart position [m]."""
    theta: Float[Array, ""]
    """Angle of the pole from upright [rad], not wrapped."""


@pytree
class Encoders:
    """Incremental encoders of cart and pole: step * round((value + noise) / step), of x and theta only.

    The derivative is straight through: that of the mean, if the position between two steps is as good as random.
    """

    x_step: Scalar = number("m", "cart travel per count", above=0.0)
    theta_step: Scalar = number("rad", "angle per count", above=0.0)
    x_noise: Scalar = number("m", "standard deviation of the noise on x before rounding", default=0.0, at_least=0.0)
    theta_noise: Scalar = number(
        "rad", "standard deviation of the noise on theta before rounding", default=0.0, at_least=0.0
    )
    theta_offset: Scalar = number("rad", "error of the angle's zero, added before rounding", default=0.0)

    @property
    def noisy(self) -> bool:
        """Whether the noise is not known to be zero."""
        return any(is_traced(noise) or bool(np.any(np.asarray(noise))) for noise in (self.x_noise, self.theta_noise))

    def measure(
        self, state: State, key: tuple[Word, Word], counter: tuple[Word, Word], *, noisy: bool = True
    ) -> Position:
        """Returns the measurement of a state.

        Args:
          state: the plant's state.
          key: of the noise.
          counter: numbers of the run and of the control instant, which select the noise.
          noisy: whether noise is drawn at all.
        """
        x, theta = state.x, state.theta + self.theta_offset
        if noisy:
            of_x, of_theta = standard_normals(key, counter, jnp.asarray(state.x).dtype)
            x, theta = x + self.x_noise * of_x, theta + self.theta_noise * of_theta
        return Position(
            quantize(x, self.x_step, derivative="straight_through"),
            quantize(theta, self.theta_step, derivative="straight_through"),
        )
