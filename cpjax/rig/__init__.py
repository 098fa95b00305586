"""Parts of a rig beside its plant: sensors, drive and track."""

from cpjax.rig.bench import Rig, plant_of
from cpjax.rig.drive import Drive
from cpjax.rig.presets import PRESETS, rig
from cpjax.rig.sensors import Encoders, Position
from cpjax.rig.track import Track

__all__ = ["PRESETS", "Drive", "Encoders", "Position", "Rig", "Track", "plant_of", "rig"]
