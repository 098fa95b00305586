"""Rig: a plant with the sensors, the drive and the track that it has on the bench."""

import dataclasses
from typing import Any

from cpjax.errors import InputError
from cpjax.plant import CartPole
from cpjax.pytree import Scalar, part, pytree
from cpjax.rig.drive import Drive
from cpjax.rig.sensors import Encoders
from cpjax.rig.track import Track


@pytree
class Rig:
    """A plant on the bench. It is taken wherever a plant is; a part that is None is ideal and costs nothing."""

    plant: CartPole = part("a cpjax.CartPole", "accelerations", "saturate")
    sensors: Encoders | None = None
    """None measures the whole state without error."""
    drive: Drive | None = None
    """None applies the clipped command at once."""
    track: Track | None = None
    """None is endless."""

    def __post_init__(self) -> None:
        for name, kind in (("sensors", Encoders), ("drive", Drive), ("track", Track)):
            value = getattr(self, name)
            if value is not None and not isinstance(value, kind):
                raise InputError(f"Rig.{name}", value, f"a cpjax.{kind.__name__}, or None for an ideal one")

    @property
    def dynamics(self) -> Any:
        """The plant as the loop sees it, with the drive's dead band and the track's ends."""
        if self.drive is None and self.track is None:
            return self.plant
        return OnTheBench(self.plant, Drive() if self.drive is None else self.drive, self.track)


def plant_of(rig: Rig | CartPole) -> CartPole:
    """Returns the plant of a rig; a plant alone is its own."""
    return rig.plant if isinstance(rig, Rig) else rig


@pytree
class OnTheBench:
    """A cart-pole with its drive and track, for the loop."""

    plant: CartPole = part("a cpjax.CartPole", "accelerations", "saturate")
    drive: Drive = part("a cpjax.Drive", "apply")
    track: Track | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(object.__getattribute__(self, "plant"), name)

    @property
    def limits(self) -> Any:
        """Largest allowed magnitude of each component of the state."""
        limits = self.plant.limits
        return limits if self.track is None else dataclasses.replace(limits, x=self.track.half_length)

    def coordinates(self, state: Any) -> Any:
        return self.plant.coordinates(state)

    def state(self, q: Any, v: Any) -> Any:
        return self.plant.state(q, v)

    def geometry(self, q: Any) -> Any:
        return self.plant.geometry(q)

    def geometry_near(self, geometry: Any, change: Any) -> Any:
        return self.plant.geometry_near(geometry, change)

    def accelerations(self, geometry: Any, v: Any, u: Scalar) -> Any:
        return self.plant.accelerations(geometry, v, u)

    def outputs(self, state: Any, acceleration: Any, u: Scalar) -> Any:
        return self.plant.outputs(state, acceleration, u)

    def saturate(self, command: Scalar) -> Scalar:
        return self.drive.apply(self.plant.saturate(command))
