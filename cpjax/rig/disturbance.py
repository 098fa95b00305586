"""Disturbances: forces on cart and pole that no command causes.

All act along the rail. A force on the pole acts at its centre of mass, at x - l sin(theta), so that its part in the
pole's equation of motion is -l cos(theta) times the force. A random one is a function of the rollout's seed, the run's
number and time alone, so that no chunk, device or resumed run changes it.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cpjax.errors import InputError
from cpjax.numeric.noise import Word, random_bits, standard_normals
from cpjax.numeric.selection import where
from cpjax.plant import AccelerationActuator
from cpjax.pytree import JaxOrNumpy, Scalar, is_traced, matrix, number, pytree

_PUSH, _WIND = np.uint32(2), np.uint32(3)
"""Second words of the noise's keys; the sensors have 1, the drive 4."""


class Forces(NamedTuple):
    """Forces along the rail [N]."""

    cart: Scalar
    pole: Scalar


@pytree
class Pushes:
    """Pushes of constant force at given times."""

    times: Float[JaxOrNumpy, "*batch pushes"] = matrix((None,), "s", "beginnings of the pushes")
    cart: Float[JaxOrNumpy, "*batch pushes"] = matrix((None,), "N", "force on the cart, one for each push")
    pole: Float[JaxOrNumpy, "*batch pushes"] = matrix((None,), "N", "force on the pole, one for each push")
    duration: Scalar = number("s", "length of each push", default=0.05, above=0.0)

    def __post_init__(self) -> None:
        for name in ("cart", "pole"):
            if np.shape(getattr(self, name)) != np.shape(self.times):
                allowed = f"as many as there are times, {np.shape(self.times)[-1]}"
                raise InputError(f"Pushes.{name}", f"array of shape {np.shape(getattr(self, name))}", allowed)

    def forces(self, time: Float[Array, ""], dt: Scalar, key: Word, run: Word) -> Forces:
        """Returns the mean forces over a step of `dt` that begins at a time [s]."""
        acts = _share(time, dt, jnp.asarray(self.times), self.duration)
        return Forces(jnp.sum(acts * jnp.asarray(self.cart)), jnp.sum(acts * jnp.asarray(self.pole)))


@pytree
class RandomPushes:
    """One push in each interval of `every` seconds, at a random time in it, to the left or to the right."""

    every: Scalar = number("s", "length of the intervals", default=4.0, above=0.0)
    cart: Scalar = number("N", "magnitude of the force on the cart", default=0.0, at_least=0.0)
    pole: Scalar = number("N", "magnitude of the force on the pole", default=0.0, at_least=0.0)
    duration: Scalar = number("s", "length of each push", default=0.05, above=0.0)
    until: Scalar = number("s", "no push after this time", default=math.inf, above=0.0, infinite=True)

    def __post_init__(self) -> None:
        known = not any(is_traced(value) or np.ndim(value) for value in (self.every, self.duration))
        if known and not float(self.duration) < float(self.every):
            raise InputError("RandomPushes.duration", self.duration, "below the interval, `every`")

    def forces(self, time: Float[Array, ""], dt: Scalar, key: Word, run: Word) -> Forces:
        """Returns the mean forces over a step of `dt` that begins at a time [s]."""
        interval = jnp.floor((time + 0.5 * dt) / self.every)
        a, b = random_bits((key, jnp.asarray(_PUSH)), (run, interval.astype(jnp.uint32)))
        share = (a >> np.uint32(8)).astype(jnp.int32).astype(time.dtype) * 2.0**-24
        begin = interval * self.every + share * (self.every - self.duration)
        acts = where(time < self.until, _share(time, dt, begin, self.duration), 0.0)
        side_of_cart = 1.0 - 2.0 * (b & np.uint32(1)).astype(jnp.int32).astype(time.dtype)
        side_of_pole = 1.0 - 2.0 * ((b >> np.uint32(1)) & np.uint32(1)).astype(jnp.int32).astype(time.dtype)
        return Forces(acts * side_of_cart * self.cart, acts * side_of_pole * self.pole)


