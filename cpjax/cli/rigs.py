"""Options of rigs and of the firmware on them, and what is built from their values."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cpjax import io
from cpjax.cli.builders import build_plant
from cpjax.cli.options import Option, options_of
from cpjax.controllers import Digital, FilteredDerivative
from cpjax.controllers.estimators import kalman_observer
from cpjax.errors import InputError
from cpjax.plant import CartPole, with_parameters
from cpjax.pytree import Number
from cpjax.rig import PRESETS, Encoders, Potentiometers, Rig, StateSensors, Track, plant_of
from cpjax.rig import rig as named_rig

PARTS = tuple(field.name for field in dataclasses.fields(Rig) if field.name != "plant")
"""Names of what a rig may have beside its plant."""

_FINEST = 1e-6  # step [m, rad] of sensors without one, so that no deviation is 0
_CUTOFF = 300.0  # default of --cutoff [rad/s]

RIG_OPTIONS = [
    Option(
        "plant",
        "rig",
        "a rig instead of --plant: " + ", ".join(PRESETS) + ", or a file with one (cpjax rig show); other options "
        "change its plant",
    ),
    Option("plant", "without", "parts of the rig to leave out, with commas between: " + ", ".join(PARTS)),
]

TRACK_OPTION = Option(
    "plant",
    "track_limit",
    "leaving |x| within it is failure, also on a plant alone (default the rig's track, or none) [m]",
    float,
)

ESTIMATOR_OPTIONS = [
    Option(
        "firmware",
        "estimator",
        "of the rates that encoders do not measure (default kalman on a rig with sensors, and else none)",
        choices=("kalman", "derivative", "none"),
    ),
    *(
        dataclasses.replace(option, help=f"{option.help}, of derivative (default {_CUTOFF:g})")
        for option in options_of("firmware", FilteredDerivative, ["cutoff"])
    ),
]

FIRMWARE_OPTIONS = [
    *ESTIMATOR_OPTIONS,
    Option("firmware", "control_period", "[s] (default that of a rig given by name, and else one step)", float),
]


def load_rig(name: str) -> Rig:
    """Returns a public rig by name, or the rig in a file.

    Args:
      name: a preset's, or that of a file with a Rig, with a CartPole, or with a result that has one of them.

    Raises:
      InputError: another name, or a file with something else.
    """
    if name in PRESETS:
        return named_rig(name)
    if Path(name).suffix.lower() not in (".json", ".toml"):
        raise InputError("rig", name, ", ".join(PRESETS) + ", or a file that ends in .json or .toml")
    loaded = io.load_part(name, "rig", "a Rig or a CartPole")
    if isinstance(loaded, CartPole):
        return Rig(loaded)
    if not isinstance(loaded, Rig):
        allowed = f"a file that holds a Rig or a CartPole; this one holds a {type(loaded).__name__}"
        raise InputError("rig", name, allowed)
    return loaded


def build_rig(given: Mapping[str, Any]) -> Rig | CartPole:
    """Builds the rig with the given parameters of its plant changed; without a rig, the plant alone.

    Args:
      given: the values of the section "plant".

    Raises:
      InputError: a rig together with a base, an unknown part to leave out, or as for `load_rig` and `build_plant`.
    """
    changes = dict(given)
    name, without, limit = (changes.pop(key, None) for key in ("rig", "without", "track_limit"))
    track = None if limit is None else Track(half_length=limit)
    if name is None:
        if without is not None:
            raise InputError("without", without, "absent where no rig is given")
        plant = build_plant(changes)
        return plant if track is None else Rig(plant, track=track)
    if "base" in changes:
        raise InputError("plant", changes["base"], "absent where a rig is given")
    left_out = [part.strip() for part in (without or "").split(",") if part.strip()]
    for part in left_out:
        if part not in PARTS:
            raise InputError("without", part, "one of " + ", ".join(PARTS))
    rig = load_rig(name)
    changed: dict[str, Any] = {"plant": with_parameters(rig.plant, changes), **dict.fromkeys(left_out)}
    changed |= {} if track is None else {"track": track}
    return dataclasses.replace(rig, **changed)


def parts_of(rig: Rig | CartPole) -> dict[str, Any]:
    """Returns what a rig has beside its plant, by name."""
    return {part: getattr(rig, part) for part in PARTS if getattr(rig, part, None) is not None}


def refuse_parts(rig: Rig | CartPole, command: str, honoured: Sequence[str] = ()) -> None:
    """Refuses a rig with parts that a command would ignore.

    Args:
      command: the command, which computes on the continuous clock.
      honoured: parts that it takes into account.

    Raises:
      InputError: such a rig; the message says how to leave the parts out.
    """
    ignored = [part for part in parts_of(rig) if part not in honoured]
    if ignored:
        known = " and ".join(["plant", *honoured])
        allowed = (
            f"one without {' and '.join(ignored)}, which {command} would ignore: it computes on the continuous clock, "
            f"with {known} alone; to leave out the rest add --without {','.join(ignored)}"
        )
        raise InputError("rig", ", ".join(parts_of(rig)), allowed)


def split_period(timing: Mapping[str, Any], firmware: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns the values of a section with durations and steps, now with the control period, and those of `firmware`.

    Args:
      timing: the values of the section.
      firmware: the values of the section "firmware", which has the control period.
    """
    rest = dict(firmware)
    period = {"control_period": rest.pop("control_period")} if "control_period" in rest else {}
    return {**timing, **period}, rest


