"""Closed-loop rollouts: from a plant, a controller and a start to a trajectory and its metrics.

Everything here is for one start; batches are `jax.vmap` of it (`cpjax.sweep` does so). The work is done by one compiled
scan: that of `per_step.py`, or that of `located.py`.
"""

import copy
import functools
from typing import Any

import jax
import numpy as np

from cpjax.controllers.feedback import StateFeedback
from cpjax.controllers.protocol import Controller, Law, SmoothController, as_controller
from cpjax.errors import InputError
from cpjax.plant import CartPole
from cpjax.pytree import cast, check, pytree
from cpjax.sim import located, per_step
from cpjax.sim.flags import IN_DOUBT
from cpjax.sim.kept import Kept, fields, keep
from cpjax.sim.metrics import Fold, ProtocolMetrics, Sample
from cpjax.sim.settings import Checkpoint, Clock, Settings, Switching, check_settings
from cpjax.state import State, checked_start


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
    spare_steps: int | None = None,
    checkpoint: Checkpoint = "segments",
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
      switching: "per_step": the mode is read at the control instants and kept in between. "located", on the continuous
        clock: changes of mode, and the moments at which the voltage reaches the limit or leaves it, are found inside
        their steps, and first derivatives know that they move (see docs/gradients.md). In each mode the law has to be
        continuous in the state; a StateFeedback alone is not, at theta = pi.
      integrator: a key of `cpjax.sim.integrators.INTEGRATORS`.
      save_every: keep every so many steps; must divide the number of steps.
      spare_steps: of located switching, whose crossings take four steps each: the most that they may take together. A
        run that needs more is stopped and flagged. By default 64 and a sixteenth of the steps.
      checkpoint: what reverse mode remembers: the state at the ends of "segments" of about sqrt(n) steps, or at
        "every_step", which takes more memory. Nothing else depends on it. (With switching per step, `rollout` remembers
        the saved states, whatever is asked for, and `measure` after `cpjax.configure_cpu` always "segments".)
      metrics: a fold over all steps; by default `ProtocolMetrics()`.

    Raises:
      InputError: bad arguments, named; never because of what the simulation does (see `Trajectory.flag`).
    """
    if save_every is None:
        raise InputError("save_every", save_every, "a whole number of steps, at least 1; cpjax.measure saves nothing")
    settings = check_settings(
        duration, dt, clock, control_period, switching, integrator, save_every, spare_steps, checkpoint
    )
    start, dtype = checked_start(start, "start", batched=False)
    arguments, _ = cast_arguments(plant, controller, metrics, dt, dtype, settings)
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
    spare_steps: int | None = None,
    checkpoint: Checkpoint = "segments",
    metrics: Fold | None = None,
) -> Any:
    """What `rollout(...).metrics` would be, without storing a trajectory. Arguments and errors as for `rollout`."""
    settings = check_settings(duration, dt, clock, control_period, switching, integrator, None, spare_steps, checkpoint)
    start, dtype = checked_start(start, "start", batched=False)
    arguments, _ = cast_arguments(plant, controller, metrics, dt, dtype, settings)
    return _simulate(start, *arguments, settings=settings)


@functools.partial(jax.jit, static_argnames="settings")
def _simulate(start: State, plant: CartPole, controller: Any, fold: Fold, dt: jax.Array, *, settings: Settings) -> Any:
    return results(*simulate(start, plant, controller, fold, dt, settings))


def simulate(
    start: State, plant: CartPole, controller: Any, fold: Fold, dt: jax.Array, settings: Settings
) -> tuple[Kept | None, Sample, Any]:
    """Of arguments that have been checked and cast: what is kept of all samples but the last (None if nothing is), the
    last one (its flag may have IN_DOUBT), and what the fold made of all of them."""
    one = located.simulate if settings.switching == "located" else per_step.simulate
    packed, last, result = one(start, plant, controller, fold, dt, settings)
    return (None if packed is None else keep(packed, plant)), last, result


def results(kept: Kept | None, last: Sample, result: Any) -> Any:
    """What users get of what `simulate` returned: a `Trajectory`, or only what the fold made of it."""
    if kept is None:
        return result
    return Trajectory(**fields(kept, last), flag=last.flag & ~IN_DOUBT, metrics=result)  # type: ignore[arg-type]  # of a dict


def _without_designs(controller: Any) -> Any:
    """A regulator's design is no part of its law: gains with one and gains without share a compilation."""

    def bare(law: Any) -> Any:
        designed = isinstance(law, StateFeedback) and law.design is not None
        if not designed:
            return law
        law = copy.copy(law)  # which has been checked
        object.__setattr__(law, "design", None)
        return law

    return jax.tree.map(bare, controller, is_leaf=lambda part: isinstance(part, StateFeedback))


def cast_arguments(
    plant: Any, controller: Any, fold: Fold | None, dt: float, dtype: Any, settings: Settings, batch: int | None = None
) -> tuple[tuple[CartPole, Controller, Fold, Any], list[bool]]:
    """What `simulate` takes after the start, and for each of its leaves whether it has an axis of length `batch`.

    Raises:
      InputError: as `rollout` does.
    """
    if not isinstance(plant, CartPole):
        raise InputError("plant", plant, "a cpjax.CartPole")
    fold = ProtocolMetrics() if fold is None else fold
    if isinstance(fold, type) or not all(callable(getattr(fold, name, None)) for name in ("init", "update", "finish")):
        raise InputError("metrics", fold, "a fold, such as cpjax.ProtocolMetrics()")
    controller = _without_designs(as_controller(controller))
    if settings.switching == "located" and not isinstance(controller, SmoothController):
        raise InputError("controller", controller, "one with margin and successor, for located switching")
    parts = (("plant", plant), ("controller", controller), ("metrics", fold))
    batched = [leaf for name, part in parts for leaf in check(name, part, batch)]
    arguments = cast(plant, dtype), cast(controller, dtype), cast(fold, dtype), np.asarray(dt, dtype=dtype)
    return arguments, [*batched, False]
