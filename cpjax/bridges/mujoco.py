"""Conversion of the plant to a model in MuJoCo's XML format; MuJoCo itself is not imported."""

import math
from typing import Literal

from cpjax.bridges.known import concrete_plant, unexpressed
from cpjax.errors import InputError
from cpjax.plant import CartPole, Motor
from cpjax.pytree import Number

LEAST_INERTIA = 1e-9
"""Inertia given to a point bob, as MuJoCo requires one [kg m^2]."""

_STEP = Number("s", "integration step", above=0.0)

# Positive theta leans towards negative x: a rotation about -y. The wheels' force is an actuator on the cart's slide
# joint, back-EMF and bearing friction are damping of that joint, and the rotor's inertia is its armature.
_MODEL = """
<mujoco model="cart_pole">
  <option timestep="{dt}" integrator="{integrator}" gravity="0 0 -{gravity}"/>
  <compiler angle="radian" boundmass="0" boundinertia="0"/>
  <worldbody>
    <body name="cart">
      <joint name="x" type="slide" axis="1 0 0" damping="{damping}" armature="{armature}"/>
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


def model_xml(
    plant: CartPole, dt: float, integrator: Literal["RK4", "Euler", "implicit", "implicitfast"] = "RK4"
) -> str:
    """Returns the plant as XML for `mujoco.MjModel.from_xml_string`.

    Joints x and theta have cpjax's signs and units (qpos, qvel); the one control is the voltage [V], which MuJoCo clips
    as the motor does. A point bob gets the inertia `LEAST_INERTIA`.

    Args:
      plant: a plant with concrete numbers.
      dt: integration step [s].
      integrator: MuJoCo's name of the integrator.

    Raises:
      InputError: the class of `plant` or of its motor is not cpjax's own; a parameter that the model does not contain
        is not at its neutral value (zero unless declared); a number is not concrete; dt is not positive.
    """
    plant = concrete_plant(plant)
    motor = plant.motor
    for path, part, cls in (("plant", plant, CartPole), ("plant.motor", motor, Motor)):
        if type(part) is not cls:
            raise InputError(path, part, f"a cpjax.{cls.__name__}; this MuJoCo model cannot express any other class")
        for name, rule in unexpressed(part).items():
            allowed = f"{rule.neutral:g} [{rule.unit}]; this MuJoCo model cannot express any other"
            raise InputError(f"{path}.{name}", getattr(part, name), allowed)
    turns = motor.gear_ratio / motor.wheel_radius  # rotor angle per cart travel [rad/m]
    numbers: dict[str, object] = {
        "dt": float(_STEP.normalise("dt", dt)),
        "gravity": plant.gravity,
        "cart_mass": plant.cart_mass,
        "pole_mass": plant.pole_mass,
        "pole_length": plant.pole_length,
        "inertia": max(plant.pole_inertia, LEAST_INERTIA),
        "pivot_friction": plant.pivot_friction,
        "armature": motor.rotor_inertia * turns**2,
        "damping": plant.cart_friction
        + turns**2 * (motor.viscous_friction + motor.torque_constant * motor.back_emf_constant / motor.resistance),
        "gear": turns * motor.torque_constant / motor.resistance,
    }
    limit = float(motor.voltage_limit)
    limits = f'ctrllimited="true" ctrlrange="-{limit} {limit}"' if math.isfinite(limit) else ""
    return _MODEL.format(integrator=integrator, limits=limits, **numbers)
