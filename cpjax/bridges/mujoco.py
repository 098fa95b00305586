"""The plant as a model of MuJoCo, in its own format; MuJoCo itself is not imported."""

import math
from typing import Literal

from cpjax.bridges.known import concrete_plant, unexpressed
from cpjax.errors import InputError
from cpjax.plant import CartPole, Motor
from cpjax.pytree import Number

LEAST_INERTIA = 1e-9
"""MuJoCo asks for some inertia of a point bob: this much [kg m^2]."""

_STEP = Number("s", "integration step", above=0.0)

# Positive theta leans towards negative x: a turn about -y. The wheels' force is an actuator on the cart's slide, what
# the back-EMF and the bearings take is damping of that slide, and the rotor is its armature.
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
    """The plant for `mujoco.MjModel.from_xml_string`.

    Joints x and theta in cpjax's sense and units (qpos, qvel); one control, the voltage [V], which MuJoCo clips as the
    motor does. A point bob gets the inertia `LEAST_INERTIA`.

    Args:
      dt: integration step [s].
      integrator: MuJoCo's name of it.

    Raises:
      InputError: the class of `plant` or of its motor is not cpjax's own; a parameter that the model does not hold is
        not zero (or what is declared neutral); a number is not known; dt is not positive.
    """
    plant = concrete_plant(plant)
    motor = plant.motor
    for path, part, cls in (("plant", plant, CartPole), ("plant.motor", motor, Motor)):
        if type(part) is not cls:
            raise InputError(path, part, f"a cpjax.{cls.__name__}; this MuJoCo model cannot express any other class")
        for name, rule in unexpressed(part).items():
            allowed = f"{rule.neutral:g} [{rule.unit}]; this MuJoCo model cannot express any other"
            raise InputError(f"{path}.{name}", getattr(part, name), allowed)
    turns = motor.gear_ratio / motor.wheel_radius  # rotor radians per metre
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
