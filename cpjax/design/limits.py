"""What the voltage limit and the gate leave of a linear design: where it saturates, and a region where it cannot fail.

Inside the clip and the gate the loop is s' = A_K s to first order, and s' P s falls along it. The largest level set
{s' P s <= level} that stays inside both is one that the linearised loop, once in, never leaves. It says so of the
linear model; for the plant itself it is a guide, to be checked by rollouts.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from cpjax.design.arguments import MatrixLike, matrices, shaped, square
from cpjax.design.lyapunov import lyapunov
from cpjax.numeric.small_matrices import linear_solve
from cpjax.pytree import Number, Scalar

_THETA = 2  # where the angle stands in the state
_RATE = 3
_POINTS = 256


def demanded_voltage(K: MatrixLike, angle: Scalar) -> jax.Array:
    """|u| [V] that the gain K (1, 4) asks for at rest, cart in place, `angle` [rad] from upright."""
    (K,) = matrices(K=K)
    shaped("K", K, (1, 4))
    return jnp.abs(K[0, _THETA]) * jnp.asarray(angle, dtype=K.dtype)


def saturation_angle(K: MatrixLike, voltage_limit: Scalar) -> jax.Array:
    """Angle [rad] from upright beyond which, at rest and with the cart in place, the gain K (1, 4) asks for more than
    `voltage_limit` [V]; infinite for a gain that ignores the angle.
    """
    (K,) = matrices(K=K)
    shaped("K", K, (1, 4))
    limit = _above_zero("voltage_limit", "V", voltage_limit)
    return limit / jnp.abs(K[0, _THETA])


def lyapunov_function(A: MatrixLike, B: MatrixLike, K: MatrixLike, Q: MatrixLike) -> jax.Array:
    """P (n, n) for which d/dt s' P s = -s' Q s under s' = (A - B K) s.

    Raises:
      InputError: shapes that do not fit, or a concrete closed loop that is not stable. Under jit P is NaN instead.
    """
    A, B, K, Q = matrices(A=A, B=B, K=K, Q=Q)
    n = square("A", A)
    shaped("B", B, (n, B.shape[-1] if B.ndim == 2 else 1))
    shaped("K", K, (B.shape[1], n))
    return lyapunov(A - B @ K, Q)


def level_within_voltage(P: MatrixLike, K: MatrixLike, voltage_limit: Scalar) -> jax.Array:
    """The largest level at which |K s| stays within `voltage_limit` [V] wherever s' P s is at most that level."""
    P, K = matrices(P=P, K=K)
    shaped("K", K, (1, square("P", P)))
    limit = _above_zero("voltage_limit", "V", voltage_limit)
    return limit * limit / (K @ linear_solve(P, K.T))[0, 0]


def level_within_angle(P: MatrixLike, half_angle: Scalar) -> jax.Array:
    """The largest level at which |theta| stays within `half_angle` [rad]: inside an AngleGate."""
    (P,) = matrices(P=P)
    shaped("P", P, (4, 4))
    edge = _above_zero("half_angle", "rad", half_angle)
    return edge * edge / _spread(P, (_THETA,))[0, 0]


def level_within_angle_and_rate(P: MatrixLike, half_angle: Scalar, rate: Scalar) -> jax.Array:
    """The largest level inside an AngleRateGate: (1 - cos theta) / (1 - cos half_angle) + (theta' / rate)^2 <= 1."""
    (P,) = matrices(P=P)
    shaped("P", P, (4, 4))
    half_angle = _above_zero("half_angle", "rad", half_angle)
    rate = _above_zero("rate", "rad/s", rate)
    shadow = _spread(P, (_THETA, _RATE))

    def level(position: jax.Array) -> jax.Array:
        """At a point of the gate's boundary, half of which is passed as `position` goes from 0 to pi."""
        angle = 2.0 * jnp.arcsin(jnp.sin(0.5 * half_angle) * jnp.sin(position))
        point = jnp.stack([angle, rate * jnp.cos(position)])
        return point @ linear_solve(shadow, point[:, None])[:, 0]

    # The level set's shadow touches the boundary where the level is smallest. There, by the envelope theorem, the
    # minimum's derivative is that at a fixed position.
    positions = jnp.linspace(0.0, math.pi, _POINTS, endpoint=False, dtype=P.dtype)
    position = positions[jnp.argmin(jax.vmap(level)(positions))]
    slope, curvature = jax.grad(level), jax.grad(jax.grad(level))
    for _ in range(4):
        step = slope(position) / curvature(position)
        position = position - jnp.clip(jnp.nan_to_num(step), -math.pi / _POINTS, math.pi / _POINTS)
    return level(lax.stop_gradient(position))


def level_within_form(P: MatrixLike, other: MatrixLike, level: Scalar) -> jax.Array:
    """The largest level at which s' `other` s stays within `level`: inside a LyapunovGate of another P."""
    P, other = matrices(P=P, other=other)
    n = square("P", P)
    shaped("other", other, (n, n))
    level = _above_zero("level", "1", level)
    root = jnp.linalg.cholesky(P)
    ratio = linear_solve(root, linear_solve(root, other).T)
    return level / jnp.linalg.eigvalsh(0.5 * (ratio + ratio.T))[-1]


def _spread(P: jax.Array, chosen: tuple[int, ...]) -> jax.Array:
    """The block of P^-1 whose inverse is the quadratic form of the level set's shadow on the chosen coordinates."""
    columns = jnp.eye(P.shape[0], dtype=P.dtype)[:, jnp.asarray(chosen)]
    return columns.T @ linear_solve(P, columns)


def _above_zero(name: str, unit: str, value: Scalar) -> Any:
    return Number(unit, name, above=0.0).normalise(name, value)
