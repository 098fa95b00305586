"""Sine and cosine of one angle, computed together.

A simulator needs both functions of one angle at every stage. XLA's CPU backend evaluates each by a long, separate
routine that it does not vectorise well; one shared range reduction and two short polynomials cost a fraction of that.
"""

import math
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jax import lax

from cpjax.backend.single_kernel import outline
from cpjax.pytree import Scalar

# Range reduction of Cody and Waite: pi/2 in three parts, the first short enough for n * part to be exact.
# Polynomials on [-pi/4, pi/4]: coefficients for float64 from fdlibm (k_sin.c, k_cos.c: Copyright (C) 1993 by Sun
# Microsystems, Inc. All rights reserved. Permission to use, copy, modify, and distribute this software is freely
# granted, provided that this notice is preserved), for float32 from Cephes (sinf.c, S. Moshier).
_HALF_PI_64 = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_SIN_64 = (
    -1.66666666666666324348e-01,
    8.33333333332248946124e-03,
    -1.98412698298579493134e-04,
    2.75573137070700676789e-06,
    -2.50507602534068634195e-08,
    1.58969099521155010221e-10,
)
_COS_64 = (
    4.16666666666666019037e-02,
    -1.38888888888741095749e-03,
    2.48015872894767294178e-05,
    -2.75573143513906633035e-07,
    2.08757232129817482790e-09,
    -1.13596475577881948265e-11,
)
_HALF_PI_32 = (1.5703125, 4.837512969970703125e-4, 7.54978995489188216e-8)
_SIN_32 = (-1.6666654611e-1, 8.3321608736e-3, -1.9515295891e-4)
_COS_32 = (4.166664568298827e-2, -1.388731625493765e-3, 2.443315711809948e-5)


_Pair: TypeAlias = tuple[jax.Array, jax.Array]


def sin_cos(angle: Scalar) -> tuple[jax.Array, jax.Array]:
    """Computes sine and cosine of `angle`, accurate to 2 ulp of 1 for |angle| <= 1e4.

    The derivative rule is the exact one (cos, -sin), not that of the polynomials.

    Args:
      angle: [rad], any shape, float32 or float64.

    Returns:
      Sine and cosine, of the shape of `angle`.
    """
    angle = jnp.asarray(angle)
    angle = angle.astype(jnp.result_type(angle, float)) if not jnp.issubdtype(angle.dtype, jnp.floating) else angle
    sin, cos = _compiled(angle)
    return sin, cos


@jax.custom_jvp
def _sin_cos(angle: jax.Array) -> _Pair:
    s, c, quadrant = outline(_reduced)(angle)
    odd = (quadrant & 1) == 1
    sin, cos = lax.select(odd, c, s), lax.select(odd, s, c)
    return lax.select(quadrant >= 2, -sin, sin), lax.select((quadrant == 1) | (quadrant == 2), -cos, cos)


def _reduced(angle: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Computes sine and cosine of the remainder of the angle to quarter turns, and the number of these modulo 4."""
    wide = angle.dtype == jnp.float64
    half_pi, sin_terms, cos_terms = (_HALF_PI_64, _SIN_64, _COS_64) if wide else (_HALF_PI_32, _SIN_32, _COS_32)
    turns = lax.round(angle * (2.0 / math.pi), lax.RoundingMethod.TO_NEAREST_EVEN)
    r = ((angle - turns * half_pi[0]) - turns * half_pi[1]) - turns * half_pi[2]
    z = r * r
    s = r + r * z * _horner(z, sin_terms)
    c = 1.0 - (0.5 * z - z * z * _horner(z, cos_terms))
    quadrant = turns.astype(jnp.int32) & 3
    return s, c, quadrant


@_sin_cos.defjvp
def _sin_cos_jvp(primals: tuple[Scalar], tangents: tuple[jax.Array]) -> tuple[_Pair, _Pair]:
    (angle,), (tangent,) = primals, tangents
    sin, cos = _compiled(angle)
    return (sin, cos), (cos * tangent, -sin * tangent)


# JAX traces it once, so that two calls on one angle are seen to be equal: see `sim/invariants.py`.
_compiled = jax.jit(_sin_cos)


LARGEST_TURN = 0.1
"""Largest |angle| for which `rotate_by` is accurate [rad]."""


def rotate_by(sin: jax.Array, cos: jax.Array, angle: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Computes sine and cosine of an angle increased by `angle`, from its sine and cosine before.

    Accurate to 2 ulp of 1 for |angle| <= LARGEST_TURN, and cheaper than `sin_cos`: no range reduction, short series.

    Args:
      sin, cos: sine and cosine of the angle before, any shape.
      angle: the increase [rad], of the same shape.
    """
    z = angle * angle
    wide = angle.dtype == jnp.float64
    s = angle + angle * z * _horner(z, (-1 / 6, 1 / 120, -1 / 5040, 1 / 362880) if wide else (-1 / 6, 1 / 120))
    c = z * _horner(z, (-1 / 2, 1 / 24, -1 / 720, 1 / 40320) if wide else (-1 / 2, 1 / 24))  # cos - 1
    return sin + (sin * c + cos * s), cos + (cos * c - sin * s)


def _horner(z: jax.Array, coefficients: tuple[float, ...]) -> jax.Array:
    """Evaluates c0 + c1 z + c2 z^2 + ..."""
    value = jnp.full_like(z, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        value = value * z + c
    return value
