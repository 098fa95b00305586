"""The closed loop in equal steps: law and gate are read at control instants, and the mode is kept in between.

At each step `_observe` reads the controller and takes a sample, `_advance` integrates to the next.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cpjax import runtime
from cpjax.compilation import one_function, part_of_step
from cpjax.controllers.protocol import Controller
from cpjax.numeric.trigonometry import sin_cos
from cpjax.plant import CartPole
from cpjax.sim.flags import CHATTER_LENGTH, IN_DOUBT, STOPPED, Flag, unknown
from cpjax.sim.integrators import INTEGRATORS
from cpjax.sim.kept import pack
from cpjax.sim.metrics import Fold, Sample
from cpjax.sim.scan import scan
from cpjax.sim.settings import Settings
from cpjax.sim.stepper import Pair, applied_voltage, rates, step_continuous, step_held, step_held_by_turns
from cpjax.state import RUNAWAY_LIMIT, State, within_bounds


class _Instant(NamedTuple):
    """What `_observe` computed and `_advance` needs again."""

    rates: Pair
    """(x'', theta'') [m/s^2, rad/s^2]."""
    direction: Pair
    """Sine and cosine of theta."""


class _Loop(NamedTuple):
    """The scan's carry."""

    state: State
    mode: jax.Array
    voltage: jax.Array
    flag: jax.Array
    changes: jax.Array
    """Control instants in a row at which the mode changed."""


def simulate(
    start: State, plant: CartPole, controller: Controller, fold: Fold, dt: jax.Array, settings: Settings
) -> tuple[jax.Array | None, Sample, Any]:
    """The samples that are kept but for the last, packed (None if none are), the last one, and what the fold made of
    all of them."""
    none = jnp.zeros_like(start.x, dtype=jnp.int32)
    mode = controller.start_mode(start)
    voltage = applied_voltage(plant, controller, start, mode)
    flag = unknown((start, plant, controller))
    flag = jnp.where(flag != 0, np.int32(IN_DOUBT), flag) if settings.optimistic else flag
    loop = _Loop(start, mode, voltage, flag, none)
    _, first, _ = _observe(plant, controller, loop, jnp.asarray(0), dt, settings)

    carry = (loop, fold.init(first))
    run = one_function(functools.partial(_run, settings=settings), stacks=True)
    (loop, memory), samples = run(carry, plant, controller, fold, dt)
    _, last, _ = _observe(plant, controller, loop, jnp.asarray(settings.steps), dt, settings)
    clean = last._replace(flag=last.flag & ~IN_DOUBT)
    return samples, last, fold.finish(fold.update(memory, clean), clean)


def _run(
    carry: tuple[_Loop, Any], plant: CartPole, controller: Controller, fold: Fold, dt: jax.Array, settings: Settings
) -> tuple[tuple[_Loop, Any], jax.Array | None]:
    """Loop and memory after all steps, and the samples that are kept but for the last."""
    steps, every = settings.steps, settings.save_every

    def body(carry: tuple[_Loop, Any], index: jax.Array) -> tuple[tuple[_Loop, Any], jax.Array | None]:
        loop, memory = carry
        loop, sample, instant = _observe(plant, controller, loop, index, dt, settings)
        memory = part_of_step(type(fold).update)(fold, memory, sample)
        loop = _advance(plant, controller, loop, instant, dt, settings)
        return (loop, memory), (pack(sample) if every == 1 else None)

    def block(carry: tuple[_Loop, Any], index: jax.Array) -> tuple[tuple[_Loop, Any], jax.Array]:
        _, sample, _ = _observe(plant, controller, carry[0], index, dt, settings)
        carry, _ = scan(body, carry, index + jnp.arange(every), "every_step")
        return carry, pack(sample)

    if every is None:
        # With these options of the compiler, all that is remembered would be copied at each step.
        checkpoint = "segments" if runtime.fast_loops() else settings.checkpoint
        return scan(body, carry, jnp.arange(steps), checkpoint)
    if every == 1:
        return scan(body, carry, jnp.arange(steps), "every_step")
    return scan(block, carry, jnp.arange(0, steps, every), "every_step")


