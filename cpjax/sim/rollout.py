"""Closed-loop rollouts: from a plant, a controller and an initial state to a trajectory and its metrics.

Everything here is for one initial state; batches are `jax.vmap` of it, as in `cpjax.sweep`. One compiled scan does the
computation: that of `per_step.py` or that of `located.py`.
"""

import functools
import itertools
import warnings
from typing import Any, Unpack

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from cpjax.controllers.feedback import without_design
from cpjax.controllers.protocol import (
    Controller,
    Law,
    ModalController,
    SmoothController,
    as_controller,
    at_period,
    is_clocked,
)
from cpjax.errors import InputError
from cpjax.plant import CartPole
from cpjax.pytree import as_arguments, check, pytree, reveal
from cpjax.rig import Rig
from cpjax.sim import located, per_step
from cpjax.sim.bench import Bench, on_bench
from cpjax.sim.derivatives import may_switch, watched
from cpjax.sim.flags import NEEDS_RECOMPUTE
from cpjax.sim.initial import checked_initial
from cpjax.sim.integrators import Step
from cpjax.sim.metrics import Metric, NoMetrics, ProtocolMetrics, Sample
from cpjax.sim.plants import Plant, PlantState, check_plant, has_events, is_stepped
from cpjax.sim.saved import SavedSamples, fields, keep
from cpjax.sim.settings import Settings, Simulation, check_names, check_settings


@pytree
class Trajectory:
    """Samples of a rollout, all of one length; the first is at t = 0, the last at the end.

    Attributes:
      time: since the start [s].
      state: the plant's state, with the axes of `time`; of a `CartPole` a `State`, whose theta is not wrapped.
      voltage: applied from that instant on, clipped [V].
      mode: of the controller, from that instant on, int32.
      outputs: further outputs of the plant by name; of a `CartPole` `cart_acceleration`, x'' from that instant on
        [m/s^2].
      flag: bits of `Flag` for the whole run, int32; 0 is clean.
      metrics: result of the metric, over every step whether saved or not.
    """

    time: Float[Array, "*batch samples"]
    state: PlantState
    voltage: Float[Array, "*batch samples"]
    mode: Int[Array, "*batch samples"]
    outputs: dict[str, Float[Array, "*batch samples"]]
    flag: Int[Array, "*batch"]
    metrics: Any

    @property
    def cart_acceleration(self) -> Float[Array, "*batch samples"]:
        """x'' of a cart-pole, from that instant on [m/s^2]."""
        return self.outputs["cart_acceleration"]


def rollout(
    plant: Plant | Rig,
    controller: Controller | ModalController | Law,
    start: PlantState,
    *,
    metrics: Metric | None = None,
    **simulation: Unpack[Simulation],
) -> Trajectory:
    """Simulates the closed loop from one initial state. Works under `jit`, `vmap` and differentiation.

    The initial state's dtype is the rollout's: plant and controller are cast to it. Two calls that differ only in
    numbers (initial state, gains, parameters, dt at an equal count of steps) share one compilation.

    Args:
      plant: a `CartPole`, a `cpjax.Rig`, or a plant of your own (see `cpjax.sim.plants.Plant`).
      controller: a `Hybrid`, a law, or a controller with memory (see `cpjax.controllers.protocol`).
      start: the initial state, of scalars. For many, use `cpjax.sweep` or `jax.vmap`.
      metrics: a metric, updated at every step; by default `ProtocolMetrics()` for a `CartPole`, none for other plants.
      simulation: see `cpjax.Simulation`: duration, dt, clock, control_period, switching, integrator, save_every,
        spare_steps, checkpoint, derivative.

    Returns:
      The trajectory, of steps / save_every + 1 samples.

    Raises:
      InputError: an invalid argument, which is named, or an invalid return value of a law, controller, plant or metric.
        Failures of the simulation itself do not raise (see `Trajectory.flag`).
    """
    check_names("rollout", simulation)
    save_every = simulation.pop("save_every", 1)
    if save_every is None:
        raise InputError("save_every", save_every, "a whole number of steps, at least 1; cpjax.measure saves nothing")
    start, arguments, settings, _ = prepared(plant, controller, start, metrics, save_every=save_every, **simulation)
    trajectory: Trajectory = _simulate(start, *arguments, settings=settings)
    return trajectory


def measure(
    plant: Plant | Rig,
    controller: Controller | ModalController | Law,
    start: PlantState,
    *,
    metrics: Metric | None = None,
    **simulation: Unpack[Simulation],
) -> Any:
    """Simulates as `rollout` does and returns only the metric's result, without storing a trajectory.

    Arguments and errors are those of `rollout`, except that there is no `save_every` and that other plants than a
    `CartPole` need `metrics`.
    """
    check_names("measure", simulation)
    if "save_every" in simulation:
        raise TypeError("measure() saves no trajectory and takes no save_every; cpjax.rollout does")
    start, arguments, settings, _ = prepared(plant, controller, start, metrics, **simulation)
    return _simulate(start, *arguments, settings=settings)


