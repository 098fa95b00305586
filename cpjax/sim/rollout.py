"""Closed-loop rollouts: from a plant, a controller and a start to a trajectory and its metrics.

Everything here is for one start; batches are `jax.vmap` of it (`cpjax.sweep` does so). The work is done by `_simulate`,
one compiled scan: at each step `_observe` reads the controller and takes a sample, `_advance` integrates to the next.
"""

import functools
import math
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import jax
import jax.numpy as jnp
from jax import lax

from cpjax.controllers.protocol import Controller, Law, as_controller
from cpjax.errors import InputError
from cpjax.numeric.trigonometry import sin_cos
from cpjax.plant import CartPole
from cpjax.pytree import cast, check, is_traced, pytree
from cpjax.sim.flags import CHATTER_LENGTH, STOPPED, Flag
from cpjax.sim.integrators import INTEGRATORS
from cpjax.sim.metrics import Fold, ProtocolMetrics, Sample
from cpjax.sim.stepper import Pair, applied_voltage, step_continuous, step_held
from cpjax.state import ANGLE_LIMIT, RUNAWAY_LIMIT, State, checked_start

Clock: TypeAlias = Literal["continuous", "sampled"]
Switching: TypeAlias = Literal["per_step"]


@pytree
class Trajectory:
    """Samples of a rollout, all of one length; the first is at t = 0, the last at the end.

    Attributes:
      time: (n,) [s].
      state: State of (n,) arrays. theta is not wrapped.
      voltage: (n,) applied from that instant on, clipped [V].
      mode: (n,) int32, from that instant on.
      cart_acceleration: (n,) x'' from that instant on [m/s^2].
      flag: () int32, bits of `Flag` for the whole run; 0 is clean.
      metrics: what the run's fold returned, over every step whether saved or not.
    """

    time: jax.Array
    state: State
    voltage: jax.Array
    mode: jax.Array
    cart_acceleration: jax.Array
    flag: jax.Array
    metrics: Any


def rollout(
    plant: CartPole,
    controller: Controller | Law,
    start: State,
    *,
    duration: float,
    dt: float,
    clock: Clock = "continuous",
    control_period: float | None = None,
    switching: Switching = "per_step",
    integrator: str = "rk4",
    save_every: int = 1,
    metrics: Fold | None = None,
) -> Trajectory:
    """Simulates the closed loop from one start. Works under `jit`, `vmap` and differentiation.

    The start's dtype is the rollout's: plant and controller are cast to it. Two calls that differ only in numbers
    (start, gains, parameters, dt at an equal count of steps) share one compilation.

    Args:
      start: of scalars. For many starts, `cpjax.sweep` or `jax.vmap`.
      duration: a whole number of steps [s].
      dt: the integrator's step [s].
      clock: "continuous" evaluates the law in every stage of the integrator; "sampled" evaluates law and gate once per
        control period and holds the voltage (zero-order hold).
      control_period: of the sampled clock, a whole number of steps [s]; by default one step.
      switching: "per_step": the mode is read at the control instants and kept in between.
      integrator: a key of `cpjax.sim.integrators.INTEGRATORS`.
      save_every: keep every so many steps; must divide the number of steps.
      metrics: a fold over all steps; by default `ProtocolMetrics()`.

    Raises:
      InputError: bad arguments, named; never because of what the simulation does (see `Trajectory.flag`).
    """
    if save_every is None:
        raise InputError("save_every", save_every, "a whole number of steps, at least 1; cpjax.measure saves nothing")
    settings = check_settings(duration, dt, clock, control_period, switching, integrator, save_every)
    start, dtype = checked_start(start, "start", batched=False)
    arguments = _cast_arguments(plant, controller, metrics, dt, dtype)
    trajectory: Trajectory = _simulate(start, *arguments, settings=settings)
    return trajectory


def measure(
    plant: CartPole,
    controller: Controller | Law,
    start: State,
    *,
    duration: float,
    dt: float,
    clock: Clock = "continuous",
    control_period: float | None = None,
    switching: Switching = "per_step",
    integrator: str = "rk4",
    metrics: Fold | None = None,
) -> Any:
    """What `rollout(...).metrics` would be, without storing a trajectory. Arguments and errors as for `rollout`."""
    settings = check_settings(duration, dt, clock, control_period, switching, integrator, None)
    start, dtype = checked_start(start, "start", batched=False)
    return _simulate(start, *_cast_arguments(plant, controller, metrics, dt, dtype), settings=settings)


class _Settings(NamedTuple):
    """What a compilation depends on, beside structures and dtypes."""

    steps: int
    save_every: int | None
    """None: metrics only."""
    clock: Clock
    steps_per_control: int
    integrator: str


class _Loop(NamedTuple):
    """The scan's carry."""

    state: State
    mode: jax.Array
    voltage: jax.Array
    flag: jax.Array
    changes: jax.Array
    """Control instants in a row at which the mode changed."""


