"""The closed loop with its events located inside the steps: see `switching.py`.

Each iteration is one step of the state machine there. On the continuous clock the events are the controller's changes
of mode, the plant's own events, and the instants at which the voltage reaches or leaves its limit: there the vector
field has a kink, across which a Runge-Kutta step and its derivatives lose their order. On the sampled clock the input
is held between control instants, so that only the plant's own events remain.
"""

import functools
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from cpjax.backend.single_kernel import outline, single_kernel
from cpjax.errors import InputError
from cpjax.numeric.selection import where
from cpjax.sim import failures, plants
from cpjax.sim.closed_loop import GATE, GATE_CROSSING, LIMIT, ContinuousLoop, HeldLoop, HeldMode, System
from cpjax.sim.control import Control, start_control, update_control
from cpjax.sim.flags import CHATTER_LENGTH, Flag, nonfinite_flag, nonfinite_input
from cpjax.sim.integrators import INTEGRATORS, Integrator, Step
from cpjax.sim.metrics import Metric, MetricState, Sample
from cpjax.sim.per_step import finalize_metric, sees_the_voltage, start_metric, update_metric
from cpjax.sim.plants import Plant, PlantState
from cpjax.sim.saved import pack
from cpjax.sim.scan import scan
from cpjax.sim.settings import Settings
from cpjax.sim.switching import LANDED, RUN, Motion, iterate, observe, pick, start_motion


class _Loop(NamedTuple):
    """Carry of the scan."""

    motion: Motion
    flag: Int[Array, ""]
    voltage: Float[Array, ""]
    """Voltage at the previous sample [V]."""
    mode: Int[Array, ""]
    """Mode at the previous sample."""
    control: Control | None
    """Controller on the sampled clock, else None."""
    changes: Int[Array, ""]
    """Number of consecutive control instants at which the mode changed, on the sampled clock."""


_Carry: TypeAlias = tuple[_Loop, MetricState]


def simulate(
    start: PlantState, plant: Plant, controller: Any, metric: Metric, dt: Step, settings: Settings
) -> tuple[Float[Array, "rows columns"] | None, Sample, Any]:
    """Simulates one initial state; see `cpjax.sim.rollout.simulate`."""
    q, v = plants.coordinates(plant, start)
    flag = nonfinite_flag((start, plant, controller))
    system: System
    mode: Any
    control = None
    if settings.clock == "continuous":
        system = ContinuousLoop(plant, controller)
        mode = system.start_mode(start)
    else:
        system = HeldLoop(plant)
        control = start_control(plant, controller, start, settings)
        control = update_control(plant, controller, control, start, settings)
        mode = HeldMode(control.applied, plants.release(plant, q, v, control.applied, plants.start_mode(plant, q, v)))
    motion = start_motion(system, q, v, mode, dt)
    loop = _Loop(motion, flag, motion.current.output, _law(motion, control), control, jnp.zeros_like(flag))
    first = _sample(plant, loop, motion, dt)
    started = start_metric(metric, first)
    if settings.derivative == "mean" and sees_the_voltage(metric, started, first):
        allowed = "pathwise, for a plant with events and a metric that depends on the voltage"
        raise InputError("derivative", "mean", allowed)

    run = single_kernel(functools.partial(_run, settings=settings), stacks=True)
    carry = (loop, update_metric(metric, started, first))
    carry, kept = run(carry, plant, controller, metric, dt)
    loop, memory = carry
    last = _sample(plant, loop, loop.motion, dt)
    last = last._replace(flag=last.flag | nonfinite_input(last.voltage))
    samples = None
    if kept is not None:
        samples, passed = kept
        # The first iteration after which the wanted number of grid points has been passed.
        wanted = jnp.arange(settings.save_every, settings.steps, settings.save_every, dtype=passed.dtype)
        rows = jnp.searchsorted(passed, wanted)
        samples = jnp.concatenate([pack(first, plant)[None], samples[rows]])
    return samples, last, finalize_metric(metric, memory, last)


def _run(
    carry: _Carry, plant: Plant, controller: Any, metric: Metric, dt: Step, settings: Settings
) -> tuple[_Carry, tuple[Float[Array, "iterations columns"], Int[Array, " iterations"]] | None]:
    """Returns loop and metric state after all iterations and, if samples are saved, the packed sample of each iteration
    with the number of grid points passed."""
    iterations = settings.steps + settings.spare_steps

    def body(
        carry: _Carry, index: Int[Array, ""]
    ) -> tuple[_Carry, tuple[Float[Array, " columns"], Int[Array, ""]] | None]:
        before, memory = carry
        loop, reached = _advance(plant, controller, before, dt, settings, iterations - index)
        sample = _sample(plant, loop, before.motion, dt)
        after = outline(update_metric)(metric, memory, sample)
        updated = after, sample.voltage, sample.mode
        kept = memory, loop.voltage, loop.mode
        memory, voltage, mode = jax.tree.map(lambda new, old: where(reached, new, old), updated, kept)
        loop = loop._replace(voltage=voltage, mode=mode)
        return (loop, memory), (None if settings.save_every is None else (pack(sample, plant), loop.motion.grid_index))

    return scan(body, carry, jnp.arange(iterations, dtype=jnp.int32), settings.checkpoint)


