"""Gates: regions of the state in which the regulator acts.

A gate is defined by its margin, a function of the state: positive inside, zero on the boundary, negative outside, and
smooth near the boundary. With hysteresis the exit region, which ends regulation, is larger than the entry region, which
begins it: its size (angle and rate, or the level of the quadratic form) is (1 + hysteresis) times as large. Angle gates
are written in cos(theta), so that theta = pi is no boundary; the Lyapunov gate's margin is discontinuous there, but far
below zero for any useful level.
"""

import math
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Float, Int

from cpjax.backend.trigonometry import sin_cos
from cpjax.controllers.protocol import REGULATE
from cpjax.errors import InputError
from cpjax.numeric.selection import where
from cpjax.plant.state import NAMES, UPRIGHT, State, checked_reference, deviation
from cpjax.pytree import JaxOrNumpy, Scalar, Scalars, is_traced, matrix, number, part, pytree


@runtime_checkable
class Gate(Protocol):
    """Interface of a gate, as `Hybrid` uses it."""

    def margin(self, state: State, mode: Int[Array, ""]) -> Scalar:
        """Returns the margin, smooth in the state: at least 0 where the regulator acts, given the mode until now."""
        ...


@pytree
class AngleGate:
    """Gate within `half_angle` of upright: margin = cos(theta) - cos(size)."""

    half_angle: Scalars = number("rad", "angle from upright", above=0.0, at_most=math.pi)
    hysteresis: Scalars = number("1", "relative enlargement of the exit region", default=0.0, at_least=0.0, typical=0.1)

    def __post_init__(self) -> None:
        _check_widened_angle("AngleGate", self.half_angle, self.hysteresis)

    def margin(self, state: State, mode: Int[Array, ""]) -> Scalars:
        """Returns the margin [1]; its boundary depends on the mode if there is hysteresis."""
        _, cos = sin_cos(state.theta)
        # Both edges, then one of them is selected: they do not depend on the state, so a batch computes them once.
        (_, way_in), (_, way_out) = sin_cos(self.half_angle), sin_cos(self.half_angle * (1.0 + self.hysteresis))
        return cos - where(mode == REGULATE, way_out, way_in)


@pytree
class AngleRateGate:
    """Gate with a rounded region of angle and rate: (1 - cos theta) / (1 - cos half_angle) + (theta' / rate)^2 <= 1.

    The region extends to `half_angle` at rest and to `rate` upright.
    """

    half_angle: Scalars = number("rad", "angle from upright, at rest", above=0.0, at_most=math.pi)
    rate: Scalars = number("rad/s", "angular rate, upright", above=0.0)
    hysteresis: Scalars = number("1", "relative enlargement of the exit region", default=0.0, at_least=0.0, typical=0.1)

    def __post_init__(self) -> None:
        _check_widened_angle("AngleRateGate", self.half_angle, self.hysteresis)

    def margin(self, state: State, mode: Int[Array, ""]) -> Scalars:
        """Returns the margin [1]; its boundary depends on the mode if there is hysteresis."""
        _, cos = sin_cos(state.theta)
        # Both regions, then one of them is selected: they do not depend on the state, so a batch computes them once.
        way_in, way_out = self._scales(0.0), self._scales(self.hysteresis)
        per_drop, per_rate = (where(mode == REGULATE, b, a) for a, b in zip(way_in, way_out, strict=True))
        relative_rate = state.theta_dot * per_rate
        return 1.0 - (1.0 - cos) * per_drop - relative_rate * relative_rate

    def _scales(self, widening: Scalars) -> tuple[Scalars, Scalars]:
        """Returns the factors of 1 - cos(theta) and of theta' for a region (1 + widening) times as large."""
        size = 1.0 + widening
        half_edge, _ = sin_cos(0.5 * self.half_angle * size)  # 1 - cos(edge) = 2 sin(edge / 2)^2, without cancellation
        return 0.5 / (half_edge * half_edge), 1.0 / (self.rate * size)


@pytree
class LyapunovGate:
    """Gate in a level set of s' P s, with s the deviation from `reference`: margin = 1 - s' P s / level."""

    P: Float[JaxOrNumpy, "*batch 4 4"] = matrix(
        (4, 4), "per product of states", "symmetric weight, such as LQR's P", symmetric=True
    )
    level: Scalars = number("1", "s' P s up to which the gate is open", above=0.0)
    hysteresis: Scalars = number("1", "relative enlargement of the exit region", default=0.0, at_least=0.0, typical=0.1)
    reference: State = part("the middle of the level set, a State", *NAMES, default=UPRIGHT)

    def __post_init__(self) -> None:
        object.__setattr__(self, "reference", checked_reference("LyapunovGate.reference", self.reference))

    def margin(self, state: State, mode: Int[Array, ""]) -> Scalars:
        """Returns the margin [1]; its boundary depends on the mode if there is hysteresis."""
        s = deviation(state, self.reference)
        # Written as a sum, not as a matrix product, so that under vmap each component stays an array of its own.
        form = sum(self.P[i, j] * s[i] * s[j] for i in range(4) for j in range(4))
        return where(mode == REGULATE, 1.0 + self.hysteresis, 1.0) - form * (1.0 / self.level)


def _check_widened_angle(gate: str, half_angle: Any, hysteresis: Any) -> None:
    if is_traced(half_angle) or is_traced(hysteresis):
        return
    widest = np.max(np.asarray(half_angle) * (1.0 + np.asarray(hysteresis)))
    if widest > math.pi * (1 + 1e-6):
        allowed = f"small enough that half_angle * (1 + hysteresis) is at most pi (half_angle = {half_angle} rad)"
        raise InputError(f"{gate}.hysteresis", hysteresis, allowed)
