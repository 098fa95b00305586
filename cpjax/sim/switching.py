"""Fixed steps with changes of mode located inside them. Independent of the plant.

A system q'' = a(q, v) is smooth within a mode; guards, functions of q and v that are smooth near zero, stay positive
while the mode lasts. (A kink elsewhere costs iterations, as the cubic of the first estimate fits it badly.)
A step after which a guard is negative is rejected: the crossing is located, the step is repeated up to it, the mode
changes, and another step completes the first. So every Runge-Kutta step stays inside one mode, which preserves the
method's order, and the instant of the change moves with the parameters as in the continuous system, which preserves the
derivatives.

This is a small state machine with one integrator step per iteration, so that under `vmap` each batch element advances
in its own time and a crossing in one costs the others nothing. `Motion.phase` determines what an iteration does:

    RUN     a step to the next grid point; accepted, or, if a guard fell, a crossing is located: phase 1
    1, ...  the step up to the estimated crossing, corrected by Newton's method; after the last correction: LANDED
    LANDED  a step of zero length, which evaluates everything in the new mode; then RUN, for the rest of the step

A crossing takes `CROSSING_COST` iterations more than a step without one, and a few more where the cubic of the first
estimate approximates the guard so badly that the step must be halved. A guard that falls and rises again within one
step is not detected.

Derivatives: located times have none; the Newton corrections have that of the implicit function theorem. For the exact
flow one correction would suffice. The computed flow is that of the integrator, whose time derivative differs slightly
from the vector field; each correction multiplies the difference by the integrator's relative error.
"""

from typing import Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from cpjax.backend.single_kernel import outline
from cpjax.numeric.roots import crossing_fraction, newton_correction
from cpjax.numeric.selection import where
from cpjax.pytree import Scalar
from cpjax.sim.integrators import Integrator, Step

Tree: TypeAlias = Any
"""A pytree of arrays."""

Guards: TypeAlias = tuple[Scalar, ...]
"""Values of the guards, by number."""

RUN, LOCATE, LANDED = 0, 1, -1
_CORRECTIONS = 2

CROSSING_COST = _CORRECTIONS + 2
"""Iterations that a crossing takes in addition to those of a step without one."""


class Observation(NamedTuple):
    """Evaluation of a system at one instant, in one mode."""

    acceleration: Tree
    """Accelerations q''."""
    guards: Guards
    """Guards, at least 0 while the mode lasts."""
    output: Tree
    """Further quantities for the caller."""


@runtime_checkable
class System(Protocol):
    """Second-order system q'' = a(q, v) with modes."""

    def observe(self, q: Tree, v: Tree, mode: Tree) -> Observation:
        """Returns the accelerations and output, smooth in q and v, and the guards, smooth near zero."""
        ...

    def jump(self, q: Tree, v: Tree, mode: Tree, guard: Int[Array, ""]) -> tuple[Tree, Tree, Tree]:
        """Returns q, v and mode after the guard of this number (int32) has fallen."""
        ...


class Motion(NamedTuple):
    """Position of a system in time and within the state machine."""

    q: Tree
    v: Tree
    mode: Tree
    current: Observation
    """Observation at (q, v) in `mode`; just after a crossing, at the end of the previous mode."""
    slopes: Guards
    """d guards / dt, not differentiable."""
    grid_index: Int[Array, ""]
    """Number of grid points passed, int32."""
    offset: Step
    """Time since the last grid point [s]."""
    step: Step
    """Step that the next iteration tries [s]."""
    elapsed: Step
    """Time between the last two points that were reached [s]."""
    phase: Int[Array, ""]
    """Task of the next iteration: `RUN`, `LANDED`, or the number of the correction, int32."""
    guard: Int[Array, ""]
    """Number of the guard whose crossing is being located, int32."""
    bracket: Step
    """Length of a step after which that guard has fallen [s]."""
    crossings: Int[Array, ""]
    """Number of crossings since the last grid point, int32."""


def start_motion(system: System, q: Tree, v: Tree, mode: Tree, dt: Step) -> Motion:
    """Returns the motion at the first grid point, with steps of `dt` [s]."""
    current, slopes, _ = observe(system, q, v, mode)
    none = jnp.zeros_like(dt, dtype=jnp.int32)
    return Motion(q, v, mode, current, slopes, none, 0.0 * dt, dt, 0.0 * dt, none + RUN, none, dt, none)


