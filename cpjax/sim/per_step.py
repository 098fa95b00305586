"""The closed loop in equal steps: the controller is read at control instants, and its command is held in between.

At each step `_observe` reads the controller and takes a sample, `_advance` integrates to the next. On the continuous
clock every step is a control instant for the mode, and the law of the mode is evaluated in every stage.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal

from cpjax import runtime
from cpjax.compilation import one_function, part_of_step
from cpjax.controllers.protocol import ModeMemory, as_sampled, modes_in, start_memory
from cpjax.pytree import cast
from cpjax.returned import call, integer, like, pair, real
from cpjax.sim import failures, plants
from cpjax.sim.derivatives import blend_memory, holding, shift_of, shifted, tracked
from cpjax.sim.flags import CHATTER_LENGTH, IN_DOUBT, Flag, unknown
from cpjax.sim.integrators import INTEGRATORS
from cpjax.sim.kept import pack
from cpjax.sim.metrics import Fold, Sample
from cpjax.sim.plants import Plant, Tree
from cpjax.sim.scan import scan
from cpjax.sim.settings import Settings
from cpjax.sim.stepper import applied_voltage, dtype_of, step_continuous, step_held, step_held_incremental


class _Instant(NamedTuple):
    """What `_observe` computed and `_advance` needs again."""

    accelerations: Tree
    geometry: Tree


class Input(NamedTuple):
    """What the drive applies during one control period."""

    voltage: jax.Array
    held: jax.Array | None = None
    """What it would apply, had the controller's mode not changed; only for the derivative of the mean."""
    shift: jax.Array | None = None
    """By how much of the period that change of mode moves: value 0, with a derivative; as above."""

    @property
    def applied(self) -> jax.Array:
        """The voltage, with the derivative that the plant is to see."""
        return self.voltage if self.shift is None else shifted(self.voltage, self.held, self.shift)


class _Loop(NamedTuple):
    """The scan's carry."""

    state: Tree
    memory: Any
    """The controller's."""
    input: Input
    flag: jax.Array
    changes: jax.Array
    """Control instants in a row at which the mode changed."""


def simulate(
    start: Tree, plant: Plant, controller: Any, fold: Fold, dt: jax.Array, settings: Settings
) -> tuple[jax.Array | None, Sample, Any]:
    """Simulates one start; see `cpjax.sim.rollout.simulate`."""
    memory, given = start_controller(plant, controller, start, settings)
    flag = unknown((start, plant, controller))
    flag = jnp.where(flag != 0, np.int32(IN_DOUBT), flag) if settings.optimistic else flag
    loop = _Loop(start, memory, given, flag, jnp.zeros_like(flag))
    _, first, _ = _observe(plant, controller, loop, jnp.asarray(0), dt, settings)

    carry = (loop, call("metrics", fold, "init", first))
    run = one_function(functools.partial(_run, settings=settings), stacks=True)
    (loop, memory), samples = run(carry, plant, controller, fold, dt)
    after, last, _ = _observe(plant, controller, loop, jnp.asarray(settings.steps), dt, settings)
    clean = last._replace(flag=last.flag & ~IN_DOUBT)
    memory = _fold(
        fold, memory, clean, plant, loop.input, after.input, jnp.asarray(settings.steps), settings, update_metric
    )
    return samples, _saved(last, after), fold.finish(memory, clean)


def _run(
    carry: tuple[_Loop, Any], plant: Plant, controller: Any, fold: Fold, dt: jax.Array, settings: Settings
) -> tuple[tuple[_Loop, Any], jax.Array | None]:
    """Returns loop and metric after all steps, and the samples that are kept but for the last."""
    steps, every = settings.steps, settings.save_every

    def body(carry: tuple[_Loop, Any], index: jax.Array) -> tuple[tuple[_Loop, Any], jax.Array | None]:
        before, memory = carry
        loop, sample, instant = _observe(plant, controller, before, index, dt, settings)
        memory = _fold(
            fold, memory, sample, plant, before.input, loop.input, index, settings, part_of_step(update_metric)
        )
        saved = pack(_saved(sample, loop)) if every == 1 else None
        return (_advance(plant, controller, loop, instant, dt, settings), memory), saved

    def block(carry: tuple[_Loop, Any], index: jax.Array) -> tuple[tuple[_Loop, Any], jax.Array]:
        loop, sample, _ = _observe(plant, controller, carry[0], index, dt, settings)
        carry, _ = scan(body, carry, index + jnp.arange(every), "every_step")
        return carry, pack(_saved(sample, loop))

    if every is None:
        # With these options of the compiler, all that is remembered would be copied at each step.
        checkpoint = "segments" if runtime.fast_loops() else settings.checkpoint
        return scan(body, carry, jnp.arange(steps), checkpoint)
    if every == 1:
        return scan(body, carry, jnp.arange(steps), "every_step")
    return scan(block, carry, jnp.arange(0, steps, every), "every_step")