def with_usual_period(
    setting: Mapping[str, Any], stated: Mapping[str, Any], given: Mapping[str, Any]
) -> dict[str, Any]:
    """Returns the arguments of a rollout with the usual control period of a rig given by name, if none is stated.

    Args:
      setting: the arguments.
      stated: those of them, dt and control_period, that the user gave.
      given: the values of the section "plant".
    """
    usual = PRESETS[given["rig"]].period if given.get("rig") in PRESETS else None
    period = stated.get("control_period", None if "dt" in stated else usual)
    if period is None or setting.get("clock") == "continuous":
        return dict(setting)
    return {**setting, "control_period": period}


@dataclasses.dataclass(frozen=True)
class Firmware:
    """Parts that run on a rig around a controller, and how often; by default the controller alone."""

    estimator: Any = None
    dead_band: float = 0.0
    """Dead band that commands are raised beyond [V]."""
    delay: int = 0
    """Control periods over which the estimator predicts."""
    simulation: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Further arguments of a rollout: its control period [s] and, on a rig, the seed of the sensors' noise."""
    notes: tuple[str, ...] = ()

    def __call__(self, controller: Any) -> Any:
        """Returns the firmware around a controller; one that is firmware already stays as it is."""
        if self.estimator is None or isinstance(controller, Digital):
            return controller
        return Digital(controller, self.estimator, dead_band=self.dead_band, delay=self.delay)

    def entries(self) -> dict[str, Any]:
        """Returns the entry `firmware` of a result, as plain values; none for a controller alone."""
        if self.estimator is None:
            return {}
        described = {"estimator": io.encode(self.estimator), "dead_band": self.dead_band, "delay": self.delay}
        return {"firmware": {**described, **self.simulation}}


BARE = Firmware()
"""No firmware: the controller alone, at every step."""


def build_firmware(
    given: Mapping[str, Any], rig: Rig | CartPole, setting: Mapping[str, Any], seed: int, controller: Any = None
) -> Firmware:
    """Builds the firmware that the options describe.

    Args:
      given: the values of the section "firmware".
      rig: the rig, or the plant alone.
      setting: arguments of the rollout: dt, and perhaps clock and control_period [s].
      seed: of the sensors' noise.
      controller: the only one that it is for, if there is only one; it may be firmware with an estimator of its own.

    Raises:
      InputError: an estimator that the controller, the rig or the clock does not allow; a cutoff without an estimator.
    """
    sensors, drive = parts_of(rig).get("sensors"), parts_of(rig).get("drive")
    slow = "control_period" if "control_period" in setting else "dt"
    period = Number("s", "control period", above=0.0).normalise(slow, setting[slow])
    rates = sensors is None or isinstance(sensors, StateSensors)
    kind = given.get("estimator", "none" if rates else "kalman")
    simulation: dict[str, Any] = {"control_period": period} if "control_period" in setting else {}
    if isinstance(rig, Rig):
        simulation["seed"] = seed
    if isinstance(controller, Digital):
        for key in given:
            raise InputError(key, given[key], "absent: the controller is a Digital, with an estimator of its own")
        return Firmware(simulation=simulation)
    if "cutoff" in given and kind != "derivative":
        raise InputError("cutoff", given["cutoff"], "absent unless the estimator is derivative")
    dead_band = float(getattr(drive, "dead_band", 0.0))
    wait = float(getattr(drive, "delay", 0.0))
    if setting.get("clock") == "continuous":
        # A rollout itself refuses sensors and delay there. It clips located demands without asking the drive.
        if given.get("estimator", "none") != "none":
            raise InputError("estimator", kind, "absent on the continuous clock: it runs once per control period")
        if setting.get("switching") == "located" and drive is not None:
            raise InputError("switching", "located", "per_step on a rig with a drive, or add --without drive")
        return Firmware(simulation=simulation)
    if kind == "none":
        band = f"commands within the drive's dead band of {dead_band:g} V have no effect, and nothing raises them"
        return Firmware(simulation=simulation, notes=(band,) if dead_band else ())
    delay = 0
    if kind == "kalman":
        if not isinstance(sensors, (Encoders, Potentiometers)):
            raise InputError("estimator", kind, "derivative or none, on a plant whose rates are measured")
        estimator: Any = kalman_observer(
            plant_of(rig),
            period=period,
            x_deviation=_deviation(getattr(sensors, "x_step", _FINEST), sensors.x_noise),
            theta_deviation=_deviation(getattr(sensors, "theta_step", _FINEST), sensors.theta_noise),
        )
        delay = round(wait / period)
        words = f"a Kalman filter designed for the plant and a control period of {period:g} s"
    else:
        estimator = FilteredDerivative(given.get("cutoff", _CUTOFF))
        words = f"a filtered derivative with a cutoff of {float(estimator.cutoff):g} rad/s"
    raised = f"; commands are raised beyond the drive's dead band of {dead_band:g} V" if dead_band else ""
    late = f"; the drive's delay of {wait:g} s is not predicted" if wait else ""
    if delay:
        late = f" and predicts them over {delay} period{'s' * (delay > 1)}, the drive's delay of {wait:g} s"
    note = f"the controller gets x and theta alone, every {period:g} s; {words} estimates the rates{late}{raised}"
    return Firmware(estimator, dead_band, delay, simulation, (note,))


def _deviation(step: Any, noise: Any) -> float:
    """Returns the standard deviation of a measurement by an encoder: of its rounding and of its noise."""
    return math.hypot(float(step) / math.sqrt(12.0), float(noise))
