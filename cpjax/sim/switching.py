"""Fixed steps through mode changes that happen inside them. Knows no cart-pole.

A system q'' = a(q, v) in a mode is smooth; guards, smooth functions of q and v, stay positive while the mode lasts. A
step after which a guard is negative has gone too far. It is not taken: its crossing is located, the step is repeated
up to there, the mode changes, and another step goes on to the end of the first. So every Runge-Kutta step stays inside
one mode, which keeps the method's order, and the moment of the change moves with the parameters as it does in the
continuous system, which keeps the derivatives.

All of it is one small automaton, one integrator step an iteration, so that under `vmap` each system of a batch keeps
its own motion in time and a crossing in one costs the others nothing. What an iteration does depends on `Motion.stage`:

    RUN     a step to the next grid point; taken, or, if a guard fell, a crossing is located: stage 1
    1, ...  the step up to where the crossing is thought to be, corrected by Newton's method; after the last: LANDED
    LANDED  a step of no length, after which everything is known in the new mode; then RUN, for the rest of the step

A crossing takes `CROSSING_COST` iterations more than a step without one, and a few more where the cubic on which it is
first looked for is nothing like the guard, so that the step has to be halved. What falls and rises again within one
step is not noticed.

Derivatives: located times have none; the Newton corrections have the one of the implicit function theorem. One
correction would do for the true flow. The program's flow is that of the integrator, whose derivative in time is not
quite the vector field; each correction multiplies the difference by the integrator's relative error.
"""

from typing import Any, NamedTuple, Protocol, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from cpjax.numeric.roots import crossing_fraction, newton_correction
from cpjax.pytree import Scalar
from cpjax.sim.integrators import Integrator

Tree: TypeAlias = Any
Guards: TypeAlias = tuple[Scalar, ...]

RUN, LANDED = 0, -1
_CORRECTIONS = 2

CROSSING_COST = _CORRECTIONS + 2
"""Iterations that a crossing takes beyond those of a step without one."""


class Observation(NamedTuple):
    """What a system is at one instant, in one mode."""

    acceleration: Tree
    """q''."""
    guards: Guards
    """At least 0 while the mode lasts."""
    output: Tree
    """Whatever else the caller wants to know."""


class System(Protocol):
    """q'' = a(q, v) with modes."""

    def observe(self, q: Tree, v: Tree, mode: Tree) -> Observation:
        """Smooth in q and v."""
        ...

    def jump(self, q: Tree, v: Tree, mode: Tree, guard: jax.Array) -> tuple[Tree, Tree, Tree]:
        """q, v and mode after the guard of this number (int32) has fallen."""
        ...


class Motion(NamedTuple):
    """Where a system is in time and between its steps."""

    q: Tree
    v: Tree
    mode: Tree
    seen: Observation
    """At (q, v) in `mode`; just after a crossing, at the end of the mode before."""
    slopes: Guards
    """d guards / dt; without a derivative."""
    passed: jax.Array
    """Grid points passed, int32."""
    offset: jax.Array
    """Time since the last grid point."""
    step: jax.Array
    """What the next iteration tries."""
    elapsed: jax.Array
    """Time between the last two points that were reached."""
    stage: jax.Array
    guard: jax.Array
    """Number of the guard whose crossing is being located, int32."""
    reach: jax.Array
    """A step after which that guard has fallen."""
    crossings: jax.Array
    """Since the last grid point, int32."""


def start_motion(system: System, q: Tree, v: Tree, mode: Tree, dt: jax.Array) -> Motion:
    """At the first grid point."""
    seen, slopes = observe(system, q, v, mode)
    none = jnp.zeros_like(dt, dtype=jnp.int32)
    return Motion(q, v, mode, seen, slopes, none, 0.0 * dt, dt, 0.0 * dt, none + RUN, none, dt, none)