def iterate(system: System, integrator: Integrator, motion: Motion, dt: Step) -> tuple[Motion, Bool[Array, ""]]:
    """Performs one integrator step, accepted or rejected; also returns whether a new point of the motion was reached.

    Points are reached on the grid and at each crossing, there in the new mode.
    """
    current, step, phase = motion.current, motion.step, motion.phase
    q, v = integrator(
        lambda q, v: system.observe(q, v, motion.mode).acceleration, motion.q, motion.v, step, current.acceleration
    )
    trial, slopes, drift = observe(system, q, v, motion.mode)
    landed, locating = phase == LANDED, phase >= LOCATE

    # Newton's correction, unless it is too large to be valid: then the cubic approximated the guard badly.
    value = pick(trial.guards, motion.guard)
    steepness = (jnp.abs(pick(current.guards, motion.guard)) + jnp.abs(value)) / dt
    correction = newton_correction(value, pick(slopes, motion.guard), steepness)
    room = dt * float(np.finfo(dt.dtype).eps) ** 0.5
    far = (jnp.abs(correction) > 0.05 * motion.bracket + room) | (step + correction < -room)
    missed = locating & far & (motion.bracket > room)
    correction = where(far, 0.0, correction)
    corrected = step + correction

    # What follows only searches for the crossing: Newton's corrections carry its derivative, steps that are tried have
    # none (`stop_gradient`).
    search = motion.slopes, trial.guards, slopes, step, locating, landed, missed, motion.guard, dt
    fell, first, fraction = outline(first_crossing)(*lax.stop_gradient((current.guards, *search)))

    short = missed & ~fell  # short of the crossing: continue from this point
    refine = locating & ~fell & ~short & (phase < _CORRECTIONS)
    land = locating & ~fell & ~short & (phase >= _CORRECTIONS)
    reached = short | ~(fell | locating)
    at_grid = reached & ~landed & ~short

    new_q, new_v, new_mode = system.jump(
        jax.tree.map(lambda q, v: q + correction * v, q, v),
        jax.tree.map(lambda v, a: v + correction * a, v, trial.acceleration),
        motion.mode,
        motion.guard,
    )
    q, v = _where(land, (new_q, new_v), (q, v))
    # The last correction is zero to rounding, and carries the second derivative of the crossing's time.
    trial = trial._replace(output=_shifted(trial.output, drift, where(land, correction, 0.0)))
    moved = land | reached
    offset = where(land | short, motion.offset + corrected, where(at_grid, 0.0, motion.offset))
    step_next = where(fell, lax.stop_gradient(fraction * step), where(refine, corrected, dt - offset))
    phase_next = where(fell, LOCATE, where(refine, phase + 1, where(land, LANDED, RUN)))
    return (
        Motion(
            q=_where(moved, q, motion.q),
            v=_where(moved, v, motion.v),
            mode=_where(land, new_mode, motion.mode),
            current=_where(moved, trial, current),
            slopes=_where(moved, slopes, motion.slopes),
            grid_index=motion.grid_index + at_grid.astype(motion.grid_index.dtype),
            offset=offset,
            step=where(land, 0.0, step_next),
            elapsed=where(land | short, corrected, where(at_grid, step, motion.elapsed)),
            phase=phase_next.astype(phase.dtype),
            guard=where(fell, first, motion.guard),
            bracket=where(fell, lax.stop_gradient(step), motion.bracket),
            crossings=where(at_grid, 0, motion.crossings + land.astype(motion.crossings.dtype)),
        ),
        reached,
    )


def first_crossing(
    before: Guards,
    slopes_before: Guards,
    after: Guards,
    slopes_after: Guards,
    step: Step,
    locating: Bool[Array, ""],
    landed: Bool[Array, ""],
    missed: Bool[Array, ""],
    sought: Int[Array, ""],
    dt: Step,
) -> tuple[Bool[Array, ""], Int[Array, ""], Float[Array, ""]]:
    """Returns whether a guard fell in a step, the number of the first one, and the fraction of the step at which it
    did.

    The one whose crossing is being located (`sought`) is about zero, of either sign; another one that falls at the same
    time is located afterwards.
    """
    room = dt * float(np.finfo(dt.dtype).eps) ** 0.5
    soonest, first = jnp.full_like(step, jnp.inf), jnp.zeros_like(sought)
    for number, (one, other) in enumerate(zip(before, after, strict=True)):
        this = locating & (sought == number)
        fallen = (other < 0.0) & (step > 0.0) & ~landed & (~this | missed)
        above = jnp.maximum(one, 0.0)
        secant = where(fallen, above / where(fallen, above - other, 1.0), jnp.inf)
        secant = where(locating & ~this & (secant > 1.0 - room / dt), jnp.inf, secant)
        first = where(secant < soonest, number, first).astype(sought.dtype)
        soonest = jnp.minimum(secant, soonest)
    fraction = crossing_fraction(
        pick(before, first), step * pick(slopes_before, first), pick(after, first), step * pick(slopes_after, first)
    )
    return soonest < jnp.inf, first, where(missed, 0.5, fraction)


def observe(system: System, q: Tree, v: Tree, mode: Tree) -> tuple[Observation, Guards, list[Float[Array, "..."]]]:
    """Returns the system's observation, and the rates of change of its guards and of the floating-point leaves of its
    output, which are not differentiable."""
    current = system.observe(q, v, mode)
    # Rates of change only guide the search and scale corrections, which are zero to rounding.
    rates = lax.stop_gradient((v, current.acceleration))

    def changing(q: Tree, v: Tree) -> tuple[Guards, list[Float[Array, "..."]]]:
        now = system.observe(q, v, mode)
        return now.guards, [leaf for leaf in jax.tree.leaves(now.output) if _is_float(leaf)]

    _, (slopes, drift) = jax.jvp(changing, lax.stop_gradient((q, v)), rates)
    return current, lax.stop_gradient(slopes), lax.stop_gradient(drift)


def _is_float(leaf: Any) -> bool:
    return jnp.issubdtype(jnp.asarray(leaf).dtype, jnp.floating)


def _shifted(output: Tree, drift: list[Float[Array, "..."]], time: Float[Array, ""]) -> Tree:
    """Returns an output at a slightly later time, to first order."""
    left = iter(drift)
    return jax.tree.map(lambda leaf: leaf + time * next(left) if _is_float(leaf) else leaf, output)


def pick(values: Guards, number: Int[Array, ""]) -> Float[Array, ""]:
    """Returns values[number] without a gather, as under `vmap` each value is an array of its own."""
    picked = jnp.asarray(values[0])
    for k, value in enumerate(values[1:], start=1):
        picked = where(number == k, value, picked)
    return picked


def _where(condition: Bool[Array, ""], new: Tree, old: Tree) -> Tree:
    return jax.tree.map(lambda x, y: where(condition, x, y), new, old)