def _observe(
    plant: CartPole, controller: Controller, loop: _Loop, index: jax.Array, dt: jax.Array, settings: Settings
) -> tuple[_Loop, Sample, _Instant]:
    """Reads the controller at step `index`, if that is a control instant, takes a sample, and hands the accelerations
    at this instant on to `_advance`, whose first stage they are."""
    state = loop.state
    mode = controller.next_mode(state, loop.mode)
    voltage = applied_voltage(plant, controller, state, mode)
    changes = jnp.where(mode != loop.mode, loop.changes + 1, 0)
    until = applied_voltage(plant, controller, state, loop.mode) if settings.clock == "continuous" else None
    if settings.steps_per_control > 1:
        instant = index % settings.steps_per_control == 0
        mode = jnp.where(instant, mode, loop.mode)
        voltage = jnp.where(instant, voltage, loop.voltage)
        changes = jnp.where(instant, changes, loop.changes)
    flag = loop.flag | jnp.where(changes >= CHATTER_LENGTH, np.int32(Flag.CHATTERING), np.int32(0))
    # Optimistic, no run is stopped: one that should be is in doubt.
    going = jnp.asarray(True) if settings.optimistic else (flag & STOPPED) == 0
    direction = sin_cos(state.theta)
    accelerations = part_of_step(rates)(plant, direction, (state.x_dot, state.theta_dot), voltage)
    sample = Sample(
        time=index.astype(dt.dtype) * dt,
        elapsed=jnp.where((index > 0) & going, dt, 0.0),
        state=state,
        voltage=voltage,
        voltage_since=loop.voltage,
        voltage_until=until,
        mode=mode,
        mode_before=loop.mode,
        cart_acceleration=jnp.asarray(accelerations[0]),
        flag=flag,
        crossing=jnp.zeros_like(mode),
        crossing_speed=jnp.zeros_like(voltage),
    )
    return _Loop(state, mode, voltage, flag, changes), sample, _Instant(accelerations, direction)


def _advance(
    plant: CartPole, controller: Controller, loop: _Loop, instant: _Instant, dt: jax.Array, settings: Settings
) -> _Loop:
    """Integrates one step. A run that would leave the bounds, or become non-finite, is held where it is and flagged.

    A derivative in reverse passes through both branches of a `where`, and 0 times an infinity of the branch not taken
    is NaN. So a step that is about to go wrong (told by an Euler step) is not taken from where it would: it is taken
    from upright rest, where all is finite, and dropped. (A law that is itself not finite at a state it is asked about
    still gives NaN derivatives; those of this library are finite.)
    """
    state, method = loop.state, INTEGRATORS[settings.integrator]
    first, direction = instant
    ahead = state.x_dot + dt * first[0], state.theta_dot + dt * first[1]
    possible = (jnp.abs(ahead[0]) <= RUNAWAY_LIMIT) & (jnp.abs(ahead[1]) <= RUNAWAY_LIMIT)
    if settings.optimistic:  # values only, so nothing has to be safe, and what went wrong is computed again
        after, near = step_held_by_turns(plant, method, state, direction, loop.voltage, dt, first)
        right = possible & near & within_bounds(after)
        return loop._replace(state=after, flag=loop.flag | jnp.where(right, np.int32(0), np.int32(IN_DOUBT)))
    stopped = (loop.flag & STOPPED) != 0
    going = ~stopped & possible
    safe, safe_first = jax.tree.map(lambda value: jnp.where(going, value, 0.0), (state, first))
    if settings.clock == "continuous":
        after = step_continuous(plant, controller, method, safe, loop.mode, dt, safe_first)
    else:
        after = step_held(plant, method, safe, jnp.where(going, loop.voltage, 0.0), dt, safe_first)
    within, finite = part_of_step(_judged)(after, ahead)
    good = going & within
    reason = jnp.where(finite, np.int32(Flag.RUNAWAY), np.int32(Flag.NON_FINITE))
    state = jax.tree.map(lambda old, new: jnp.where(good, new, old), state, after)
    return loop._replace(state=state, flag=loop.flag | jnp.where(stopped | good, np.int32(0), reason))


def _judged(after: State, ahead: Pair) -> tuple[jax.Array, jax.Array]:
    """Whether the state after a step is within the bounds, and whether all of that step's numbers are finite."""
    total = ahead[0] + ahead[1] + after.x + after.x_dot + after.theta + after.theta_dot
    return within_bounds(after), jnp.isfinite(total)