def iterate(system: System, integrator: Integrator, motion: Motion, dt: jax.Array) -> tuple[Motion, jax.Array]:
    """One step, or one try at one. The second result says whether a new point of the motion was reached.

    Points are reached on the grid, and at each crossing, in the new mode.
    """
    seen, step, stage = motion.seen, motion.step, motion.stage
    q, v = integrator(
        lambda q, v: system.observe(q, v, motion.mode).acceleration, motion.q, motion.v, step, seen.acceleration
    )
    ahead, slopes = observe(system, q, v, motion.mode)
    landed, locating = stage == LANDED, stage >= 1

    # Newton's correction, unless it goes too far to be one: then the cubic was not like the guard.
    value = pick(ahead.guards, motion.guard)
    steepness = (jnp.abs(pick(seen.guards, motion.guard)) + jnp.abs(value)) / dt
    correction = newton_correction(value, pick(slopes, motion.guard), steepness)
    room = dt * float(np.finfo(dt.dtype).eps) ** 0.5
    far = (jnp.abs(correction) > 0.05 * motion.reach + room) | (step + correction < -room)
    missed = locating & far & (motion.reach > room)
    correction = jnp.where(far, 0.0, correction)
    corrected = step + correction

    # The first guard to fall, if any. The one whose crossing is being located is about zero, of either sign; another
    # one that falls with it is left for afterwards.
    soonest, first = jnp.full_like(step, jnp.inf), jnp.zeros_like(motion.guard)
    for number, (before, after) in enumerate(zip(seen.guards, ahead.guards, strict=True)):
        sought = locating & (motion.guard == number)
        fallen = (after < 0.0) & (step > 0.0) & ~landed & (~sought | missed)
        above = jnp.maximum(before, 0.0)
        secant = jnp.where(fallen, lax.stop_gradient(above / jnp.where(fallen, above - after, 1.0)), jnp.inf)
        secant = jnp.where(locating & ~sought & (secant > 1.0 - room / dt), jnp.inf, secant)
        first = jnp.where(secant < soonest, number, first).astype(motion.guard.dtype)
        soonest = jnp.minimum(secant, soonest)
    fell = soonest < jnp.inf
    fraction = crossing_fraction(
        pick(seen.guards, first),
        step * pick(motion.slopes, first),
        pick(ahead.guards, first),
        step * pick(slopes, first),
    )
    fraction = jnp.where(missed, 0.5, fraction)

    short = missed & ~fell  # not yet there: this point is as good as any to go on from
    refine = locating & ~fell & ~short & (stage < _CORRECTIONS)
    land = locating & ~fell & ~short & (stage >= _CORRECTIONS)
    reached = short | ~(fell | locating)
    at_grid = reached & ~landed & ~short

    new_q, new_v, new_mode = system.jump(
        jax.tree.map(lambda q, v: q + correction * v, q, v),
        jax.tree.map(lambda v, a: v + correction * a, v, ahead.acceleration),
        motion.mode,
        motion.guard,
    )
    q, v = _where(land, (new_q, new_v), (q, v))
    moved = land | reached
    offset = jnp.where(land | short, motion.offset + corrected, jnp.where(at_grid, 0.0, motion.offset))
    step_next = jnp.where(fell, lax.stop_gradient(fraction * step), jnp.where(refine, corrected, dt - offset))
    stage_next = jnp.where(fell, 1, jnp.where(refine, stage + 1, jnp.where(land, LANDED, RUN)))
    return (
        Motion(
            q=_where(moved, q, motion.q),
            v=_where(moved, v, motion.v),
            mode=_where(land, new_mode, motion.mode),
            seen=_where(moved, ahead, seen),
            slopes=_where(moved, slopes, motion.slopes),
            passed=motion.passed + at_grid.astype(motion.passed.dtype),
            offset=offset,
            step=jnp.where(land, 0.0, step_next),
            elapsed=jnp.where(land | short, corrected, jnp.where(at_grid, step, motion.elapsed)),
            stage=stage_next.astype(stage.dtype),
            guard=jnp.where(fell, first, motion.guard),
            reach=jnp.where(fell, lax.stop_gradient(step), motion.reach),
            crossings=jnp.where(at_grid, 0, motion.crossings + land.astype(motion.crossings.dtype)),
        ),
        reached,
    )


def observe(system: System, q: Tree, v: Tree, mode: Tree) -> tuple[Observation, Guards]:
    """Returns the system's observation, and how fast its guards change, without a derivative."""
    seen = system.observe(q, v, mode)
    rates = lax.stop_gradient((v, seen.acceleration))
    guards = lambda q, v: system.observe(q, v, mode).guards  # noqa: E731
    _, slopes = jax.jvp(guards, lax.stop_gradient((q, v)), rates)
    return seen, lax.stop_gradient(slopes)


def pick(values: Guards, number: jax.Array) -> jax.Array:
    """values[number], without a gather: under `vmap` each of them is an array of its own."""
    picked = jnp.asarray(values[0])
    for k, value in enumerate(values[1:], start=1):
        picked = jnp.where(number == k, value, picked)
    return picked


def _where(condition: jax.Array, new: Tree, old: Tree) -> Tree:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), new, old)
