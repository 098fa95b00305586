"""The closed loop in equal steps: the controller is updated at control instants, and its command is held in between.

At each step `_observe` updates the controller and takes a sample, and `_advance` integrates to the next. On the
continuous clock every step is a control instant for the mode, and the law of the mode is evaluated in every stage.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal
from jaxtyping import Array, Float, Int

from cpjax.backend.single_kernel import outline, single_kernel
from cpjax.checks import arrays, call, like
from cpjax.numeric.selection import where
from cpjax.pytree import cast
from cpjax.sim import failures, plants
from cpjax.sim.control import Control, start_control, update_control
from cpjax.sim.derivatives import shifted, warn_of_memory
from cpjax.sim.flags import CHATTER_LENGTH, NEEDS_RECOMPUTE, Flag, nonfinite_flag, nonfinite_input
from cpjax.sim.in_step import step_with_event
from cpjax.sim.integrators import INTEGRATORS, Integrator, Step
from cpjax.sim.metrics import Metric, MetricState, Sample, finalize_name
from cpjax.sim.plants import Plant, PlantState, Tree
from cpjax.sim.saved import pack
from cpjax.sim.scan import scan
from cpjax.sim.settings import Settings
from cpjax.sim.stepper import applied_voltage, step_continuous, step_held, step_held_incremental


class _Instant(NamedTuple):
    """Results of `_observe` that `_advance` reuses."""

    accelerations: Tree
    geometry: Tree
    plant: Any
    """The plant as it is during the step."""
    drive: Tree
    """Memory of its drive after the step."""


class _Loop(NamedTuple):
    """Carry of the scan."""

    state: PlantState
    control: Control
    flag: Int[Array, ""]
    changes: Int[Array, ""]
    """Number of consecutive control instants at which the mode changed."""
    plant_mode: Tree = ()
    """The plant's own mode; () for a plant without events."""
    drive: Tree = ()
    """Memory of the plant's drive; () for one without."""


_Carry: TypeAlias = tuple[_Loop, MetricState]


def simulate(
    start: PlantState, plant: Plant, controller: Any, metric: Metric, dt: Step, settings: Settings
) -> tuple[Float[Array, "rows columns"] | None, Sample, Any]:
    """Simulates one initial state; see `cpjax.sim.rollout.simulate`."""
    control = start_control(plant, controller, start, settings)
    flag = nonfinite_flag((start, plant, controller))
    flag = where(flag != 0, np.int32(NEEDS_RECOMPUTE), flag) if settings.fast_path else flag
    plant_mode = plants.start_mode(plant, *plants.coordinates(plant, start))
    loop = _Loop(start, control, flag, jnp.zeros_like(flag), plant_mode, plants.start_drive(plant, start))
    _, first, _ = _observe(plant, controller, loop, jnp.asarray(0), dt, settings)

    started = start_metric(metric, first)
    if control.blend is not None and control.blend.memory_echo and sees_the_voltage(metric, started, first):
        warn_of_memory()
    carry = (loop, started)
    run = single_kernel(functools.partial(_run, settings=settings), stacks=True)
    (loop, memory), samples = run(carry, plant, controller, metric, dt)
    after, last, instant = _observe(plant, controller, loop, jnp.asarray(settings.steps), dt, settings)
    broken = nonfinite_input(last.voltage)  # of the last instant, after which no step looks at it
    broken = where(broken != 0, np.int32(NEEDS_RECOMPUTE), broken) if settings.fast_path else broken
    last = last._replace(flag=last.flag | broken)
    clean = last._replace(flag=last.flag & ~NEEDS_RECOMPUTE)
    now = instant.plant
    memory = _fold(
        metric, memory, clean, now, loop.control, after.control, jnp.asarray(settings.steps), settings, update_metric
    )
    return samples, _saved(now, last, after), finalize_metric(metric, memory, clean)


def _run(
    carry: _Carry, plant: Plant, controller: Any, metric: Metric, dt: Step, settings: Settings
) -> tuple[_Carry, Float[Array, "rows columns"] | None]:
    """Returns loop and metric state after all steps, and the saved samples except the last."""
    steps, every = settings.steps, settings.save_every

    def body(carry: _Carry, index: Int[Array, ""]) -> tuple[_Carry, Float[Array, " columns"] | None]:
        before, memory = carry
        loop, sample, instant = _observe(plant, controller, before, index, dt, settings)
        now = instant.plant
        memory = _fold(
            metric, memory, sample, now, before.control, loop.control, index, settings, outline(update_metric)
        )
        saved = pack(_saved(now, sample, loop), plant) if every == 1 else None
        return (_advance(controller, loop, instant, dt, settings), memory), saved

    def block(carry: _Carry, index: Int[Array, ""]) -> tuple[_Carry, Float[Array, " columns"]]:
        loop, sample, instant = _observe(plant, controller, carry[0], index, dt, settings)
        carry, _ = scan(body, carry, index + jnp.arange(every), "every_step")
        return carry, pack(_saved(instant.plant, sample, loop), plant)

    if every is None:
        return scan(body, carry, jnp.arange(steps), settings.checkpoint)
    if every == 1:
        return scan(body, carry, jnp.arange(steps), "every_step")
    return scan(block, carry, jnp.arange(0, steps, every), "every_step")


