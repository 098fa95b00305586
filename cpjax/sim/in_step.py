"""Events of a plant inside a step of constant length: the first guard that falls, and the rest of the step after it.

On the sampled clock with switching per step, a plant with events (`cpjax.sim.plants.Eventful`) takes one step like
this, without iterations, so that a batch element with an event costs no more than one without:

1. A step in the present mode, as if nothing happened.
2. Where a guard is below zero after it, the crossing is found on the cubic Hermite interpolant of the velocities,
   whose integral gives the positions, with an error of order dt^4, and corrected once by Newton's method, which carries
   the derivative.
3. The plant jumps, and a second step in the new mode does the rest.

A second event in the same step takes effect at its end. `switching="located"` finds any number of them.
"""

from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from cpjax.backend.single_kernel import outline
from cpjax.numeric.roots import newton_correction
from cpjax.numeric.selection import where
from cpjax.sim import plants
from cpjax.sim.integrators import Acceleration, Integrator
from cpjax.sim.plants import Plant, Tree
from cpjax.sim.switching import Guards, first_crossing, pick

_Motion: TypeAlias = tuple[Tree, Tree]
"""Positions and velocities."""

_NOT, _NONE = np.bool_(False), np.int32(0)
"""No guard's crossing is being located when a step begins."""


def step_with_event(
    plant: Plant, integrator: Integrator, q: Tree, v: Tree, mode: Tree, u: Float[Array, ""], dt: Any, first: Tree
) -> tuple[Tree, Tree, Tree]:
    """Returns positions, velocities and the plant's mode after `dt` [s] under a constant input.

    Args:
      plant: a plant with events.
      integrator: the method of one step.
      q, v: positions and velocities at the beginning of the step.
      mode: the plant's own mode there.
      u: the input that the drive applies.
      dt: length of the step [s].
      first: the accelerations at the beginning.
    """

    def accelerations(mode: Tree) -> Acceleration:
        return lambda q, v: outline(plants.accelerations)(plant, plants.geometry(plant, q), v, u, mode)

    q_end, v_end = integrator(accelerations(mode), q, v, dt, first)
    last = accelerations(mode)(q_end, v_end)
    before, slopes_before = _guards(plant, q, v, first, u, mode)
    after, slopes_after = _guards(plant, q_end, v_end, last, u, mode)
    # Only searches: Newton's correction below carries the crossing's derivative, so the search needs none.
    search = lax.stop_gradient((before, slopes_before, after, slopes_after, dt))
    falls, number, share = outline(first_crossing)(*search, _NOT, _NOT, _NOT, _NONE, search[-1])
    start, end = pick(before, number), pick(after, number)
    share = where(start > 0.0, share, 0.0)  # a guard that is below zero already ends its mode now

    def at(share: Float[Array, ""]) -> _Motion:
        return _interpolated(q, v, first, v_end, last, dt, share)

    q_near, v_near = at(share)
    near, slopes = _guards(plant, q_near, v_near, accelerations(mode)(q_near, v_near), u, mode)
    steepness = (jnp.abs(start) + jnp.abs(end)) / dt
    correction = newton_correction(pick(near, number), pick(slopes, number), steepness) / dt
    sought = falls & (start > 0.0)
    share = share + where(sought, jnp.clip(correction, -share, 1.0 - share), 0.0)
    share = where(falls, share, 1.0)
    q_there, v_there = at(share)
    q_new, v_new, mode_new = plants.jump(plant, q_there, v_there, mode, number)
    mode_new = plants.release(plant, q_new, v_new, u, mode_new)
    q_rest, v_rest = integrator(accelerations(mode_new), q_new, v_new, (1.0 - share) * dt, None)
    return _chosen(falls, (q_rest, v_rest, mode_new), (q_end, v_end, mode))


def _guards(
    plant: Plant, q: Tree, v: Tree, acceleration: Tree, u: Float[Array, ""], mode: Tree
) -> tuple[Guards, Guards]:
    """Returns the guards, and their rates of change, which are not differentiable."""
    found = plants.guards(plant, q, v, u, mode)
    # Rates guide the search, and scale a correction that is zero to rounding: their own derivative has no effect.
    rates = lax.stop_gradient((v, acceleration))
    here = lax.stop_gradient((q, v))
    _, slopes = jax.jvp(lambda q, v: plants.guards(plant, q, v, u, mode), here, rates)
    return found, lax.stop_gradient(slopes)


def _interpolated(q: Tree, v: Tree, first: Tree, v_end: Tree, last: Tree, dt: Any, share: Float[Array, ""]) -> _Motion:
    """Returns positions and velocities at a share of the step: the velocities' cubic, and its integral."""

    def velocity(v: Any, a: Any, v_end: Any, a_end: Any) -> Any:
        rise, a, a_end = v_end - v, dt * a, dt * a_end
        third = a + a_end - 2.0 * rise
        second = rise - a - third
        return v + share * (a + share * (second + share * third))

    def position(q: Any, v: Any, a: Any, v_end: Any, a_end: Any) -> Any:
        rise, a, a_end = v_end - v, dt * a, dt * a_end
        third = a + a_end - 2.0 * rise
        second = rise - a - third
        return q + dt * share * (v + share * (a / 2.0 + share * (second / 3.0 + share * third / 4.0)))

    return jax.tree.map(position, q, v, first, v_end, last), jax.tree.map(velocity, v, first, v_end, last)


def _chosen(condition: Any, new: Tree, old: Tree) -> Tree:
    return jax.tree.map(lambda x, y: where(condition, x, y), new, old)
