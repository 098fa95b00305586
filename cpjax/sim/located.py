"""The closed loop on the continuous clock with its changes of mode located: see `switching.py`.

Each iteration is one step of the automaton there. What the clip does to the voltage is a mode too: where a demanded
voltage reaches the limit, the vector field has a kink, over which a Runge-Kutta step loses its order, and its
derivatives with it.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cpjax.compilation import one_function, part_of_step
from cpjax.controllers.protocol import SmoothController
from cpjax.plant import CartPole
from cpjax.sim.flags import CHATTER_LENGTH, STOPPED, Flag, unknown
from cpjax.sim.integrators import INTEGRATORS, Integrator
from cpjax.sim.kept import pack
from cpjax.sim.metrics import Fold, Sample
from cpjax.sim.scan import scan
from cpjax.sim.settings import Settings
from cpjax.sim.stepper import ClosedLoop
from cpjax.sim.switching import LANDED, RUN, Motion, iterate, pick, start_motion
from cpjax.state import RUNAWAY_LIMIT, State, within_bounds


class _Loop(NamedTuple):
    """The scan's carry."""

    motion: Motion
    flag: jax.Array
    voltage: jax.Array
    """At the sample before [V]."""
    mode: jax.Array
    """At the sample before."""


def simulate(
    start: State, plant: CartPole, controller: SmoothController, fold: Fold, dt: jax.Array, settings: Settings
) -> tuple[jax.Array | None, Sample, Any]:
    """The samples that are kept but for the last, packed (None if none are), the last one, and what the fold made of
    all of them."""
    system = ClosedLoop(plant, controller)
    motion = start_motion(system, (start.x, start.theta), (start.x_dot, start.theta_dot), system.start_mode(start), dt)
    loop = _Loop(motion, unknown((start, plant, controller)), motion.seen.output, motion.mode.law)
    first = _sample(loop, motion, dt)

    run = one_function(functools.partial(_run, settings=settings), stacks=True)
    carry, kept = run((loop, fold.update(fold.init(first), first)), system, fold, dt)
    loop, memory = carry
    last = _sample(loop, loop.motion, dt)
    samples = None
    if kept is not None:
        samples, passed = kept
        # The first iteration after which so many grid points have been passed.
        wanted = jnp.arange(settings.save_every, settings.steps, settings.save_every, dtype=passed.dtype)
        rows = jnp.searchsorted(passed, wanted)
        samples = jnp.concatenate([pack(first)[None], samples[rows]])
    return samples, last, fold.finish(memory, last)


def _run(
    carry: tuple[_Loop, Any], system: ClosedLoop, fold: Fold, dt: jax.Array, settings: Settings
) -> tuple[tuple[_Loop, Any], tuple[jax.Array, jax.Array] | None]:
    """Loop and memory after all iterations; and, of each, its sample, packed, and how many grid points it has passed,
    if samples are kept."""
    integrator, steps = INTEGRATORS[settings.integrator], settings.steps
    iterations = steps + settings.spare_steps

    def body(
        carry: tuple[_Loop, Any], index: jax.Array
    ) -> tuple[tuple[_Loop, Any], tuple[jax.Array, jax.Array] | None]:
        before, memory = carry
        loop, reached = _advance(system, integrator, before, dt, steps, iterations - index)
        sample = _sample(loop, before.motion, dt)
        updated = part_of_step(type(fold).update)(fold, memory, sample), sample.voltage, sample.mode
        kept = memory, loop.voltage, loop.mode
        memory, voltage, mode = jax.tree.map(lambda new, old: jnp.where(reached, new, old), updated, kept)
        loop = loop._replace(voltage=voltage, mode=mode)
        return (loop, memory), (None if settings.save_every is None else (pack(sample), loop.motion.passed))

    return scan(body, carry, jnp.arange(iterations, dtype=jnp.int32), settings.checkpoint)


def _sample(loop: _Loop, before: Motion, dt: jax.Array) -> Sample:
    """At the last point that was reached; `before` is the motion an iteration earlier."""
    motion = loop.motion
    landed = (before.stage == LANDED) & ((loop.flag & STOPPED) == 0)
    return Sample(
        time=motion.passed.astype(dt.dtype) * dt + motion.offset,
        elapsed=motion.elapsed,
        state=State(motion.q[0], motion.v[0], motion.q[1], motion.v[1]),
        voltage=motion.seen.output,
        voltage_since=loop.voltage,
        voltage_until=jnp.where(landed, before.seen.output, motion.seen.output),
        mode=motion.mode.law,
        mode_before=loop.mode,
        cart_acceleration=jnp.asarray(motion.seen.acceleration[0]),
        flag=loop.flag,
        crossing=jnp.where(landed, before.guard + 1, 0),
        crossing_speed=jnp.where(landed, -pick(before.slopes, before.guard), 0.0),
    )


def _advance(
    system: ClosedLoop, integrator: Integrator, loop: _Loop, dt: jax.Array, steps: int, left: jax.Array
) -> tuple[_Loop, jax.Array]:
    """One iteration. A run that would leave the bounds, become non-finite, or not end in the iterations that are left,
    is held at the last point and flagged; its samples go on.

    As on the other path (`per_step.py`), a step that is about to go wrong is taken from upright rest and dropped, so
    that no infinity of a branch that is not taken reaches a derivative.
    """
    motion = loop.motion
    stopped, ended = (loop.flag & STOPPED) != 0, motion.passed >= steps
    acceleration = motion.seen.acceleration
    ahead = motion.v[0] + dt * acceleration[0], motion.v[1] + dt * acceleration[1]
    going = ~stopped & ~ended & (jnp.abs(ahead[0]) <= RUNAWAY_LIMIT) & (jnp.abs(ahead[1]) <= RUNAWAY_LIMIT)
    safe = jax.tree.map(lambda x: jnp.where(going, x, 0), motion)
    after, reached = iterate(system, integrator, safe, dt)
    within = within_bounds(State(after.q[0], after.v[0], after.q[1], after.v[1]))
    in_time = left > steps - after.passed
    good = going & within & in_time
    finite = jnp.isfinite(ahead[0] + ahead[1] + after.q[0] + after.v[0] + after.q[1] + after.v[1])
    lost = jnp.where(finite, np.int32(Flag.RUNAWAY), np.int32(Flag.NON_FINITE))
    reason = jnp.where(going & within & finite, np.int32(Flag.OVERFLOW), lost)
    chatter = jnp.where(good & (after.crossings >= CHATTER_LENGTH), np.int32(Flag.CHATTERING), np.int32(0))
    flag = loop.flag | jnp.where(stopped | ended | good, np.int32(0), reason) | chatter
    # A run that is held passes one grid point an iteration.
    held = motion._replace(
        passed=motion.passed + (~ended).astype(motion.passed.dtype),
        offset=jnp.zeros_like(motion.offset),
        elapsed=jnp.where(ended, motion.elapsed, 0.0),
        stage=jnp.full_like(motion.stage, RUN),
    )
    motion = jax.tree.map(lambda new, old: jnp.where(good, new, old), after, held)
    return loop._replace(motion=motion, flag=flag), (good & reached) | (~good & ~ended)
