"""Simulation settings, declared once for `rollout`, `measure`, `sweep` and `record_sweep`."""

import math
from typing import Any, Literal, NamedTuple, Required, TypeAlias, TypedDict, cast, get_args

from cpjax.errors import InputError
from cpjax.pytree import is_traced
from cpjax.sim.integrators import INTEGRATORS

Clock: TypeAlias = Literal["continuous", "sampled"]
Switching: TypeAlias = Literal["per_step", "located"]
Checkpoint: TypeAlias = Literal["every_step", "segments"]
Derivative: TypeAlias = Literal["pathwise", "mean"]


class Simulation(TypedDict, total=False):
    """Keyword arguments that define how a rollout is computed.

    Attributes:
      duration: a whole number of steps [s]. Required.
      dt: the integrator's step [s]. Required.
      clock: "sampled" evaluates the controller once per control period and holds its command (zero-order hold), as
        firmware does; "continuous" evaluates the law in every stage of the integrator, and takes no controller with a
        memory of its own. By default "sampled", or "continuous" with located switching.
      control_period: period of the sampled clock, a whole number of steps [s]; by default one step.
      switching: "per_step", the default: the mode is updated at control instants and constant in between. "located",
        on the continuous clock: changes of mode, and the instants at which the voltage reaches or leaves its limit, are
        found inside their steps, and derivatives include how they move with the parameters (see docs/gradients.md). In
        each mode the law must be continuous in the state; a StateFeedback alone is not, at theta = pi. The events of a
        plant that has some (dry friction, stops, `cpjax.sim.plants.Eventful`) are located on the continuous clock; on
        the sampled clock "per_step" finds the first one in each step, and "located" all of them.
      integrator: a key of `cpjax.sim.integrators.INTEGRATORS`; "rk4" by default.
      save_every: number of steps between saved samples, a divisor of the number of steps. None saves no trajectory.
        `rollout` saves every step by default, `sweep` none; `measure` does not take it.
      spare_steps: largest number of additional steps for located events, of which each takes four. A run that needs
        more is stopped and flagged. By default 64 plus a sixteenth of the steps.
      checkpoint: what reverse mode stores: the state at the ends of "segments" of about sqrt(n) steps, or at
        "every_step", which takes more memory. Nothing else depends on it. (With switching per step, `rollout` stores
        the saved states regardless of it.)
      derivative: where the instant of a change of mode does not move with the parameters, because it falls on a control
        instant, "pathwise" omits its effect; "mean", on the sampled clock, adds it: the result is the derivative of the
        mean over initial states (see docs/gradients.md). Without either, differentiating such a loop warns.
      seed: of the noise of a rig's sensors, 0 by default. Each initial state of a sweep has noise of its own, which
        depends on its place in the set alone.
    """

    duration: Required[float]
    dt: Required[float]
    clock: Clock | None
    control_period: float | None
    switching: Switching | None
    integrator: str
    save_every: int | None
    spare_steps: int | None
    checkpoint: Checkpoint
    derivative: Derivative | None
    seed: int


class Settings(NamedTuple):
    """Static settings of a compilation, beside structures and dtypes; see `Simulation`."""

    steps: int
    save_every: int | None
    """Number of steps between saved samples; None for metrics only."""
    clock: Clock
    steps_per_control: int
    switching: Switching
    spare_steps: int
    """Iterations beyond `steps`, for crossings; 0 where none are located."""
    integrator: str
    checkpoint: Checkpoint
    derivative: Derivative | None
    fast_path: bool = False
    """Fast path, for values only: held steps by `step_held_incremental`, without failure handling. Initial states for
    which it is invalid carry the flag `NEEDS_RECOMPUTE`; their other outputs are undefined."""


def check_names(function: str, simulation: Any) -> None:
    """Checks the names of keyword arguments, as Python does for those in a function's signature.

    Raises:
      TypeError: a name that `Simulation` does not have, or one of its required names is missing.
    """
    for name in simulation:
        if name not in Simulation.__annotations__:
            known = ", ".join(Simulation.__annotations__)
            raise TypeError(f"{function}() got an unexpected keyword argument {name!r}; it takes {known}")
    for name in Simulation.__required_keys__:
        if name not in simulation:
            raise TypeError(f"{function}() missing 1 required keyword-only argument: {name!r}")