def start_controller(plant: Plant, controller: Any, start: Tree, settings: Settings) -> tuple[Any, Input]:
    """Returns the controller's memory before its first update, and the first input."""
    if settings.clock == "continuous":
        memory = start_memory(controller, start)
    else:
        firmware = as_sampled(tracked(controller) if settings.derivative == "mean" else controller)
        memory = cast(call("controller", firmware, "init", start), dtype_of(start))
        memory = jax.tree.map(jnp.asarray, memory)
    _, given = update_controller(plant, controller, memory, start, settings)
    return memory, given._replace(shift=None if given.shift is None else jnp.zeros_like(given.shift))


def update_controller(plant: Plant, controller: Any, memory: Any, state: Tree, settings: Settings) -> tuple[Any, Input]:
    """Runs the controller for one control instant: its new memory, and the input that the drive makes of its
    command."""
    if settings.clock == "continuous":
        mode = integer("controller.next_mode", call("controller", controller, "next_mode", state, memory.mode))
        return ModeMemory(mode), Input(applied_voltage(plant, controller, state, mode))
    if settings.derivative != "mean":
        updated, command = _updated(as_sampled(controller), memory, state)
        return updated, Input(plants.saturate(plant, command))
    updated, command = _updated(as_sampled(tracked(controller)), memory, state)
    unchanged, held = _updated(as_sampled(holding(controller)), memory, state)
    shift = shift_of(updated).astype(command.dtype)
    given = Input(plants.saturate(plant, command), plants.saturate(plant, held), shift)
    return blend_memory(updated, unchanged, shift), given


def _updated(controller: Any, memory: Any, state: Tree) -> tuple[Any, jax.Array]:
    returned = call("controller", controller, "update", memory, state)
    updated, command = pair("controller.update", returned, "the new memory and the command")
    dtype = dtype_of(state)
    return like("controller.update: memory", cast(updated, dtype), memory), real("controller.update", command, dtype)


def _fold(
    fold: Fold,
    memory: Any,
    sample: Sample,
    plant: Plant,
    before: Input,
    now: Input,
    index: jax.Array,
    settings: Settings,
    update: Callable[..., Any],
) -> Any:
    """Returns the metric's memory after a sample, with the derivative of the mean if that is asked for."""
    new = like("metrics.update", update(fold, memory, sample), memory)
    if now.held is None or now.shift is None or before.held is None:
        return new
    if not _sees_the_voltage(fold, memory, sample):
        return new
    # A metric need not be linear in the voltage. So it is computed with the other voltage too: with that of the period
    # before, which is still applied unless this is a control instant, and with that of the period that begins.
    instant = index % settings.steps_per_control == 0
    since = sample._replace(voltage_since=before.held, voltage=jnp.where(instant, sample.voltage, now.held))
    result = shifted(new, update(fold, memory, _completed(plant, since)), before.shift)
    begun = sample._replace(voltage=now.held)
    return shifted(result, update(fold, memory, _completed(plant, begun)), jnp.where(instant, now.shift, 0.0))


def _sees_the_voltage(fold: Fold, memory: Any, sample: Sample) -> bool:
    """Whether a metric's update may depend on the voltage, or on what the plant keeps because of it."""

    def update(voltages: Any) -> Any:
        voltage, since, outputs = voltages
        return update_metric(fold, memory, sample._replace(voltage=voltage, voltage_since=since, outputs=outputs))

    jaxpr = jax.make_jaxpr(update)((sample.voltage, sample.voltage_since, sample.outputs)).jaxpr
    reached = set(jaxpr.invars)
    for equation in jaxpr.eqns:
        if any(not isinstance(v, Literal) and v in reached for v in equation.invars):
            reached.update(equation.outvars)
    return any(not isinstance(v, Literal) and v in reached for v in jaxpr.outvars)


def _completed(plant: Plant, sample: Sample) -> Sample:
    """Returns a sample whose voltage has been replaced, with what follows from it."""
    q, v = plants.coordinates(plant, sample.state)
    acceleration = plants.accelerations(plant, plants.geometry(plant, q), v, sample.voltage)
    return sample._replace(outputs=plants.outputs(plant, sample.state, acceleration, sample.voltage))


