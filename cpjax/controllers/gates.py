"""Gates: where the regulator takes over, and where it lets go.

A gate is a function of the state, its margin: positive inside, zero on the boundary, negative outside, and smooth near
the boundary. With hysteresis the boundary that ends regulation is wider than the one that begins it: its size (angle
and rate, or the level of the quadratic form) is (1 + hysteresis) times as large. Angle gates are written in cos(theta),
so that theta = pi is no boundary; the Lyapunov gate's margin jumps there, but far below zero for any level of use.
"""

import math
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from cpjax.controllers.protocol import REGULATE
from cpjax.errors import InputError
from cpjax.numeric.trigonometry import sin_cos
from cpjax.pytree import Array, Scalar, is_traced, matrix, number, part, pytree
from cpjax.state import NAMES, UPRIGHT, State, checked_reference, deviation


class Gate(Protocol):
    """What `Hybrid` asks of a gate."""

    def margin(self, state: State, mode: jax.Array) -> Scalar:
        """Smooth in the state; at least 0 where the regulator acts, given the mode until now."""
        ...


@pytree
class AngleGate:
    """Open within `half_angle` of upright: margin = cos(theta) - cos(size)."""

    half_angle: Scalar = number("rad", "angle from upright", above=0.0, at_most=math.pi)
    hysteresis: Scalar = number("1", "relative widening of the way out", default=0.0, at_least=0.0)

    def __post_init__(self) -> None:
        _check_widened_angle("AngleGate", self.half_angle, self.hysteresis)

    def margin(self, state: State, mode: jax.Array) -> Scalar:
        """Unit 1."""
        _, cos = sin_cos(state.theta)
        _, edge = sin_cos(self.half_angle * _size(self.hysteresis, mode))
        return cos - edge


@pytree
class AngleRateGate:
    """Open in a rounded region of angle and rate: (1 - cos theta) / (1 - cos half_angle) + (theta' / rate)^2 <= 1.

    The region's extent is `half_angle` at rest and `rate` upright.
    """

    half_angle: Scalar = number("rad", "angle from upright, at rest", above=0.0, at_most=math.pi)
    rate: Scalar = number("rad/s", "angular rate, upright", above=0.0)
    hysteresis: Scalar = number("1", "relative widening of the way out", default=0.0, at_least=0.0)

    def __post_init__(self) -> None:
        _check_widened_angle("AngleRateGate", self.half_angle, self.hysteresis)

    def margin(self, state: State, mode: jax.Array) -> Scalar:
        """Unit 1."""
        size = _size(self.hysteresis, mode)
        _, cos = sin_cos(state.theta)
        half_edge, _ = sin_cos(0.5 * self.half_angle * size)  # 1 - cos(edge) = 2 sin(edge / 2)^2, without cancellation
        relative_rate = state.theta_dot / (self.rate * size)
        return 1.0 - (1.0 - cos) / (2.0 * half_edge * half_edge) - relative_rate * relative_rate


@pytree
class LyapunovGate:
    """Open in a level set of s' P s, s the deviation from `reference`: margin = 1 - s' P s / level."""

    P: Array = matrix((4, 4), "per product of states", "symmetric weight, such as LQR's P", symmetric=True)
    level: Scalar = number("1", "s' P s up to which the gate is open", above=0.0)
    hysteresis: Scalar = number("1", "relative widening of the way out", default=0.0, at_least=0.0)
    reference: State = part("the middle of the level set, a State", *NAMES, default=UPRIGHT)

    def __post_init__(self) -> None:
        object.__setattr__(self, "reference", checked_reference("LyapunovGate.reference", self.reference))

    def margin(self, state: State, mode: jax.Array) -> Scalar:
        """Unit 1."""
        s = deviation(state, self.reference)
        # Written out, not as a matrix product: under vmap each component stays an array of its own.
        form = sum(self.P[i, j] * s[i] * s[j] for i in range(4) for j in range(4))
        return _size(self.hysteresis, mode) - form / self.level


def _size(hysteresis: Scalar, mode: jax.Array) -> jax.Array:
    """How large the boundary that applies in `mode` is, relative to the way in."""
    return jnp.where(mode == REGULATE, 1.0 + hysteresis, 1.0)


def _check_widened_angle(gate: str, half_angle: Any, hysteresis: Any) -> None:
    if is_traced(half_angle) or is_traced(hysteresis):
        return
    widest = np.max(np.asarray(half_angle) * (1.0 + np.asarray(hysteresis)))
    if widest > math.pi * (1 + 1e-6):
        allowed = f"small enough that half_angle * (1 + hysteresis) is at most pi (half_angle = {half_angle} rad)"
        raise InputError(f"{gate}.hysteresis", hysteresis, allowed)