def _law(motion: Motion, control: Control | None) -> Int[Array, ""]:
    """Returns the controller's mode."""
    law: Int[Array, ""] = motion.mode.law if control is None else control.mode
    return law


def _sample(plant: Plant, loop: _Loop, before: Motion, dt: Step) -> Sample:
    """Returns the sample at the last point that was reached; `before` is the motion one iteration earlier."""
    motion = loop.motion
    held = isinstance(motion.mode, HeldMode)
    landed = (before.phase == LANDED) & ~failures.is_stopped(loop.flag)
    state = plants.state_of(plant, motion.q, motion.v)
    gate = -1 if held else GATE  # number of the gate's guard, which the plant's own follow
    crossing = before.guard - gate + GATE_CROSSING
    if not held:
        crossing = where(before.guard == LIMIT, where(motion.current.output > 0.0, 1, 2), crossing)
    return Sample(
        time=motion.grid_index.astype(dt.dtype) * dt + motion.offset,
        elapsed=jnp.asarray(motion.elapsed),
        state=state,
        voltage=motion.current.output,
        voltage_since=loop.voltage,
        voltage_until=None if held else where(landed, before.current.output, motion.current.output),
        mode=_law(motion, loop.control),
        mode_before=loop.mode,
        outputs=plants.outputs(plant, state, motion.current.acceleration, motion.current.output),
        plant_mode=motion.mode.plant,
        flag=loop.flag,
        crossing=where(landed, crossing, 0),
        crossing_speed=where(landed, -pick(before.slopes, before.guard), 0.0),
    )


def _advance(
    plant: Plant, controller: Any, loop: _Loop, dt: Step, settings: Settings, left: Int[Array, ""]
) -> tuple[_Loop, Bool[Array, ""]]:
    """Performs one iteration. A run that fails, or cannot end within the iterations that are left, is held at the last
    point and flagged (see `failures.py`); its samples continue."""
    integrator: Integrator = INTEGRATORS[settings.integrator]
    held = settings.clock == "sampled"
    system: System = HeldLoop(plant) if held else ContinuousLoop(plant, controller)
    motion = loop.motion
    stopped, ended = failures.is_stopped(loop.flag), motion.grid_index >= settings.steps
    outlook = failures.look_ahead(plant, motion.v, motion.current.acceleration, dt)
    going = ~stopped & ~ended & outlook.possible
    after, reached = iterate(system, integrator, failures.safe(going, motion), dt)
    within, lost = failures.verdict(plant, plants.state_of(plant, after.q, after.v), outlook)
    good = going & within & (left > settings.steps - after.grid_index)
    reason = where(going & within, np.int32(Flag.OVERFLOW), lost)
    chatter = where(good & (after.crossings >= CHATTER_LENGTH), np.int32(Flag.CHATTERING), np.int32(0))
    flag = loop.flag | where(stopped | ended | good, np.int32(0), reason) | chatter
    # A held run passes one grid point per iteration.
    on_hold = motion._replace(
        grid_index=motion.grid_index + (~ended).astype(motion.grid_index.dtype),
        offset=jnp.zeros_like(motion.offset),
        elapsed=where(ended, motion.elapsed, 0.0),
        phase=jnp.full_like(motion.phase, RUN),
    )
    before = motion.grid_index
    motion = jax.tree.map(lambda new, old: where(good, new, old), after, on_hold)
    loop = loop._replace(motion=motion, flag=flag)
    if held:
        instant = (motion.grid_index != before) & (motion.grid_index % settings.steps_per_control == 0)
        loop = _control(plant, controller, system, loop, instant, settings)
    return loop, (good & reached) | (~good & ~ended)


def _control(
    plant: Plant, controller: Any, system: System, loop: _Loop, instant: Bool[Array, ""], settings: Settings
) -> _Loop:
    """Updates the controller on the sampled clock, if this is a control instant."""
    motion = loop.motion
    assert loop.control is not None
    state = plants.state_of(plant, motion.q, motion.v)
    control = update_control(plant, controller, loop.control, state, settings)
    changes = where(control.mode != loop.control.mode, loop.changes + 1, 0)
    released = plants.release(plant, motion.q, motion.v, control.applied, motion.mode.plant)
    mode = motion.mode._replace(u=control.applied, plant=released)
    current, slopes, _ = observe(system, motion.q, motion.v, mode)
    new = (control, changes, motion._replace(mode=mode, current=current, slopes=slopes))
    control, changes, motion = jax.tree.map(
        lambda x, y: where(instant, x, y), new, (loop.control, loop.changes, motion)
    )
    chatter = where(changes >= CHATTER_LENGTH, np.int32(Flag.CHATTERING), np.int32(0))
    return loop._replace(motion=motion, control=control, changes=changes, flag=loop.flag | chatter)