def check_settings(
    *,
    duration: Any,
    dt: Any,
    clock: Any = None,
    control_period: Any = None,
    switching: Any = None,
    integrator: Any = "rk4",
    save_every: Any = None,
    spare_steps: Any = None,
    checkpoint: Any = "segments",
    derivative: Any = None,
    seed: Any = 0,
    events: bool = False,
) -> Settings:
    """Checks the arguments of `Simulation` and returns the settings of a rollout.

    Args:
      events: whether the plant has events of its own.

    Raises:
      InputError: as `rollout` does.
    """
    dt = _positive_seconds("dt", dt)
    duration = _positive_seconds("duration", duration)
    if dt > duration:
        raise InputError("dt", dt, f"at most the duration, {duration:g} s")
    steps = _whole_steps("duration", duration, dt)
    _check_choice("switching", switching, Switching)
    _check_choice("clock", clock, Clock)
    if clock is None:
        clock = "continuous" if switching == "located" else "sampled"
    if switching is None:
        switching = "located" if events and clock == "continuous" else "per_step"
    if switching == "located" and clock != "continuous" and not events:
        allowed = "per_step on the sampled clock: a held control changes mode only at its samples"
        raise InputError("switching", switching, allowed)
    if switching == "per_step" and events and clock == "continuous":
        allowed = "located, or absent, for a plant with events of its own on the continuous clock"
        raise InputError("switching", switching, allowed)
    if spare_steps is None:
        spare_steps = 64 + steps // 16 if switching == "located" else 0
    elif switching != "located":
        raise InputError("spare_steps", spare_steps, "absent unless switching is located")
    elif isinstance(spare_steps, bool) or not isinstance(spare_steps, int) or spare_steps < 0:
        raise InputError("spare_steps", spare_steps, "a whole number of steps, at least 0")
    if not isinstance(checkpoint, str) or checkpoint not in get_args(Checkpoint):
        raise InputError("checkpoint", checkpoint, "every_step or segments")
    _check_choice("derivative", derivative, Derivative)
    if derivative == "mean" and clock != "sampled":
        allowed = "pathwise, or absent, on the continuous clock: there, locate the switch (switching = located)"
        raise InputError("derivative", derivative, allowed)
    if not isinstance(integrator, str) or integrator not in INTEGRATORS:
        raise InputError("integrator", integrator, "one of " + ", ".join(INTEGRATORS))
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**32:
        raise InputError("seed", seed, "a whole number from 0 to 2^32 - 1")
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
    return Settings(
        steps=steps,
        save_every=save_every,
        clock=clock,
        steps_per_control=steps_per_control,
        switching=switching,
        spare_steps=spare_steps,
        integrator=integrator,
        checkpoint=cast(Checkpoint, checkpoint),
        derivative=derivative,
    )


def check_whole_steps(config: Any, *pairs: tuple[str, str]) -> None:
    """Checks durations and steps of a config.

    Args:
      pairs: names of a duration's field and of the field of the step that must divide it.

    Raises:
      InputError: a duration that is no whole number of steps, by the name of its field.
    """
    for whole, step in pairs:
        try:
            check_settings(duration=getattr(config, whole), dt=getattr(config, step))
        except InputError as problem:
            field = step if problem.field == "dt" else whole
            raise InputError(field, getattr(config, field), problem.allowed) from problem


def _check_choice(field: str, value: Any, choices: Any) -> None:
    if value is not None and (not isinstance(value, str) or value not in get_args(choices)):
        raise InputError(field, value, " or ".join(get_args(choices)))


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
    """Returns how many steps of `dt` make `seconds`, up to rounding: 0.3 / 0.1 counts as whole."""
    if not seconds / dt < 2**31:
        raise InputError(field, seconds, f"fewer than 2^31 steps of dt = {dt:g} s")
    steps = round(seconds / dt)
    if abs(seconds / dt - steps) > 1e-6 * steps:
        raise InputError(field, seconds, f"a whole multiple of dt = {dt:g} s")
    return steps
