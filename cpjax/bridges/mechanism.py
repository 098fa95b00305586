"""A cart-pole as bodies and joints, as files of other simulators describe it, and its conversion to a rig."""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cpjax.errors import InputError
from cpjax.plant import CartPole, ForceActuator, LumpedMotor
from cpjax.plant.state import State
from cpjax.pytree import Scalars
from cpjax.rig import Rig, Track

Vector = Float[np.ndarray, "3"]
"""A vector in the world's frame."""

TILT = 1e-5
"""Largest deviation of an axis from level [rad]: angles in files are rounded, as 1.5708 for a quarter of a turn is."""

ROUNDING = 1e-3
"""Relative excess up to which an inertia that is just possible is accepted: files round."""

WIDEST = 10.0
"""Largest radius of gyration of a pole without known geometry, in distances from pivot to centre of mass."""


class Body(NamedTuple):
    """A rigid body in the file's initial configuration."""

    name: str
    mass: float
    """[kg]"""
    centre: Vector
    """Centre of mass [m]."""
    inertia: Float[np.ndarray, "3 3"]
    """About the centre of mass, in the world's axes [kg m^2]."""


class Joint(NamedTuple):
    """A joint in the file's initial configuration."""

    name: str
    anchor: Vector
    """A point on its axis [m]."""
    axis: Vector
    """Unit vector of a positive motion."""
    position: float
    """Its coordinate in this configuration [m or rad]."""
    damping: float
    """[N s/m or N m s/rad]"""
    dry_friction: float
    """[N or N m]"""
    armature: float
    """Mass or inertia that the drive's rotor adds [kg or kg m^2]."""
    range: tuple[float, float] | None
    """Least and largest coordinate; None for any."""


class Mechanism(NamedTuple):
    """A cart-pole as a file describes it."""

    file: str
    gravity: Vector
    """[m/s^2]"""
    slide: Joint
    hinge: Joint
    cart: Sequence[Body]
    """Bodies that only the slide moves."""
    pole: Sequence[Body]
    """Bodies that slide and hinge move."""
    outline: Sequence[tuple[Vector, float]]
    """Balls that contain the pole's geometry: centre and radius [m]; empty if that of a body is unknown."""
    gain: float
    """Force along the slide's axis per command [N]."""
    limit: float
    """Largest magnitude of the command."""


@dataclasses.dataclass(frozen=True)
class ImportedModel:
    """A rig that was read from a file, and where the file's joint coordinates are zero and positive.

        x = x_sign (slide - x_origin),    theta = theta_sign (hinge - upright)

    A positive command has its meaning in the file: `x_sign` is chosen so that it pushes towards positive x.

    Attributes:
      rig: the rig; its command is the file's control, or the force [N] where the file has none.
      x_sign: 1, or -1 where a positive command pushes towards negative slide coordinates.
      x_origin: the slide's coordinate at x = 0: the middle of its range, or 0 without one [m].
      theta_sign: 1, or -1 where a positive hinge coordinate leans the pole towards positive x.
      upright: the hinge's coordinate at theta = 0, with the pole's centre of mass above the pivot [rad].
      left_out: what the file says and the rig does not contain, in words.
    """

    rig: Rig
    x_sign: float
    x_origin: float
    theta_sign: float
    upright: float
    left_out: tuple[str, ...]

    def notes(self) -> list[str]:
        """Returns in words how the joints relate to x and theta, and what was left out."""
        sign = {1.0: "", -1.0: "-"}
        return [
            f"x = {sign[self.x_sign]}(slide - {self.x_origin:g}), theta = {sign[self.theta_sign]}(hinge - "
            f"{self.upright:g}); here a positive theta leans towards negative x",
            *(f"left out: {one}" for one in self.left_out),
        ]

    def state(self, positions: tuple[Scalars, Scalars], rates: tuple[Scalars, Scalars] = (0.0, 0.0)) -> State:
        """Returns the state of the joints' coordinates.

        Args:
          positions: coordinates of slide and hinge [m, rad].
          rates: their rates [m/s, rad/s].
        """
        return State(
            self.x_sign * (positions[0] - self.x_origin),
            self.x_sign * rates[0],
            self.theta_sign * (positions[1] - self.upright),
            self.theta_sign * rates[1],
        )

    def joints(self, state: State) -> tuple[tuple[Scalars, Scalars], tuple[Scalars, Scalars]]:
        """Returns positions and rates of slide and hinge in a state, the inverse of `state`."""
        positions = (self.x_sign * state.x + self.x_origin, self.theta_sign * state.theta + self.upright)
        return positions, (self.x_sign * state.x_dot, self.theta_sign * state.theta_dot)