def prepared(
    plant: Any, controller: Any, start: PlantState, metrics: Metric | None, *, batched: bool = False, **simulation: Any
) -> tuple[PlantState, tuple[Plant, Any, Metric, Step], Settings, list[bool]]:
    """Checks the arguments of `simulate` and casts them to the initial state's dtype.

    Args:
      batched: whether `start` holds many initial states, arrays of shape (n,).

    Returns:
      The initial state; plant, controller, metric and dt; the settings; and, for each leaf of plant, controller, metric
      and dt, whether it has a leading axis of one entry per initial state.

    Raises:
      InputError: as `rollout` does.
    """
    rig = plant if isinstance(plant, Rig) else Rig(plant) if isinstance(plant, CartPole) else None
    whole = plant if rig is None else rig
    plant = plant if rig is None else rig.dynamics
    check_plant(plant)
    settings = check_settings(**simulation, events=has_events(plant))
    if is_stepped(plant) and (settings.clock == "continuous" or settings.switching == "located"):
        allowed = (
            "sampled, with switching per step: pushes, wind, a drive's lag and inductance change from step to step"
        )
        field = "clock" if settings.clock == "continuous" else "switching"
        raise InputError(field, getattr(settings, field), allowed)
    name = "starts" if batched else "start"
    start, dtype, count = checked_initial(plant, start, name, batched=batched)
    controller = without_design(as_controller(controller))
    if settings.clock == "continuous" and not isinstance(controller, ModalController):
        allowed = "sampled: a controller with memory is updated once per control period"
        raise InputError("clock", settings.clock, allowed)
    if settings.clock == "continuous" and is_clocked(controller):
        raise InputError("clock", settings.clock, "sampled: a part of the controller depends on the control period")
    if settings.clock == "continuous" and settings.switching == "located":
        if not isinstance(controller, SmoothController):
            raise InputError("controller", controller, "one with margin and successor, for located switching")
        if not hasattr(plant, "input_limit"):
            raise InputError("plant", plant, "one with input_limit, for located switching on the continuous clock")
    if metrics is None:
        if rig is None and settings.save_every is None:
            raise InputError("metrics", None, "given: the default ProtocolMetrics() are those of a cpjax.CartPole")
        metrics = default_metrics(whole)
    present = {name for name in ("init", "update", "finalize", "finish") if callable(getattr(metrics, name, None))}
    if isinstance(metrics, type) or not present >= {"init", "update"} or not present & {"finalize", "finish"}:
        raise InputError("metrics", metrics, "a metric with init, update and finalize, such as cpjax.ProtocolMetrics()")
    if "finalize" not in present:
        message = f"{type(metrics).__name__}.finish is now called finalize; the old name goes with version 0.3"
        warnings.warn(message, DeprecationWarning, stacklevel=3)
    runs = np.zeros((), np.uint32) if count is None else np.arange(count, dtype=np.uint32)
    if rig is not None and is_stepped(plant):
        plant = rig.moving(np.uint32(simulation.get("seed", 0)), runs)
    parts: tuple[tuple[str, Any], ...] = (("plant", plant), ("controller", controller), ("metrics", metrics))
    each = {name: check(name, part, count) for name, part in parts}
    if rig is not None:
        bare = controller
        controller, settings = on_bench(
            rig, controller, settings, float(simulation["dt"]), simulation.get("seed", 0), runs
        )
        if controller is not bare:
            numbers = [one for one in (controller.drive_noise, controller.behind) if one is not None]
            more = [np.ndim(number) > 0 for number in numbers]
            each["controller"] += [*check("rig.sensors", rig.sensors, count), *more, False, count is not None]
    parts = (("plant", plant), ("controller", controller), ("metrics", metrics))
    plant, controller, metrics = (as_arguments(name, part, dtype) for name, part in parts)
    dt = np.asarray(simulation["dt"], dtype=dtype)
    return start, (plant, controller, metrics, dt), settings, [*itertools.chain(*each.values()), False]


def default_metrics(plant: Any) -> Metric:
    """Returns the default metric of a rollout: `ProtocolMetrics()` for a `CartPole`, `NoMetrics()` for other plants."""
    if isinstance(plant, Rig):
        return ProtocolMetrics() if plant.track is None else ProtocolMetrics(track_limit=plant.track.half_length)
    return ProtocolMetrics() if isinstance(plant, CartPole) else NoMetrics()


@functools.partial(jax.jit, static_argnames="settings")
def _simulate(start: PlantState, plant: Plant, controller: Any, metric: Metric, dt: Step, *, settings: Settings) -> Any:
    return results(*simulate(start, plant, controller, metric, dt, settings))


def simulate(
    start: PlantState, plant: Any, controller: Any, metric: Any, dt: Step, settings: Settings
) -> tuple[SavedSamples | None, Sample, Any]:
    """Simulates one initial state; arguments as `prepared` returns them.

    Returns:
      The saved samples except the final one (None if nothing is saved), the final sample (its flag may have
      NEEDS_RECOMPUTE), and the metric's result.
    """
    plant, controller, metric = reveal((plant, controller, metric))
    if settings.clock == "sampled":
        every = settings.steps_per_control * (controller.divider if isinstance(controller, Bench) else 1)
        controller = at_period(controller, dt * every)
    blind = settings.switching == "per_step" or settings.clock == "sampled"
    if blind and settings.derivative is None and may_switch(controller, start):
        start, plant, controller = watched((start, plant, controller))
    one = located.simulate if settings.switching == "located" else per_step.simulate
    packed, last, result = one(start, plant, controller, metric, dt, settings)
    return (None if packed is None else keep(packed, plant, last)), last, result


def results(kept: SavedSamples | None, last: Sample, result: Any) -> Any:
    """Returns the user's result from that of `simulate`: a `Trajectory`, or only the metric's result."""
    if kept is None:
        return result
    return Trajectory(**fields(kept, last), flag=last.flag & ~NEEDS_RECOMPUTE, metrics=result)
