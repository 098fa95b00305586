"""Rig: a plant with the sensors, the drive, the track and the disturbances that it has on the bench."""

import math
from typing import Any

import numpy as np

from cpjax.errors import InputError
from cpjax.plant import CartPole, Motor
from cpjax.plant.contact import in_contact
from cpjax.pytree import is_traced, part, pytree
from cpjax.rig.disturbance import Disturbance
from cpjax.rig.drive import Drive
from cpjax.rig.dynamics import ChangingBench, OnTheBench
from cpjax.rig.sensors import Encoders, Potentiometers, Sensors, StateSensors
from cpjax.rig.track import Track


@pytree
class Rig:
    """A plant on the bench. It is taken wherever a plant is; a part that is None is ideal and costs nothing."""

    plant: CartPole = part("a cpjax.CartPole", "accelerations", "saturate")
    sensors: Sensors | None = None
    """None measures the whole state without error."""
    drive: Drive | None = None
    """None applies the clipped command at once."""
    track: Track | None = None
    """None is endless."""
    disturbance: Disturbance | None = None
    """None is a level rail on which nothing pushes."""

    def __post_init__(self) -> None:
        kinds = {
            "sensors": (Encoders, Potentiometers, StateSensors),
            "drive": (Drive,),
            "track": (Track,),
            "disturbance": (Disturbance,),
        }
        for name, classes in kinds.items():
            value = getattr(self, name)
            if value is not None and not isinstance(value, classes):
                names = " or ".join(f"cpjax.{kind.__name__}" for kind in classes)
                raise InputError(f"Rig.{name}", value, f"a {names}, or None for an ideal one")
        motor = self.plant.motor
        if self.drive is not None and self.drive.source_resistance is not None:
            if not isinstance(motor, Motor) or motor.inductance is not None:
                allowed = "None, unless the plant has a cpjax.Motor without inductance, whose current is known"
                raise InputError("Drive.source_resistance", self.drive.source_resistance, allowed)
            limit = motor.voltage_limit
            if not is_traced(limit) and not np.ndim(limit) and not math.isfinite(float(limit)):
                raise InputError("Motor.voltage_limit", limit, "finite, where the supply sags")

    @property
    def dynamics(self) -> Any:
        """The plant as the loop sees it: the `CartPole` itself, if nothing on the bench changes how it moves."""
        return self.moving(0, 0)

    def moving(self, seed: Any, run: Any) -> Any:
        """Returns `dynamics` with the noise of a rollout.

        Args:
          seed: of what is random, uint32.
          run: number of the run, uint32, or of each run.
        """
        track = self.track
        stops = track is not None and track.ends == "stop"
        plant: Any = self.plant
        on_bench = self.drive is not None or self.disturbance is not None or (track is not None and not stops)
        inductive = getattr(plant.motor, "inductance", None) is not None
        if on_bench or inductive:
            drive = Drive() if self.drive is None else self.drive
            parts = plant, drive, None if stops else track, self.disturbance
            changes = inductive or drive.lag is not None or (self.disturbance is not None and self.disturbance.changes)
            plant = ChangingBench(*parts, seed, run) if changes else OnTheBench(*parts)
        if track is not None and stops:
            return in_contact(plant, track.half_length, track.restitution)
        return in_contact(plant)


def plant_of(rig: Rig | CartPole) -> CartPole:
    """Returns the plant of a rig; a plant alone is its own."""
    return rig.plant if isinstance(rig, Rig) else rig
