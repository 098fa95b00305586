"""State of cart and pendulum, and its conventions.

The order is x, x_dot, theta, theta_dot. theta = 0 is upright, theta = pi hangs down, and positive theta leans towards
negative x: the pole's centre of mass is at (x - l sin(theta), l cos(theta)). Angles are in rad, all else in SI units.
theta is not wrapped during a simulation; functions that use it modulo a turn say so.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from cpjax.numeric.angles import wrap_angle
from cpjax.pytree import Number, Scalars, pytree

NAMES = ("x", "x_dot", "theta", "theta_dot")
UNITS = ("m", "m/s", "rad", "rad/s")


@pytree
class State:
    """State as four named scalars. Under `vmap` each becomes an array of its own, the layout suited to vector hardware.

    The class also holds time derivatives, references and tangents. It is therefore not checked when constructed;
    `rollout` and `sweep` check the initial states that they are given.

    Attributes:
      x: cart position [m].
      x_dot: cart velocity [m/s].
      theta: pole angle from upright [rad].
      theta_dot: pole angular velocity [rad/s].
    """

    x: Scalars
    x_dot: Scalars
    theta: Scalars
    theta_dot: Scalars

    def vector(self) -> Float[Array, "*batch 4"]:
        """Returns the state as an array in the order of `NAMES`."""
        return jnp.stack([jnp.asarray(getattr(self, name)) for name in NAMES], axis=-1)

    @classmethod
    def from_vector(cls, vector: Float[Array, "*batch 4"]) -> "State":
        """Builds a state from the last axis of an array, in the order of `NAMES`."""
        return cls(*(vector[..., i] for i in range(4)))


def deviation(state: State, reference: State) -> tuple[Scalars, Scalars, Scalars, Scalars]:
    """Returns `state` minus `reference` in the order of `NAMES`, with the angle difference wrapped to [-pi, pi].

    Args:
      state, reference: either may be a batch of states.
    """
    return (
        state.x - reference.x,
        state.x_dot - reference.x_dot,
        wrap_angle(state.theta - reference.theta),
        state.theta_dot - reference.theta_dot,
    )


def checked_reference(field: str, reference: State) -> State:
    """Returns a State that is a parameter of a controller, with each component checked like a declared number.

    Args:
      field: name of the parameter in error messages.
      reference: the parameter.

    Raises:
      InputError: a component that is not a finite number.
    """
    components = zip(NAMES, UNITS, strict=True)
    return State(*(Number(unit, n).normalise(f"{field}.{n}", getattr(reference, n)) for n, unit in components))


UPRIGHT = State(0.0, 0.0, 0.0, 0.0)
"""Upright at rest in the middle of the track."""

HANGING = State(0.0, 0.0, math.pi, 0.0)
"""Hanging at rest in the middle of the track."""


RUNAWAY_LIMIT = 1e3
"""Bound on |x| [m], |x_dot| [m/s] and |theta_dot| [rad/s], far beyond what 12 V can reach in the protocol's 20 s."""

ANGLE_LIMIT = 1e5
"""Bound on |theta| [rad], up to which its sine and cosine are meaningful in float32."""