@functools.partial(jax.jit, static_argnames="settings")
def _simulate(
    start: State, plant: CartPole, controller: Controller, fold: Fold, dt: jax.Array, *, settings: _Settings
) -> Any:
    steps, every = settings.steps, settings.save_every
    none = jnp.zeros_like(start.x, dtype=jnp.int32)
    mode = controller.start_mode(start)
    voltage = applied_voltage(plant, controller, start, mode)
    unknown = [jnp.any(jnp.isnan(leaf)) for leaf in jax.tree.leaves((start, plant, controller))]
    flag = jnp.where(jnp.any(jnp.stack(unknown)), int(Flag.NON_FINITE), none)
    loop = _Loop(start, mode, voltage, flag, none)
    _, first, _ = _observe(plant, controller, loop, jnp.asarray(0), dt, settings)

    def body(carry: tuple[_Loop, Any], index: jax.Array) -> tuple[tuple[_Loop, Any], Sample | None]:
        loop, memory = carry
        loop, sample, rates = _observe(plant, controller, loop, index, dt, settings)
        memory = fold.update(memory, sample)
        loop = _advance(plant, controller, loop, rates, dt, settings)
        return (loop, memory), (sample if every == 1 else None)

    def block(carry: tuple[_Loop, Any], index: jax.Array) -> tuple[tuple[_Loop, Any], Sample]:
        _, sample, _ = _observe(plant, controller, carry[0], index, dt, settings)
        carry, _ = lax.scan(body, carry, index + jnp.arange(every))
        return carry, sample

    carry = (loop, fold.init(first))
    if every is None or every == 1:
        carry, samples = lax.scan(body, carry, jnp.arange(steps))
    else:
        carry, samples = lax.scan(block, carry, jnp.arange(0, steps, every))
    loop, memory = carry
    _, last, _ = _observe(plant, controller, loop, jnp.asarray(steps), dt, settings)
    result = fold.finish(fold.update(memory, last), last)
    if samples is None:
        return result
    samples = jax.tree.map(lambda many, one: jnp.concatenate([many, one[None]]), samples, last)
    return Trajectory(
        time=samples.time,
        state=samples.state,
        voltage=samples.voltage,
        mode=samples.mode,
        cart_acceleration=samples.cart_acceleration,
        flag=last.flag,
        metrics=result,
    )


def _observe(
    plant: CartPole, controller: Controller, loop: _Loop, index: jax.Array, dt: jax.Array, settings: _Settings
) -> tuple[_Loop, Sample, Pair]:
    """Reads the controller at step `index`, if that is a control instant, takes a sample, and hands the accelerations
    at this instant on to `_advance`, whose first stage they are."""
    state = loop.state
    mode = controller.next_mode(state, loop.mode)
    voltage = applied_voltage(plant, controller, state, mode)
    changes = jnp.where(mode != loop.mode, loop.changes + 1, 0)
    if settings.clock == "continuous":
        voltage_before = applied_voltage(plant, controller, state, loop.mode)
    else:
        voltage_before = loop.voltage
        if settings.steps_per_control > 1:
            instant = index % settings.steps_per_control == 0
            mode = jnp.where(instant, mode, loop.mode)
            voltage = jnp.where(instant, voltage, loop.voltage)
            changes = jnp.where(instant, changes, loop.changes)
    flag = loop.flag | jnp.where(changes >= CHATTER_LENGTH, int(Flag.CHATTERING), 0)
    sin, cos = sin_cos(state.theta)
    force = plant.motor.force(voltage, state.x_dot)
    rates = plant.acceleration(sin, cos, (state.x_dot, state.theta_dot), force)
    sample = Sample(
        time=index.astype(dt.dtype) * dt,
        elapsed=jnp.where((index > 0) & ((flag & STOPPED) == 0), dt, 0.0),
        state=state,
        voltage=voltage,
        voltage_before=voltage_before,
        mode=mode,
        cart_acceleration=jnp.asarray(rates[0]),
        flag=flag,
    )
    return _Loop(state, mode, voltage, flag, changes), sample, rates


