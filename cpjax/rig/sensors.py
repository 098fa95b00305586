"""Sensors: what the firmware measures of the plant's state."""

import math
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cpjax.numeric.angles import wrap_angle
from cpjax.numeric.noise import Word, standard_normals
from cpjax.numeric.quantisation import quantize
from cpjax.numeric.selection import where
from cpjax.plant.state import State
from cpjax.pytree import Scalar, is_traced, number, pytree

_RATES = np.uint32(1 << 16)
"""Added to the second word of the key for the noise of the rates."""


class Position(NamedTuple):
    """Measured positions."""

    x: Float[Array, ""]
    """Cart position [m]."""
    theta: Float[Array, ""]
    """Angle of the pole from upright [rad], not wrapped."""


@pytree
class StateSensors:
    """Sensors of the whole state with white noise: positions, and rates as by a tachometer and a gyroscope."""

    x_noise: Scalar = number("m", "standard deviation of the noise on x", default=0.0, at_least=0.0)
    x_dot_noise: Scalar = number("m/s", "standard deviation of the noise on x'", default=0.0, at_least=0.0)
    theta_noise: Scalar = number("rad", "standard deviation of the noise on theta", default=0.0, at_least=0.0)
    theta_dot_noise: Scalar = number("rad/s", "standard deviation of the noise on theta'", default=0.0, at_least=0.0)
    theta_offset: Scalar = number("rad", "error of the angle's zero", default=0.0)

    @property
    def noisy(self) -> bool:
        """Whether the noise is not known to be zero."""
        return _any_noise(self.x_noise, self.x_dot_noise, self.theta_noise, self.theta_dot_noise)

    def measure(self, state: State, key: tuple[Word, Word], counter: tuple[Word, Word], *, noisy: bool = True) -> State:
        """Returns the measurement of a state; arguments as of `Encoders.measure`."""
        theta = state.theta + self.theta_offset
        if not noisy:
            return State(state.x, state.x_dot, theta, state.theta_dot)
        dtype = jnp.asarray(state.x).dtype
        of_x, of_theta = standard_normals(key, counter, dtype)
        of_x_dot, of_theta_dot = standard_normals((key[0], key[1] + _RATES), counter, dtype)
        return State(
            state.x + self.x_noise * of_x,
            state.x_dot + self.x_dot_noise * of_x_dot,
            theta + self.theta_noise * of_theta,
            state.theta_dot + self.theta_dot_noise * of_theta_dot,
        )


@pytree
class Potentiometers:
    """Potentiometers of cart and pole: positions with white noise, and an angle at which the pole's reads nothing.

    Within `dead_angle` about `dead_centre` its wiper is off the track, and the reading stays at the nearer end.
    """

    x_noise: Scalar = number("m", "standard deviation of the noise on x", default=0.0, at_least=0.0)
    theta_noise: Scalar = number("rad", "standard deviation of the noise on theta", default=0.0, at_least=0.0)
    theta_offset: Scalar = number("rad", "error of the angle's zero", default=0.0)
    dead_angle: Scalar = number("rad", "width of the gap in the track", default=0.0, at_least=0.0, below=math.pi)
    dead_centre: Scalar = number("rad", "angle of the gap's middle", default=0.5 * math.pi)

    @property
    def noisy(self) -> bool:
        """Whether the noise is not known to be zero."""
        return _any_noise(self.x_noise, self.theta_noise)

    def measure(
        self, state: State, key: tuple[Word, Word], counter: tuple[Word, Word], *, noisy: bool = True
    ) -> Position:
        """Returns the measurement of a state; arguments as of `Encoders.measure`."""
        from_gap = wrap_angle(state.theta - self.dead_centre)
        end = where(from_gap < 0.0, -0.5, 0.5) * self.dead_angle
        in_gap = jnp.abs(from_gap) < 0.5 * self.dead_angle
        x, theta = state.x, state.theta + where(in_gap, end - from_gap, 0.0) + self.theta_offset
        if noisy:
            of_x, of_theta = standard_normals(key, counter, jnp.asarray(state.x).dtype)
            x, theta = x + self.x_noise * of_x, theta + self.theta_noise * of_theta
        return Position(jnp.asarray(x), jnp.asarray(theta))


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
        return _any_noise(self.x_noise, self.theta_noise)

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


Sensors: TypeAlias = Encoders | Potentiometers | StateSensors
"""Classes of sensors that a rig may have."""


def _any_noise(*deviations: Scalar) -> bool:
    return any(is_traced(noise) or bool(np.any(np.asarray(noise))) for noise in deviations)
