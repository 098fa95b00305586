"""Parts of a rig beside its plant: sensors, drive, track and disturbance."""

from cpjax.rig.bench import Rig, plant_of
from cpjax.rig.disturbance import Disturbance, Pushes, RandomPushes, Wind
from cpjax.rig.drive import Drive
from cpjax.rig.presets import PRESETS, rig
from cpjax.rig.sensors import Encoders, Position, Potentiometers, StateSensors
from cpjax.rig.track import Track

__all__ = [
    "PRESETS",
    "Disturbance",
    "Drive",
    "Encoders",
    "Position",
    "Potentiometers",
    "Pushes",
    "RandomPushes",
    "Rig",
    "StateSensors",
    "Track",
    "Wind",
    "plant_of",
    "rig",
]
