"""Fixed-step integrators for second-order systems q'' = a(q, v), v = q'; independent of the plant.

Positions q and velocities v are pytrees of the same structure. Because q' = v is known, only accelerations are stored:
substituting it into the classical methods removes half of their stage values and changes the result by rounding only.
"""

from collections.abc import Callable, Mapping
from typing import Any, Protocol, TypeAlias, runtime_checkable

import jax
import numpy as np
from jaxtyping import Array, Float

from cpjax.pytree import Scalar

Tree: TypeAlias = Any
"""Positions or velocities: any pytree of arrays."""

Acceleration: TypeAlias = Callable[[Tree, Tree], Tree]
"""Function from positions and velocities to accelerations."""

Step: TypeAlias = Float[Array | np.ndarray, ""]
"""Length of a step [s]; NumPy's until JAX traces it."""


@runtime_checkable
class Integrator(Protocol):
    """Interface of one step from (q, v) at t to (q, v) at t + dt; `first` is acceleration(q, v) if already known."""

    def __call__(
        self, acceleration: Acceleration, q: Tree, v: Tree, dt: Scalar, first: Tree | None = None
    ) -> tuple[Tree, Tree]: ...


def euler(acceleration: Acceleration, q: Tree, v: Tree, dt: Scalar, first: Tree | None = None) -> tuple[Tree, Tree]:
    """Advances by explicit Euler, order 1. Adds energy to an oscillation; for comparison only."""
    a1 = acceleration(q, v) if first is None else first
    return _add(q, (dt, v)), _add(v, (dt, a1))


def semi_implicit_euler(
    acceleration: Acceleration, q: Tree, v: Tree, dt: Scalar, first: Tree | None = None
) -> tuple[Tree, Tree]:
    """Advances by semi-implicit (symplectic) Euler, order 1: positions advance with the new velocities."""
    a1 = acceleration(q, v) if first is None else first
    v = _add(v, (dt, a1))
    return _add(q, (dt, v)), v


def rk4(acceleration: Acceleration, q: Tree, v: Tree, dt: Scalar, first: Tree | None = None) -> tuple[Tree, Tree]:
    """Advances by the classical Runge-Kutta method, order 4, with the rows of q' = v eliminated."""
    half = 0.5 * dt
    a1 = acceleration(q, v) if first is None else first
    a2 = acceleration(_add(q, (half, v)), _add(v, (half, a1)))
    a3 = acceleration(_add(q, (half, v), (half * half, a1)), _add(v, (half, a2)))
    a4 = acceleration(_add(q, (dt, v), (half * dt, a2)), _add(v, (dt, a3)))
    sixth = dt / 6.0
    inner = _add(a2, (1.0, a3))
    q_next = _add(q, (dt, v), (dt * sixth, _add(a1, (1.0, inner))))
    v_next = _add(v, (sixth, _add(a1, (2.0, inner), (1.0, a4))))
    return q_next, v_next


INTEGRATORS: Mapping[str, Integrator] = {"rk4": rk4, "semi-implicit-euler": semi_implicit_euler, "euler": euler}
"""Integrators by the name that `rollout` takes."""


def _add(base: Tree, *terms: tuple[Scalar, Tree]) -> Tree:
    """Returns base + factor * tree + ..., leaf by leaf."""
    for factor, tree in terms:
        base = jax.tree.map(lambda b, t, factor=factor: b + factor * t, base, tree)
    return base
