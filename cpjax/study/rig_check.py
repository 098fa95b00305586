"""Checks of a rig before anything is built on it: what moves, how fast, how finely measured, and what was left out."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from cpjax import files, io
from cpjax.errors import InputError
from cpjax.linear.structure import controllability
from cpjax.plant import ForceActuator, Motor, linearize
from cpjax.plant.state import State
from cpjax.pytree import Number, numbers
from cpjax.rig import Rig
from cpjax.study.swing_up_search import SwingUpSearch, search_swing_up

SAMPLES = 10
"""Samples of a time constant that are called enough."""

_ABSENT = {
    "sensors": "no sensors: the whole state is measured without error",
    "drive": "no drive: commands act at once, without delay or dead band",
    "track": "no track: the cart may travel any distance",
}
"""Consequence of a part that is absent, by its name."""


class Figure(NamedTuple):
    """One line of a check."""

    key: str
    words: str
    value: float | bool | None
    """None where it could not be computed."""
    unit: str
    remark: str = ""


@dataclasses.dataclass(frozen=True)
class RigCheck:
    """Result of `check_rig`.

    Attributes:
      figures: the lines of the check.
      swing_up: the search for a swing-up.
      warnings: what was left out and what looks wrong, one sentence each.
    """

    figures: tuple[Figure, ...]
    swing_up: SwingUpSearch
    warnings: tuple[str, ...]

    def __getitem__(self, key: str) -> float | bool | None:
        """Returns the value of a figure by its key."""
        return {figure.key: figure.value for figure in self.figures}[key]


def check_rig(rig: Rig, *, period: float | None = None, seed: int = 1) -> RigCheck:
    """Checks a rig.

    Args:
      rig: the rig.
      period: control period [s]; without it there are no figures about sampling.
      seed: of the search for a swing-up.

    Raises:
      InputError: a `rig` that is no Rig, or a period that is not above 0.
    """
    if not isinstance(rig, Rig):
        raise InputError("rig", rig, "a cpjax.Rig")
    if period is not None:
        period = float(Number("s", "control period", above=0.0).normalise("period", period))
    warnings = _left_out(rig)
    figures = [*_force(rig), *_linear(rig, period, warnings), *_measurement(rig, period), *_delay(rig, period)]
    found = search_swing_up(rig, seed=seed)
    if not found.found:
        warnings.append(
            f"no swing-up was found in {found.runs} runs: the pendulum gets {100 * found.share:.0f} % of the energy of "
            "upright; a longer track or a higher supply may be needed"
        )
    by_key = {figure.key: figure.value for figure in figures}
    samples, dead_time = by_key.get("samples"), by_key.get("dead_time_share")
    if samples is not None and samples < SAMPLES:
        warnings.append(
            f"the control period is coarse: {samples:.2g} samples of the fastest time constant, where {SAMPLES} are "
            "called enough"
        )
    if dead_time is not None and dead_time > 0.5:
        warnings.append(
            f"the dead time is {dead_time:.2g} of the time in which a fall grows by e: hardly a regulator holds that"
        )
    return RigCheck(tuple(figures), found, tuple(warnings))


def document(check: RigCheck, rig: Rig, **setting: Any) -> dict[str, Any]:
    """Returns the check as plain values, for JSON, beside the entries of `setting`."""
    search = {field.name: getattr(check.swing_up, field.name) for field in dataclasses.fields(check.swing_up)}
    law = {name: getattr(check.swing_up.law, name) for name in numbers(type(check.swing_up.law))}
    return {
        "what": "a check of a rig",
        "versions": files.versions(),
        **io.encode_bench(rig),
        **setting,
        "figures": {figure.key: figure.value for figure in check.figures},
        "units": {figure.key: figure.unit for figure in check.figures},
        "swing_up": {**search, "law": law},
        "warnings": check.warnings,
    }


def _force(rig: Rig) -> list[Figure]:
    """Returns what moves, and what the supply can do to it."""
    plant: Any = rig.plant
    motor, supply = plant.motor, float(plant.input_limit)
    rotor, mass = float(motor.reflected_mass), float(plant.moving_mass)
    stall, at_speed = (float(motor.force(supply, speed)) for speed in (0.0, 1.0))
    braking = float(motor.force(0.0, 0.0)) - float(motor.force(0.0, 1.0))  # per speed; finite without a limit too
    no_load = stall / braking if braking > 0.0 else math.inf
    figures = [
        Figure("moving_mass", "moving mass of cart and rotor", mass, "kg"),
        Figure("reflected_mass", "of it the rotor, behind its gear and wheel", rotor, "kg"),
        Figure("supply", "largest command", supply, "N" if isinstance(motor, ForceActuator) else "V"),
        Figure("stall_force", "force at stall", stall, "N"),
        Figure(
            "no_load_speed", "top speed of the motor alone", no_load, "m/s", "" if at_speed < stall else "no braking"
        ),
        Figure("top_speed", "top speed with cart and pole hanging", _top_speed(rig, supply, no_load), "m/s"),
        Figure("hold_angle", "largest angle that it can hold at rest", _hold_angle(rig, supply), "rad"),
    ]
    dead_band = float(getattr(rig.drive, "dead_band", 0.0))
    if dead_band:
        figures.append(Figure("dead_band_share", "dead band, share of the supply", dead_band / supply, "1"))
    swing = 2.0 * math.pi / float(plant.natural_frequency)
    return [*figures, Figure("swing_period", "period of small swings, hanging, cart held", swing, "s")]


def _top_speed(rig: Rig, supply: float, no_load: float) -> float:
    """Returns the speed at which the cart stops accelerating under the full supply [m/s]."""
    if not math.isfinite(supply):
        return math.inf
    plant = rig.plant

    def gains(speed: float) -> bool:
        return float(plant.vector_field(State(0.0, speed, math.pi, 0.0), supply).x_dot) > 0.0

    most = no_load if math.isfinite(no_load) else 1e6
    return math.inf if gains(2.0 * most) else _last(gains, 0.0, 2.0 * most)


def _hold_angle(rig: Rig, supply: float) -> float:
    """Returns the largest angle at which the full supply, at rest, still turns the pole back [rad]."""
    if not math.isfinite(supply):
        return math.pi / 2
    dynamics = rig.dynamics

    def turns_back(angle: float) -> bool:
        slope = rig.plant.vector_field(State(0.0, 0.0, angle, 0.0), dynamics.saturate(-supply))
        return float(slope.theta_dot) < 0.0

    return _last(turns_back, 0.0, math.pi / 2)


def _last(holds: Callable[[float], bool], low: float, high: float) -> float:
    """Returns the end of the part of an interval, from its beginning on, where something holds, by bisection."""
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def _linear(rig: Rig, period: float | None, warnings: list[str]) -> list[Figure]:
    """Returns the figures of the linear model about upright."""
    try:
        A, B = linearize(rig.plant)
    except InputError as problem:
        warnings.append(f"there is no linear model about upright ({problem})")
        return [Figure("controllable", "linear model about upright is controllable", None, "")]
    poles = np.linalg.eigvals(np.asarray(A, float))
    fastest, growth = 1.0 / float(np.max(np.abs(poles))), float(np.max(poles.real))
    structure = controllability(A, B)
    if not bool(structure.full):
        warnings.append("the linear model about upright is not controllable: no regulator can hold the pendulum")
    figures = [
        Figure("controllable", "linear model about upright is controllable", bool(structure.full), ""),
        Figure("condition", "condition of its controllability matrix", float(structure.condition), "1"),
        Figure("fall_time", "time in which a fall grows by e", 1.0 / growth if growth > 0.0 else math.inf, "s"),
        Figure("fastest", "fastest time constant", fastest, "s"),
        Figure("needed_period", f"period for {SAMPLES} samples of it", fastest / SAMPLES, "s"),
    ]
    if period is not None:
        figures += [
            Figure("period", "control period", period, "s"),
            Figure("samples", "samples of the fastest time constant", fastest / period, "1"),
            Figure(
                "dead_time_share", "delay and half a period, share of the fall's time", _wait(rig, period) * growth, "1"
            ),
        ]
    return figures


def _wait(rig: Rig, period: float) -> float:
    return float(getattr(rig.drive, "delay", 0.0)) + 0.5 * period


def _measurement(rig: Rig, period: float | None) -> list[Figure]:
    """Returns each encoder's step, and the speed of one step in a control period."""
    figures = []
    for name, rule in numbers(type(rig.sensors)).items() if rig.sensors is not None else ():
        if not name.endswith("_step"):
            continue
        step, what = float(getattr(rig.sensors, name)), name.removesuffix("_step")
        figures.append(Figure(name, f"{what}: one count", step, rule.unit))
        if period is not None:
            figures.append(Figure(f"{what}_speed", f"{what}: one count in a period", step / period, f"{rule.unit}/s"))
    return figures


