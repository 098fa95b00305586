"""How a rollout is to be computed: what a compilation depends on, beside structures and dtypes."""

import math
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

from cpjax.errors import InputError
from cpjax.pytree import is_traced
from cpjax.sim.integrators import INTEGRATORS

Clock: TypeAlias = Literal["continuous", "sampled"]
Switching: TypeAlias = Literal["per_step", "located"]
Checkpoint: TypeAlias = Literal["every_step", "segments"]


class Settings(NamedTuple):
    """See `cpjax.rollout`, whose arguments these are."""

    steps: int
    save_every: int | None
    """None: metrics only."""
    clock: Clock
    steps_per_control: int
    switching: Switching
    spare_steps: int
    """Beyond `steps`, for crossings; 0 where none are located."""
    integrator: str
    checkpoint: Checkpoint
    optimistic: bool = False
    """Values only: held steps by `step_held_by_turns`, and no run is held where it goes wrong. A start for which that
    was not right has the flag `IN_DOUBT`, and all else about it means nothing."""


def check_settings(
    duration: Any,
    dt: Any,
    clock: Clock,
    control_period: Any,
    switching: Switching,
    integrator: Any,
    save_every: Any,
    spare_steps: Any = None,
    checkpoint: Checkpoint = "segments",
) -> Settings:
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
    if not isinstance(switching, str) or switching not in get_args(Switching):
        raise InputError("switching", switching, "per_step or located")
    if switching == "located" and clock != "continuous":
        allowed = "per_step on the sampled clock: a held control changes mode only at its samples"
        raise InputError("switching", switching, allowed)
    if spare_steps is None:
        spare_steps = 64 + steps // 16 if switching == "located" else 0
    elif switching != "located":
        raise InputError("spare_steps", spare_steps, "absent unless switching is located")
    elif isinstance(spare_steps, bool) or not isinstance(spare_steps, int) or spare_steps < 0:
        raise InputError("spare_steps", spare_steps, "a whole number of steps, at least 0")
    if not isinstance(checkpoint, str) or checkpoint not in get_args(Checkpoint):
        raise InputError("checkpoint", checkpoint, "every_step or segments")
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
    return Settings(steps, save_every, clock, steps_per_control, switching, spare_steps, integrator, checkpoint)


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
