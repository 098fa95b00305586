"""Conversion of a plant or rig to a model in MuJoCo's XML format; MuJoCo itself is not imported."""

import math
from pathlib import Path
from typing import Any, Literal, TypeAlias

from cpjax.bridges.known import concrete_plant, require_concrete, unexpressed
from cpjax.errors import InputError
from cpjax.files import write_text
from cpjax.plant import CartPole, ForceActuator, LumpedMotor, Motor
from cpjax.pytree import Number
from cpjax.rig import Rig

LEAST_INERTIA = 1e-9
"""Inertia given to a point bob, as MuJoCo requires one [kg m^2]."""

Integrator: TypeAlias = Literal["RK4", "Euler", "implicit", "implicitfast"]
"""Names of MuJoCo's integrators."""

_STEP = Number("s", "integration step", above=0.0)

# Positive theta leans towards negative x: a rotation about -y. The wheels' force is an actuator on the cart's slide
# joint, back-EMF and bearing friction are damping of that joint, and the rotor's inertia is its armature.
_MODEL = """
<mujoco model="cart_pole">
  <option timestep="{dt}" integrator="{integrator}" gravity="0 0 -{gravity}"/>
  <compiler angle="radian" boundmass="0" boundinertia="0"/>
  <worldbody>
    <body name="cart">
      <joint name="x" type="slide" axis="1 0 0" damping="{damping}" armature="{armature}" {range}/>
      <inertial pos="0 0 0" mass="{cart_mass}" diaginertia="1 1 1"/>
      <body name="pole">
        <joint name="theta" type="hinge" axis="0 -1 0" damping="{pivot_friction}"/>
        <inertial pos="0 0 {pole_length}" mass="{pole_mass}" diaginertia="{inertia} {inertia} {inertia}"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="voltage" joint="x" gear="{gear}" {limits}/>
  </actuator>
</mujoco>
"""


def model_xml(plant: CartPole | Rig, dt: float, integrator: Integrator = "RK4") -> str:
    """Returns a plant or rig as XML for `mujoco.MjModel.from_xml_string`.

    Joints x and theta have cpjax's signs and units (qpos, qvel); the one control is the voltage [V], of a
    `ForceActuator` the force [N], which MuJoCo clips as the drive does. A point bob gets the inertia `LEAST_INERTIA`. A
    rig's track is the range of joint x, whose ends stop the cart there; its sensors are the firmware's and not in the
    model.

    Args:
      plant: a plant or rig with concrete numbers.
      dt: integration step [s].
      integrator: MuJoCo's name of the integrator.

    Raises:
      InputError: the class of the plant or of its motor is not cpjax's own, or the motor an `AccelerationActuator`; a
        parameter that the model does not contain is not at its neutral value (zero unless declared), of the plant, its
        motor or the rig's drive; the rig has a disturbance; a number is not concrete; dt is not positive.
    """
    track = None
    if isinstance(plant, Rig):
        rig = plant
        require_concrete("rig", rig)
        for name, rule in unexpressed(rig.drive).items():
            allowed = f"{rule.neutral:g} [{rule.unit}]; this MuJoCo model cannot express any other"
            raise InputError(f"rig.drive.{name}", getattr(rig.drive, name), allowed)
        if rig.disturbance is not None:
            raise InputError("rig.disturbance", rig.disturbance, "None; this MuJoCo model cannot express any")
        plant, track = rig.plant, rig.track
    plant = concrete_plant(plant)
    motor = plant.motor
    for path, part, classes in (("plant", plant, (CartPole,)), ("plant.motor", motor, _DRIVES)):
        if type(part) not in classes:
            names = " or ".join(f"cpjax.{cls.__name__}" for cls in classes)
            raise InputError(path, part, f"a {names}; this MuJoCo model cannot express any other class")
    for path, part in (("plant", plant), ("plant.motor", motor)):
        for name, rule in unexpressed(part).items() if type(part) in (CartPole, Motor) else ():
            allowed = f"{rule.neutral:g} [{rule.unit}]; this MuJoCo model cannot express any other"
            raise InputError(f"{path}.{name}", getattr(part, name), allowed)
    armature, damping, gear = _at_the_cart(motor)
    limit = float(motor.voltage_limit)
    numbers: dict[str, object] = {
        "dt": float(_STEP.normalise("dt", dt)),
        "gravity": plant.gravity,
        "cart_mass": plant.cart_mass,
        "pole_mass": plant.pole_mass,
        "pole_length": plant.pole_length,
        "inertia": max(plant.pole_inertia, LEAST_INERTIA),
        "pivot_friction": plant.pivot_friction,
        "armature": armature,
        "damping": plant.cart_friction + damping,
        "gear": gear,
        "limits": f'ctrllimited="true" ctrlrange="-{limit} {limit}"' if math.isfinite(limit) else "",
        "range": "" if track is None else f'limited="true" range="-{track.half_length} {track.half_length}"',
    }
    return _MODEL.format(integrator=integrator, **numbers)


def save_mjcf(path: str | Path, rig: CartPole | Rig, *, dt: float = 0.002, integrator: Integrator = "RK4") -> None:
    """Writes a plant or rig as an MJCF file; see `model_xml`. `cpjax.bridges.models.load_model` reads it.

    Args:
      path: a file name that ends in .xml.
      rig: a plant or rig with concrete numbers.
      dt: integration step [s].
      integrator: MuJoCo's name of the integrator.

    Raises:
      InputError: as for `model_xml`; another extension, or a path that cannot be written.
    """
    if not isinstance(path, (str, Path)) or Path(path).suffix.lower() != ".xml":
        raise InputError("path", path, "a file name that ends in .xml")
    write_text(Path(path), model_xml(rig, dt, integrator).lstrip())


_DRIVES = (Motor, LumpedMotor, ForceActuator)


def _at_the_cart(motor: Any) -> tuple[Any, Any, Any]:
    """Returns a drive's mass [kg] and damping [N s/m] at the cart, and its force per command [N/V]."""
    if type(motor) is not Motor:
        return float(motor.reflected_mass), float(motor.damping), float(motor.force_per_voltage)
    turns = motor.gear_ratio / motor.wheel_radius  # rotor angle per cart travel [rad/m]
    return (
        motor.rotor_inertia * turns**2,
        turns**2 * (motor.viscous_friction + motor.torque_constant * motor.back_emf_constant / motor.resistance),
        turns * motor.torque_constant / motor.resistance,
    )