def _delay(rig: Rig, period: float | None) -> list[Figure]:
    delay = float(getattr(rig.drive, "delay", 0.0))
    if not delay or period is None:
        return []
    return [Figure("delay_periods", "delay of a command, in control periods", delay / period, "1")]


def _left_out(rig: Rig) -> list[str]:
    """Returns one sentence on each thing that the rig does not say."""
    plant: Any = rig.plant
    motor, found = plant.motor, []
    if isinstance(motor, ForceActuator):
        found.append("the drive is a force: a motor's back-EMF, if there is one, must be inside the cart's friction")
    elif not float(motor.reflected_mass):
        geared = isinstance(motor, Motor) and (float(motor.gear_ratio) != 1.0 or float(motor.wheel_radius) < 0.1)
        ratio = f", {float(motor.gear_ratio / motor.wheel_radius):.3g} rad/m squared here" if geared else ""
        found.append(f"the rotor has no inertia: at the cart it weighs its inertia times (gear / wheel)^2{ratio}")
    if not isinstance(motor, ForceActuator) and not any("efficien" in name for name in numbers(type(motor))):
        found.append("efficiencies of gear and motor are taken as 1, unless the force per voltage has them")
    if not math.isfinite(float(plant.input_limit)):
        found.append("the command has no limit: every catch succeeds that a real supply may not give")
    friction = [name for name in numbers(type(plant)) if name.endswith("friction") and not getattr(plant, name)]
    if friction:
        found.append(f"no {' and no '.join(name.replace('_', ' ') for name in friction)}")
    if not float(plant.pole_inertia):
        found.append("the pole has no inertia about its centre of mass: a point bob on a massless pole")
    for field in dataclasses.fields(rig):
        part = getattr(rig, field.name)
        if part is None:
            found.append(_ABSENT.get(field.name, f"no {field.name}"))
        elif field.name != "plant":
            zero = [name for name in numbers(type(part)) if _is_zero(getattr(part, name))]
            if zero:
                found.append(f"{field.name}: {', '.join(zero)} {'is' if len(zero) == 1 else 'are'} 0")
    return found


def _is_zero(value: Any) -> bool:
    return value is None or (np.ndim(value) == 0 and float(value) == 0.0)