def _saved(sample: Sample, loop: _Loop) -> Sample:
    """Returns a sample as it is saved: its voltage has the derivative that the plant sees."""
    return sample if loop.input.held is None else sample._replace(voltage=loop.input.applied)


def update_metric(fold: Fold, memory: Any, sample: Sample) -> Any:
    """Returns a metric's memory after a sample."""
    return call("metrics", fold, "update", memory, sample)


def mode_of(memory: Any) -> jax.Array:
    """Returns the mode that a trajectory records: of the outermost part of the memory that has one, else 0."""
    modes = modes_in(memory)
    return modes[0].mode if modes else jnp.asarray(0, dtype=jnp.int32)


def _observe(
    plant: Plant, controller: Any, loop: _Loop, index: jax.Array, dt: jax.Array, settings: Settings
) -> tuple[_Loop, Sample, _Instant]:
    """Reads the controller at step `index`, if that is a control instant, takes a sample, and hands the accelerations
    at this instant on to `_advance`, whose first stage they are."""
    state = loop.state
    memory, given = update_controller(plant, controller, loop.memory, state, settings)
    before = mode_of(loop.memory)
    changes = jnp.where(mode_of(memory) != before, loop.changes + 1, 0)
    until = applied_voltage(plant, controller, state, before) if settings.clock == "continuous" else None
    if settings.steps_per_control > 1:
        instant = index % settings.steps_per_control == 0
        memory, given, changes = jax.tree.map(
            lambda new, old: jnp.where(instant, new, old),
            (memory, given, changes),
            (loop.memory, loop.input, loop.changes),
        )
    voltage = given.voltage
    flag = loop.flag | jnp.where(changes >= CHATTER_LENGTH, np.int32(Flag.CHATTERING), np.int32(0))
    # Optimistic, no run is stopped: one that should be is in doubt.
    going = jnp.asarray(True) if settings.optimistic else ~failures.is_stopped(flag)
    q, v = plants.coordinates(plant, state)
    geometry = plants.geometry(plant, q)
    accelerations = part_of_step(plants.accelerations)(plant, geometry, v, voltage)
    mode = mode_of(memory)
    sample = Sample(
        time=index.astype(dt.dtype) * dt,
        elapsed=jnp.where((index > 0) & going, dt, 0.0),
        state=state,
        voltage=voltage,
        voltage_since=loop.input.voltage,
        voltage_until=until,
        mode=mode,
        mode_before=before,
        outputs=plants.outputs(plant, state, accelerations, voltage),
        plant_mode=(),
        flag=flag,
        crossing=jnp.zeros_like(mode),
        crossing_speed=jnp.zeros_like(voltage),
    )
    loop = _Loop(state, memory, given, flag, changes)
    if given.held is not None:
        accelerations = part_of_step(plants.accelerations)(plant, geometry, v, given.applied)
    return loop, sample, _Instant(accelerations, geometry)


def _advance(plant: Plant, controller: Any, loop: _Loop, instant: _Instant, dt: jax.Array, settings: Settings) -> _Loop:
    """Integrates one step; a run that goes wrong is held and flagged: see `failures.py`."""
    state, method = loop.state, INTEGRATORS[settings.integrator]
    first, geometry = instant
    outlook = failures.look_ahead(plant, plants.coordinates(plant, state)[1], first, dt)
    if settings.optimistic:  # values only, so nothing has to be safe, and what went wrong is computed again
        after, near = step_held_incremental(plant, method, state, geometry, loop.input.voltage, dt, first)
        right = outlook.possible & near & plants.within(after, plant.limits)
        return loop._replace(state=after, flag=loop.flag | jnp.where(right, np.int32(0), np.int32(IN_DOUBT)))
    stopped = failures.is_stopped(loop.flag)
    going = ~stopped & outlook.possible
    safe, safe_first, safe_voltage = failures.safe(going, (state, first, loop.input.applied))
    if settings.clock == "continuous":
        mode = mode_of(loop.memory)
        after = step_continuous(plant, controller, method, safe, mode, dt, safe_first)
    else:
        after = step_held(plant, method, safe, safe_voltage, dt, safe_first)
    within, reason = failures.verdict(plant, after, outlook)
    good = going & within
    state = jax.tree.map(lambda old, new: jnp.where(good, new, old), state, after)
    return loop._replace(state=state, flag=loop.flag | jnp.where(stopped | good, np.int32(0), reason))