def _fold(
    metric: Metric,
    memory: MetricState,
    sample: Sample,
    plant: Plant,
    before: Control,
    now: Control,
    index: Int[Array, ""],
    settings: Settings,
    update: Callable[..., MetricState],
) -> MetricState:
    """Returns the metric state after a sample, with the derivative of the mean if that is requested."""
    new = update(metric, memory, sample)
    if now.blend is None or before.blend is None or not sees_the_voltage(metric, memory, sample):
        return new
    # A metric need not be linear in the voltage, so it is also computed with the other voltage: with that of the
    # previous period, still applied unless this is a control instant, and with that of the period that begins.
    instant = index % settings.steps_per_control == 0 if settings.steps_per_control > 1 else np.bool_(True)
    since = sample._replace(
        voltage_since=before.blend.held,
        voltage=where(instant, sample.voltage, now.blend.held),
        mode_before=where(instant, before.blend.mode, now.blend.mode),
        mode=where(instant, sample.mode, now.blend.mode),
    )
    result = shifted(new, update(metric, memory, _completed(plant, since)), before.blend.shift)
    begun = sample._replace(voltage=now.blend.held, mode=now.blend.mode)
    return shifted(result, update(metric, memory, _completed(plant, begun)), where(instant, now.blend.shift, 0.0))


def sees_the_voltage(metric: Metric, memory: MetricState, sample: Sample) -> bool:
    """Returns whether a metric's update may depend on the voltage or the mode, also through the plant's outputs."""

    def update(voltages: Any) -> Any:
        names = ("voltage", "voltage_since", "outputs", "mode", "mode_before")
        return update_metric(metric, memory, sample._replace(**dict(zip(names, voltages, strict=True))))

    given = sample.voltage, sample.voltage_since, sample.outputs, sample.mode, sample.mode_before
    jaxpr = jax.make_jaxpr(update)(given).jaxpr
    reached = set(jaxpr.invars)
    for equation in jaxpr.eqns:
        if any(not isinstance(v, Literal) and v in reached for v in equation.invars):
            reached.update(equation.outvars)
    return any(not isinstance(v, Literal) and v in reached for v in jaxpr.outvars)


def _completed(plant: Plant, sample: Sample) -> Sample:
    """Returns a sample whose voltage has been replaced, with its outputs recomputed."""
    q, v = plants.coordinates(plant, sample.state)
    acceleration = plants.accelerations(plant, plants.geometry(plant, q), v, sample.voltage, sample.plant_mode)
    return sample._replace(outputs=plants.outputs(plant, sample.state, acceleration, sample.voltage))


def _saved(plant: Plant, sample: Sample, loop: _Loop) -> Sample:
    """Returns a sample as it is saved: with the derivative of the voltage that the plant receives."""
    return sample if loop.control.blend is None else _completed(plant, sample._replace(voltage=loop.control.applied))


def update_metric(metric: Metric, memory: MetricState, sample: Sample) -> MetricState:
    """Returns a metric's state after a sample."""
    updated = cast(arrays("metrics.update", call("metrics", metric, "update", memory, sample)), sample.time.dtype)
    return like("metrics.update", updated, memory)


def start_metric(metric: Metric, first: Sample) -> MetricState:
    """Returns a metric's state before its first update, in the rollout's dtype."""
    begun = arrays("metrics.init", call("metrics", metric, "init", first))
    return jax.tree.map(jnp.asarray, cast(begun, first.time.dtype))


def finalize_metric(metric: Metric, memory: MetricState, last: Sample) -> Any:
    """Returns the result of a metric."""
    name = finalize_name(metric)
    return arrays(f"metrics.{name}", call("metrics", metric, name, memory, last), keys=False)


