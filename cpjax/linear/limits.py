"""Saturation and switching-region limits of a linear design.

Inside the clip and the gate the loop is s' = A_K s to first order, and s' P s falls along it. The largest level set
{s' P s <= level} that stays inside both is invariant: the linearised loop, once in it, never leaves it. This holds for
the linear model; for the plant itself it is a guide, to be checked by rollouts.

Every level requires a positive definite P, of which only the symmetric part counts; under jit, another P gives NaN.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Real

from cpjax.errors import InputError
from cpjax.linear.arguments import MatrixLike, columns, gain_matrix, matrices, shaped, square
from cpjax.linear.lyapunov import lyapunov
from cpjax.numeric.selection import where
from cpjax.numeric.small_matrices import is_positive_definite, linear_solve
from cpjax.pytree import JaxOrNumpy, Number, Scalar, is_traced

_THETA = 2  # index of the angle in the state
_RATE = 3


def demanded_voltage(
    K: Real[MatrixLike, "1 4"] | Real[MatrixLike, "4"], angle: Real[JaxOrNumpy, "*angles"] | float
) -> Float[Array, "*angles"]:
    """Returns |u| [V] that a gain demands with the pole at `angle` from upright and all other states 0.

    Args:
      K: gain [V per unit of state].
      angle: from upright [rad].

    Raises:
      InputError: K has another shape or is not finite.
    """
    (K,) = matrices(K=K)
    K = gain_matrix("K", K, 1, 4)
    return jnp.abs(K[0, _THETA] * jnp.asarray(angle, dtype=K.dtype))


def saturation_angle(K: Real[MatrixLike, "1 4"] | Real[MatrixLike, "4"], voltage_limit: Scalar) -> Float[Array, ""]:
    """Returns the angle [rad] from upright beyond which a gain demands more than the limit, all other states being 0.

    Infinite for a gain that ignores the angle.

    Args:
      K: gain [V per unit of state].
      voltage_limit: above 0, may be infinite [V].

    Raises:
      InputError: K has another shape or is not finite, or a limit that is not above 0.
    """
    (K,) = matrices(K=K)
    K = gain_matrix("K", K, 1, 4)
    return _limit("voltage_limit", "V", voltage_limit, K, infinite=True) / jnp.abs(K[0, _THETA])


def lyapunov_function(
    A: Real[MatrixLike, "n n"],
    B: Real[MatrixLike, "n m"] | Real[MatrixLike, " n"],
    K: Real[MatrixLike, "m n"] | Real[MatrixLike, " n"],
    Q: Real[MatrixLike, "n n"],
) -> Float[Array, "n n"]:
    """Returns P for which d/dt s' P s = -s' Q s under s' = (A - B K) s.

    Args:
      A: state matrix.
      B: input matrix; a vector for one input.
      K: gain; a vector for one input.
      Q: rate at which s' P s falls, as a quadratic form.

    Raises:
      InputError: shapes that do not fit, or a concrete closed loop that is not stable. Under jit P is NaN instead.
    """
    A, B, K, Q = matrices(A=A, B=B, K=K, Q=Q)
    n = square("A", A)
    B = columns("B", B, n)
    K = gain_matrix("K", K, B.shape[1], n)
    return lyapunov(A - B @ K, Q)


def level_within_voltage(
    P: Real[MatrixLike, "n n"], K: Real[MatrixLike, "1 n"] | Real[MatrixLike, " n"], voltage_limit: Scalar
) -> Float[Array, ""]:
    """Returns the largest level for which |K s| stays within `voltage_limit` wherever s' P s is at most that level.

    Args:
      P: symmetric, positive definite.
      K: gain [V per unit of state].
      voltage_limit: above 0, may be infinite [V].

    Raises:
      InputError: shapes that do not fit, a concrete P that is not positive definite, or a limit that is not above 0.
    """
    P, K = matrices(P=P, K=K)
    P = _positive_definite("P", P)
    K = gain_matrix("K", K, 1, square("P", P))
    limit = _limit("voltage_limit", "V", voltage_limit, P, infinite=True)
    return limit * limit / (K @ linear_solve(P, K.T))[0, 0]


def level_within_angle(P: Real[MatrixLike, "4 4"], half_angle: Scalar) -> Float[Array, ""]:
    """Returns the largest level for which |theta| stays within `half_angle`, the region of an AngleGate.

    Args:
      P: symmetric, positive definite.
      half_angle: above 0, at most pi [rad].

    Raises:
      InputError: see `level_within_voltage`; or an angle beyond pi.
    """
    (P,) = matrices(P=P)
    P = _positive_definite("P", P, 4)
    edge = _limit("half_angle", "rad", half_angle, P, at_most=math.pi)
    return edge * edge / _spread(P, (_THETA,))[0, 0]


def level_within_angle_and_rate(P: Real[MatrixLike, "4 4"], half_angle: Scalar, rate: Scalar) -> Float[Array, ""]:
    """Returns the largest level inside an AngleRateGate.

    The gate is (1 - cos theta) / (1 - cos half_angle) + (theta' / rate)^2 <= 1.

    Args:
      P: symmetric, positive definite.
      half_angle: above 0, at most pi [rad].
      rate: above 0 [rad/s].

    Raises:
      InputError: see `level_within_angle`.
    """
    (P,) = matrices(P=P)
    P = _positive_definite("P", P, 4)
    half_angle = _limit("half_angle", "rad", half_angle, P, at_most=math.pi)
    rate = _limit("rate", "rad/s", rate, P)
    return _touching_level(_spread(P, (_THETA, _RATE)), half_angle, rate)


@jax.jit
def _touching_level(shadow: jax.Array, half_angle: jax.Array, rate: jax.Array) -> jax.Array:
    """Returns the level at which the level set's projection on angle and rate (2, 2) touches the gate's boundary."""
    gate = jnp.linalg.inv(shadow), half_angle, rate
    fixed = lax.stop_gradient(gate)  # only searches: the last lines give the level its first and second derivative
    # Positions are angles in a plane scaled so that the projection is about as wide as it is high: however different
    # angle and rate are in size, the level then does not vary within a small part of a turn only.
    ratio = half_angle * jnp.sqrt(shadow[1, 1]) / (rate * jnp.sqrt(shadow[0, 0]))

    def level(position: jax.Array, form: jax.Array, half_angle: jax.Array, rate: jax.Array) -> jax.Array:
        """Returns the level at a point of the boundary; `position` from 0 to pi covers half of it."""
        sin, cos = jnp.sin(position), ratio * jnp.cos(position)
        length = jnp.hypot(sin, cos)
        sin, cos = sin / length, cos / length
        half_edge, half_cos = jnp.sin(0.5 * half_angle), jnp.cos(0.5 * half_angle)
        angle = 2.0 * jnp.arctan2(half_edge * sin, jnp.hypot(half_cos, half_edge * cos))
        point = jnp.stack([angle, rate * cos])
        return point @ form @ point

    def narrowed(_: jax.Array, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        middle, width = carry
        positions = middle + width * jnp.linspace(-1.0, 1.0, 129, dtype=shadow.dtype)
        return positions[jnp.argmin(jax.vmap(lambda position: level(position, *fixed))(positions))], width / 64.0

    # The projection touches the boundary where the level is smallest. A search on successively finer grids also handles
    # the corner that the boundary has for a half angle near pi.
    quarter = jnp.asarray(0.5 * math.pi, dtype=shadow.dtype)
    position, _ = lax.fori_loop(0, 5, narrowed, (quarter, quarter))
    # By the envelope theorem the minimum's first derivative is that at a fixed position. For the second derivative the
    # position moves by a step of Newton's method; where the level is the same everywhere, it stays.
    slope = jax.grad(level)
    bend = jax.grad(slope)(position, *fixed)
    step = slope(position, *gate) / where(bend > 0.0, bend, 1.0)
    return level(position - where(bend > 0.0, step, 0.0), *gate)


def level_within_form(P: Real[MatrixLike, "n n"], other: Real[MatrixLike, "n n"], level: Scalar) -> Float[Array, ""]:
    """Returns the largest level of P for which s' `other` s stays within `level`, as in another P's LyapunovGate.

    Infinite where s' `other` s is nowhere positive.

    Args:
      P: symmetric, positive definite.
      other: symmetric.
      level: above 0 [1].

    Raises:
      InputError: see `level_within_voltage`.
    """
    P, other = matrices(P=P, other=other)
    P = _positive_definite("P", P)
    shaped("other", other, P.shape)
    level = _limit("level", "1", level, P)
    root = jnp.linalg.cholesky(P)
    ratio = linear_solve(root, linear_solve(root, other).T)
    return level / jnp.maximum(jnp.linalg.eigvalsh(0.5 * (ratio + ratio.T))[-1], 0.0)


def _spread(P: jax.Array, chosen: tuple[int, ...]) -> jax.Array:
    """Returns the block of P^-1 whose inverse is the form of the level set's projection on the chosen coordinates."""
    columns = jnp.eye(P.shape[0], dtype=P.dtype)[:, jnp.asarray(chosen)]
    return columns.T @ linear_solve(P, columns)


_is_positive_definite = jax.jit(is_positive_definite)


def _positive_definite(name: str, P: jax.Array, size: int | None = None) -> jax.Array:
    """Returns the symmetric part of a positive definite matrix; NaN for any other matrix that is traced."""
    n = square(name, P)
    shaped(name, P, (size or n,) * 2)
    P = 0.5 * (P + P.T)
    definite = _is_positive_definite(P)
    if not is_traced(definite) and not definite:
        raise InputError(name, P, "positive definite, by a margin that rounding leaves visible")
    return where(definite, P, jnp.nan)


def _limit(name: str, unit: str, value: Scalar, like: jax.Array, **ends: Any) -> jax.Array:
    """Returns a scalar limit above zero, in the dtype of `like`."""
    limit = jnp.asarray(Number(unit, name, above=0.0, **ends).normalise(name, value), dtype=like.dtype)
    shaped(name, limit, ())
    return limit
