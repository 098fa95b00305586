"""The state of cart and pendulum, and every convention about it.

Order x, x_dot, theta, theta_dot. theta = 0 is upright, pi hangs down, and positive theta leans towards negative x: the
pole's centre of mass is at (x - l sin(theta), l cos(theta)). Angles in rad, all else in SI units. theta is not wrapped
while it evolves; whatever needs it modulo a turn says so.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cpjax.errors import InputError
from cpjax.numeric.trigonometry import wrap_angle
from cpjax.pytree import Number, Scalar, as_array, is_traced, pytree

NAMES = ("x", "x_dot", "theta", "theta_dot")
UNITS = ("m", "m/s", "rad", "rad/s")


@pytree
class State:
    """Four named scalars. Under `vmap` each becomes its own array, which is the layout that vector hardware wants.

    A State also carries what has its shape: a time derivative, a reference, a tangent. It is therefore not checked
    when constructed; `rollout` and `sweep` check the start they are given.

    Attributes:
      x: cart position [m].
      x_dot: cart velocity [m/s].
      theta: pole angle from upright [rad].
      theta_dot: pole angular velocity [rad/s].
    """

    x: Scalar
    x_dot: Scalar
    theta: Scalar
    theta_dot: Scalar

    def vector(self) -> jax.Array:
        """The state as an array (..., 4) in the order of `NAMES`."""
        return jnp.stack([jnp.asarray(getattr(self, name)) for name in NAMES], axis=-1)

    @classmethod
    def from_vector(cls, vector: jax.Array) -> "State":
        """The state held in the last axis of an array (..., 4)."""
        return cls(*(vector[..., i] for i in range(4)))


def within_bounds(state: State) -> jax.Array:
    """Whether no component is beyond `RUNAWAY_LIMIT`, or `ANGLE_LIMIT` for theta, or NaN."""
    small = (jnp.abs(state.x) <= RUNAWAY_LIMIT) & (jnp.abs(state.theta) <= ANGLE_LIMIT)
    return small & (jnp.abs(state.x_dot) <= RUNAWAY_LIMIT) & (jnp.abs(state.theta_dot) <= RUNAWAY_LIMIT)


def deviation(state: State, reference: State) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """`state` less `reference`, in the order of `NAMES`, with the angle's difference taken modulo a turn."""
    return (
        state.x - reference.x,
        state.x_dot - reference.x_dot,
        wrap_angle(state.theta - reference.theta),
        state.theta_dot - reference.theta_dot,
    )


def checked_reference(field: str, reference: State) -> State:
    """A State that is a component's parameter, checked as its other parameters are.

    Raises:
      InputError: a component that is not a finite number.
    """
    components = zip(NAMES, UNITS, strict=True)
    return State(*(Number(unit, n).normalise(f"{field}.{n}", getattr(reference, n)) for n, unit in components))


UPRIGHT = State(0.0, 0.0, 0.0, 0.0)
"""Balanced at rest in the middle of the track."""

HANGING = State(0.0, 0.0, math.pi, 0.0)
"""Hanging at rest in the middle of the track."""


RUNAWAY_LIMIT = 1e3
"""Bound on |x| [m], |x_dot| [m/s] and |theta_dot| [rad/s], far outside what 12 V can do in the protocol's 20 s."""

ANGLE_LIMIT = 1e5
"""Bound on |theta| [rad]; up to there sine and cosine of it mean something in float32."""

_LARGEST = {"x": RUNAWAY_LIMIT, "x_dot": RUNAWAY_LIMIT, "theta": ANGLE_LIMIT, "theta_dot": RUNAWAY_LIMIT}


def checked_start(start: Any, field: str, *, batched: bool) -> tuple[State, Any]:
    """`start` as a State of arrays of one dtype, and that dtype.

    Python numbers take the dtype of the arrays beside them, or JAX's default float if there are none.

    Raises:
      InputError: not a State; a component that is not real, not finite, of another dtype than the rest, or not of
        shape () (`batched=False`) or one common (n,) (`batched=True`).
    """
    if not isinstance(start, State):
        raise InputError(field, start, "a cpjax.State(x, x_dot, theta, theta_dot)")
    dtypes = {}
    for name, unit in zip(NAMES, UNITS, strict=True):
        value = getattr(start, name)
        path = f"{field}.{name}"
        if isinstance(value, bool) or not (isinstance(value, (int, float)) or hasattr(value, "dtype")):
            raise InputError(path, value, "a real number or an array of them")
        if isinstance(value, (int, float)):
            if not abs(value) <= _LARGEST[name]:
                raise InputError(path, value, f"finite, and within {_LARGEST[name]:g} {unit}")
        else:
            dtypes[name] = jnp.dtype(value.dtype) if is_traced(value) else jax.dtypes.canonicalize_dtype(value.dtype)
            if dtypes[name] not in (jnp.float32, jnp.float64):
                raise InputError(path, f"array of dtype {value.dtype}", "of dtype float32 or float64")
            if not is_traced(value) and not np.all(np.abs(np.asarray(value)) <= _LARGEST[name]):
                raise InputError(path, value, f"finite, and within {_LARGEST[name]:g} {unit}")
    if len(set(dtypes.values())) > 1:
        mixture = ", ".join(f"{name}: {dtype}" for name, dtype in dtypes.items())
        raise InputError(field, f"State with dtypes {mixture}", "of one dtype, float32 or float64, throughout")
    dtype = next(iter(dtypes.values()), jnp.result_type(float))
    values = [as_array(getattr(start, name), dtype) for name in NAMES]
    if batched:
        shapes = f"State of shapes {[v.shape for v in values]}"
        if max(v.ndim for v in values) > 1 or min(v.size for v in values) == 0:
            raise InputError(field, shapes, "arrays of one shape (n,), n at least 1")
        try:
            values = list(jnp.broadcast_arrays(*[jnp.atleast_1d(v) for v in values]))
        except ValueError as problem:
            raise InputError(field, shapes, "arrays of one shape (n,), n at least 1") from problem
    else:
        for name, value in zip(NAMES, values, strict=True):
            if value.ndim:
                allowed = "one number; many starts go through cpjax.sweep or jax.vmap"
                raise InputError(f"{field}.{name}", f"array of shape {value.shape}", allowed)
    return State(*values), dtype