def _observe(
    plant: Plant, controller: Any, loop: _Loop, index: Int[Array, ""], dt: Step, settings: Settings
) -> tuple[_Loop, Sample, _Instant]:
    """Updates the controller at step `index`, if that is a control instant, takes a sample, and returns the
    accelerations at this instant, which are the first stage of `_advance`."""
    state = loop.state
    control = update_control(plant, controller, loop.control, state, settings)
    before = loop.control.mode
    changes = where(control.mode != before, loop.changes + 1, 0)
    until = applied_voltage(plant, controller, state, before) if settings.clock == "continuous" else None
    if settings.steps_per_control > 1:
        instant = index % settings.steps_per_control == 0
        new, old = (control, changes), (loop.control, loop.changes)
        control, changes = jax.tree.map(lambda x, y: where(instant, x, y), new, old)
    voltage, mode = control.voltage, control.mode
    flag = loop.flag | where(changes >= CHATTER_LENGTH, np.int32(Flag.CHATTERING), np.int32(0))
    # The fast path never stops a run; it marks it for recomputation.
    going = jnp.asarray(True) if settings.fast_path else ~failures.is_stopped(flag)
    plant, drive = plants.during(plant, loop.drive, index, dt, state, control.applied)
    q, v = plants.coordinates(plant, state)
    geometry = plants.geometry(plant, q)
    plant_mode = plants.release(plant, q, v, control.applied, loop.plant_mode)
    accelerations = outline(plants.accelerations)(plant, geometry, v, voltage, plant_mode)
    sample = Sample(
        time=index.astype(dt.dtype) * dt,
        elapsed=where((index > 0) & going, dt, 0.0),
        state=state,
        voltage=voltage,
        voltage_since=loop.control.voltage,
        voltage_until=until,
        mode=mode,
        mode_before=before,
        outputs=plants.outputs(plant, state, accelerations, voltage),
        plant_mode=plant_mode,
        flag=flag,
        crossing=jnp.zeros_like(mode),
        crossing_speed=jnp.zeros_like(voltage),
    )
    if control.blend is not None:
        accelerations = outline(plants.accelerations)(plant, geometry, v, control.applied, plant_mode)
    loop = _Loop(state, control, flag, changes, plant_mode, loop.drive)
    return loop, sample, _Instant(accelerations, geometry, plant, drive)


def _advance(controller: Any, loop: _Loop, instant: _Instant, dt: Step, settings: Settings) -> _Loop:
    """Integrates one step; a failed run is held and flagged: see `failures.py`."""
    state, method = loop.state, INTEGRATORS[settings.integrator]
    first, geometry, plant, drive = instant
    loop = loop._replace(drive=drive)
    outlook = failures.look_ahead(plant, plants.coordinates(plant, state)[1], first, dt)
    if settings.fast_path:  # values only: no guarded derivatives, and failed runs are recomputed
        plant_mode, near = loop.plant_mode, jnp.asarray(True)
        if plants.has_events(plant):
            after, plant_mode = _stepped(plant, method, state, plant_mode, loop.control.voltage, dt, first)
        else:
            after, near = step_held_incremental(plant, method, state, geometry, loop.control.voltage, dt, first)
        right = outlook.possible & near & plants.within(after, plant.limits)
        flag = loop.flag | where(right, np.int32(0), np.int32(NEEDS_RECOMPUTE))
        return loop._replace(state=after, flag=flag, plant_mode=plant_mode)
    stopped = failures.is_stopped(loop.flag)
    going = ~stopped & outlook.possible
    safe, safe_first, safe_voltage = failures.safe(going, (state, first, loop.control.applied))
    plant_mode = loop.plant_mode
    if plants.has_events(plant):
        after, plant_mode = _stepped(plant, method, safe, plant_mode, safe_voltage, dt, safe_first)
    elif settings.clock == "continuous":
        after = step_continuous(plant, controller, method, safe, loop.control.mode, dt, safe_first)
    else:
        after = step_held(plant, method, safe, safe_voltage, dt, safe_first)
    within, reason = failures.verdict(plant, after, outlook)
    good = going & within
    state, plant_mode = jax.tree.map(
        lambda old, new: where(good, new, old), (state, loop.plant_mode), (after, plant_mode)
    )
    return loop._replace(
        state=state, plant_mode=plant_mode, flag=loop.flag | where(stopped | good, np.int32(0), reason)
    )


def _stepped(
    plant: Plant, method: Integrator, state: PlantState, mode: Tree, u: Float[Array, ""], dt: Step, first: Tree
) -> tuple[PlantState, Tree]:
    """Returns state and mode of a plant with events after one step."""
    q, v, mode = step_with_event(plant, method, *plants.coordinates(plant, state), mode, u, dt, first)
    return plants.state_of(plant, q, v), mode