def _share(time: Float[Array, ""], dt: Scalar, begin: Any, duration: Scalar) -> Float[Array, "..."]:
    """Returns the share of the step from `time` to `time + dt` that lies in a push, so that its impulse is exact.

    Args:
      time, dt: of the step [s].
      begin, duration: of the push [s].
    """
    ahead = begin - time
    lies = jnp.minimum(dt, ahead + duration) - jnp.maximum(0.0, ahead)
    return jnp.maximum(lies, 0.0) / dt


@pytree
class Wind:
    """A force on the pole that wanders: normal, with a standard deviation and a correlation time.

    It is white noise, one number every `correlation_time`, interpolated in between and scaled to a constant variance.
    """

    force: Scalar = number("N", "standard deviation of the force on the pole", at_least=0.0)
    correlation_time: Scalar = number("s", "beyond twice this it is uncorrelated", default=0.5, above=0.0)

    def at(self, time: Float[Array, ""], dt: Scalar, key: Word, run: Word) -> Forces:
        """Returns the forces in a step of `dt` that begins at a time [s]."""
        distance = jnp.maximum(self.correlation_time, dt)  # below one step the force differs from step to step anyway
        knot = jnp.floor(time / distance)
        share = time / distance - knot
        count = knot.astype(jnp.uint32)
        keys = (key, jnp.asarray(_WIND))
        before, _ = standard_normals(keys, (run, count), np.dtype(time.dtype))
        after, _ = standard_normals(keys, (run, count + np.uint32(1)), np.dtype(time.dtype))
        scale = 1.0 / jnp.sqrt((1.0 - share) ** 2 + share**2)
        force = self.force * scale * ((1.0 - share) * before + share * after)
        return Forces(jnp.zeros_like(force), force)


@pytree
class Disturbance:
    """Everything that disturbs a rig: a tilted rail, pushes and wind."""

    tilt: Scalar = number(
        "rad", "slope of the rail: positive falls towards positive x", default=0.0, at_least=-0.5, at_most=0.5
    )
    pushes: Pushes | RandomPushes | None = None
    wind: Wind | None = None

    def __post_init__(self) -> None:
        for name, kinds in (("pushes", (Pushes, RandomPushes)), ("wind", (Wind,))):
            value = getattr(self, name)
            if value is not None and not isinstance(value, kinds):
                allowed = "None, or a cpjax." + " or ".join(kind.__name__ for kind in kinds)
                raise InputError(f"Disturbance.{name}", value, allowed)

    @property
    def changes(self) -> bool:
        """Whether any of it changes with time."""
        return self.pushes is not None or self.wind is not None

    def forces(self, time: Float[Array, ""], dt: Scalar, key: Word, run: Word) -> Forces:
        """Returns the forces of pushes and wind in a step.

        Args:
          time: of its beginning, since the start [s].
          dt: its length [s].
          key: seed of the rollout, uint32.
          run: number of the run, uint32.
        """
        zero = jnp.zeros_like(time)
        found = [Forces(zero, zero)]
        if self.pushes is not None:
            found.append(self.pushes.forces(time, dt, key, run))
        if self.wind is not None:
            found.append(self.wind.at(time, dt, key, run))
        return Forces(sum(f.cart for f in found), sum(f.pole for f in found))


def added_loads(plant: Any, tilt: Scalar, geometry: tuple[Scalar, Scalar], forces: Forces) -> tuple[Scalar, Scalar]:
    """Returns what a tilted rail and forces add to the right-hand sides of a cart-pole: force [N], torque [N m].

    With the rail falling towards positive x by the angle a, gravity has the parts g sin(a) along the rail and g cos(a)
    across it; theta is measured from the rail's normal. The rotor has no weight.

    Args:
      plant: the `CartPole`.
      tilt: of the rail [rad].
      geometry: sine and cosine of theta.
      forces: along the rail.
    """
    sin, cos = geometry
    weight = plant.pole_mass * plant.gravity * plant.pole_length
    along, lost = jnp.sin(tilt), jnp.cos(tilt) - 1.0
    push = (plant.cart_mass + plant.pole_mass) * plant.gravity * along + forces.cart + forces.pole
    if isinstance(plant.motor, AccelerationActuator):  # its cart follows the command under any force
        push = 0.0 * push
    torque = weight * (lost * sin - along * cos) - plant.pole_length * cos * forces.pole
    return push, torque