def imported(found: Mechanism) -> ImportedModel:
    """Converts a mechanism to a rig with the same equations of motion.

    Raises:
      InputError: it is no cart-pole in a vertical plane, its inertia is impossible, or it has what a rig has not.
    """
    slide, hinge = found.slide, found.hinge
    strength = float(np.linalg.norm(found.gravity))
    if not 0.0 < strength < math.inf:
        raise InputError(f"{found.file}: gravity", found.gravity.tolist(), "a finite vector that is not zero [m/s^2]")
    up, forward = -found.gravity / strength, math.copysign(1.0, found.gain) * slide.axis
    for joint, level in ((slide, [up]), (hinge, [up, slide.axis])):
        if any(abs(float(joint.axis @ other)) > TILT for other in level):
            allowed = "level, and the hinge's square to the slide's: the pole swings in the vertical plane of the slide"
            raise InputError(f"{found.file}: axis of {joint.name}", joint.axis.tolist(), allowed)
    cart, pole = _united(found, "cart", found.cart), _united(found, "pole", found.pole)
    arm = _across(pole.centre - hinge.anchor, hinge.axis)
    length = float(np.linalg.norm(arm))
    if not length > 1e-6:
        allowed = "above 0 m from the hinge's axis: a pole that gravity turns"
        raise InputError(f"{found.file}: centre of mass of the pole", length, allowed)
    inertia = float(hinge.axis @ pole.inertia @ hinge.axis)
    _check_extent(found, pole, inertia, length)
    lean = math.atan2(-float(arm @ forward), float(arm @ up))  # theta of the initial configuration
    lean += 2.0 * math.pi if lean < -math.pi + 1e-9 else 0.0  # a hanging pole has theta = +pi
    # A positive rotation about the hinge's axis moves an upright pole along axis x up; theta grows towards -forward.
    theta_sign = math.copysign(1.0, -float(np.cross(hinge.axis, up) @ forward))
    low, high = slide.range or (0.0, 0.0)
    if slide.range is not None and not low < high:
        raise InputError(f"{found.file}: range of {slide.name}", slide.range, "from a smaller to a larger number [m]")
    plant = CartPole(
        cart_mass=cart.mass,
        pole_mass=pole.mass,
        pole_length=length,
        # The cart does not turn, so that the rotor of a motor at the pivot turns as the pole does.
        pole_inertia=inertia + hinge.armature,
        gravity=strength,
        cart_friction=slide.damping,
        pivot_friction=hinge.damping,
        motor=_drive(found),
        coulomb_friction=slide.dry_friction,
        pivot_coulomb_friction=hinge.dry_friction,
    )
    return ImportedModel(
        rig=Rig(plant, track=None if slide.range is None else Track(0.5 * (high - low))),
        x_sign=math.copysign(1.0, found.gain),
        x_origin=0.5 * (low + high),
        theta_sign=theta_sign,
        upright=hinge.position - theta_sign * lean,
        left_out=()
        if hinge.range is None
        else (f"range of {hinge.name}: {hinge.range[0]:g} to {hinge.range[1]:g} rad",),
    )


def _united(found: Mechanism, name: str, bodies: Sequence[Body]) -> Body:
    """Returns bodies that move together as one, after checking each."""
    for body in bodies:
        _check_body(found.file, body)
    mass = sum(body.mass for body in bodies)
    if not 0.0 < mass < math.inf:
        allowed = "above 0 kg: slide and hinge each move a body with mass, and the slide carries the hinge"
        raise InputError(f"{found.file}: mass of the {name}", mass, allowed)
    centre = sum((body.mass * body.centre for body in bodies), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for body in bodies:
        offset = body.centre - centre
        inertia += body.inertia + body.mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    return Body(name, mass, centre, inertia)


def _check_body(file: str, body: Body) -> None:
    """Refuses masses and inertias that no rigid body has."""
    field = f"{file}: {body.name}"
    if not 0.0 <= body.mass < math.inf:
        raise InputError(f"{field}: mass", body.mass, "a finite number at least 0 [kg]")
    if body.mass == 0.0 and not np.any(body.inertia):
        return  # a frame
    moments = np.linalg.eigvalsh(body.inertia)
    if body.mass == 0.0 or not moments[0] > 0.0:
        raise InputError(f"{field}: principal inertias", moments.tolist(), "above 0 kg m^2, of a mass above 0 kg")
    if moments[0] + moments[1] < moments[2] * (1.0 - ROUNDING):
        allowed = "each at most the sum of the other two, as those of every rigid body are [kg m^2]"
        raise InputError(f"{field}: principal inertias", moments.tolist(), allowed)


def _check_extent(found: Mechanism, pole: Body, inertia: float, length: float) -> None:
    """Refuses an inertia that the pole's mass cannot have within its geometry; without geometry, an absurd one."""
    reach = WIDEST * length
    if found.outline:
        axis = found.hinge.axis
        ends = [float(np.linalg.norm(_across(c - pole.centre, axis))) + radius for c, radius in found.outline]
        reach = max(length, *ends)
    largest = pole.mass * reach * reach
    if inertia > largest * (1.0 + ROUNDING):
        allowed = f"at most {largest:.4g} kg m^2: {pole.mass:.4g} kg within {reach:.4g} m of the centre of mass"
        raise InputError(f"{found.file}: inertia of the pole", inertia, allowed)


def _across(vector: Vector, axis: Vector) -> Vector:
    """Returns the part of a vector that is square to a unit vector."""
    part: Vector = vector - (vector @ axis) * axis
    return part


def _drive(found: Mechanism) -> ForceActuator | LumpedMotor:
    """Returns the drive whose command is the file's control."""
    gain, rotor = abs(found.gain), found.slide.armature
    if gain == 1.0 and rotor == 0.0:
        return ForceActuator(limit=found.limit)
    return LumpedMotor(force_per_voltage=gain, reflected_mass=rotor, voltage_limit=found.limit)