def _advance(
    plant: CartPole, controller: Controller, loop: _Loop, rates: Pair, dt: jax.Array, settings: _Settings
) -> _Loop:
    """Integrates one step. A run that would leave the bounds, or become non-finite, is held where it is and flagged.

    A derivative in reverse passes through both branches of a `where`, and 0 times an infinity of the branch not taken
    is NaN. So a step that is about to go wrong (told by an Euler step) is not taken from where it would: it is taken
    from upright rest, where all is finite, and dropped. (A law that is itself not finite at a state it is asked about
    still gives NaN derivatives; those of this library are finite.)
    """
    state, method = loop.state, INTEGRATORS[settings.integrator]
    stopped = (loop.flag & STOPPED) != 0
    ahead = jnp.maximum(jnp.abs(state.x_dot + dt * rates[0]), jnp.abs(state.theta_dot + dt * rates[1]))
    going = ~stopped & (ahead <= RUNAWAY_LIMIT)
    safe, safe_rates = jax.tree.map(lambda value: jnp.where(going, value, 0.0), (state, rates))
    if settings.clock == "continuous":
        after = step_continuous(plant, controller, method, safe, loop.mode, dt, safe_rates)
    else:
        after = step_held(plant, method, safe, jnp.where(going, loop.voltage, 0.0), dt, safe_rates)
    fastest = jnp.maximum(jnp.abs(after.x_dot), jnp.abs(after.theta_dot))
    within = (jnp.maximum(jnp.abs(after.x), fastest) <= RUNAWAY_LIMIT) & (jnp.abs(after.theta) <= ANGLE_LIMIT)
    good = going & within
    finite = jnp.isfinite(ahead + after.x + after.x_dot + after.theta + after.theta_dot)
    reason = jnp.where(finite, int(Flag.RUNAWAY), int(Flag.NON_FINITE))
    state = jax.tree.map(lambda old, new: jnp.where(good, new, old), state, after)
    return loop._replace(state=state, flag=loop.flag | jnp.where(stopped | good, 0, reason))


def _cast_arguments(
    plant: Any, controller: Any, fold: Fold | None, dt: float, dtype: Any
) -> tuple[CartPole, Controller, Fold, jax.Array]:
    if not isinstance(plant, CartPole):
        raise InputError("plant", plant, "a cpjax.CartPole")
    fold = ProtocolMetrics() if fold is None else fold
    if isinstance(fold, type) or not all(callable(getattr(fold, name, None)) for name in ("init", "update", "finish")):
        raise InputError("metrics", fold, "a fold, such as cpjax.ProtocolMetrics()")
    controller = as_controller(controller)
    for name, part in (("plant", plant), ("controller", controller), ("metrics", fold)):
        check(name, part)
    return (
        cast(plant, dtype),
        cast(controller, dtype),
        cast(fold, dtype),
        jnp.asarray(dt, dtype=dtype),
    )


def check_settings(
    duration: Any,
    dt: Any,
    clock: Clock,
    control_period: Any,
    switching: Any,
    integrator: Any,
    save_every: Any,
) -> _Settings:
    """The settings of a rollout; `save_every` None for metrics only.

    Raises:
      InputError: as `rollout` does.
    """
    dt = _positive_seconds("dt", dt)
    duration = _positive_seconds("duration", duration)
    if dt > duration:
        raise InputError("dt", dt, f"at most the duration, {duration:g} s")
    steps = _whole_steps("duration", duration, dt)
    if not isinstance(clock, str) or clock not in get_args(Clock):
        raise InputError("clock", clock, "continuous or sampled")
    if not isinstance(switching, str) or switching != "per_step":
        raise InputError("switching", switching, "per_step")
    if not isinstance(integrator, str) or integrator not in INTEGRATORS:
        raise InputError("integrator", integrator, "one of " + ", ".join(INTEGRATORS))
    steps_per_control = 1
    if control_period is not None:
        if clock != "sampled":
            raise InputError("control_period", control_period, "absent unless clock is sampled")
        period = _positive_seconds("control_period", control_period)
        if period < dt * (1 - 1e-6):
            raise InputError("control_period", control_period, f"at least one step, dt = {dt:g} s")
        steps_per_control = _whole_steps("control_period", period, dt)
    if save_every is not None:
        if isinstance(save_every, bool) or not isinstance(save_every, int) or save_every < 1:
            raise InputError("save_every", save_every, "a whole number of steps, at least 1")
        if steps % save_every:
            raise InputError("save_every", save_every, f"a divisor of the number of steps, {steps}")
    return _Settings(steps, save_every, clock, steps_per_control, integrator)


def _positive_seconds(field: str, value: Any) -> float:
    allowed = "a finite number above 0 [s], known when the rollout is compiled"
    if is_traced(value) or isinstance(value, (bool, str)):
        raise InputError(field, value, allowed)
    try:
        seconds = float(value)
    except (TypeError, ValueError, OverflowError) as problem:
        raise InputError(field, value, allowed) from problem
    if not (math.isfinite(seconds) and seconds > 0):
        raise InputError(field, value, allowed)
    return seconds


def _whole_steps(field: str, seconds: float, dt: float) -> int:
    """How many steps of `dt` make `seconds`; decimal fractions such as 0.3 / 0.1 count as whole."""
    if not seconds / dt < 2**31:
        raise InputError(field, seconds, f"fewer than 2^31 steps of dt = {dt:g} s")
    steps = round(seconds / dt)
    if abs(seconds / dt - steps) > 1e-6 * steps:
        raise InputError(field, seconds, f"a whole multiple of dt = {dt:g} s")
    return steps
