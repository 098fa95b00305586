"""Public rigs by name. Numbers are facts with a source; where two sources differ, the note says so."""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

from cpjax.errors import InputError
from cpjax.plant import CartPole, Motor
from cpjax.plant.motor import AccelerationActuator, ForceActuator, LumpedMotor
from cpjax.rig.bench import Rig
from cpjax.rig.sensors import Encoders
from cpjax.rig.track import Track

_TURN = 2.0 * math.pi


class Preset(NamedTuple):
    """A public rig."""

    make: Callable[[], Rig]
    source: str
    period: float
    """Usual control period [s]."""
    note: str


def _quanser(pole_mass: float, centre: float, inertia: float) -> Rig:
    # Torque and back-EMF constants of 7.67e-3, 2.6 ohm, gear 3.71, pinion of 6.35 mm; efficiencies of gear and motor 1.
    ratio = 3.71 / 6.35e-3
    motor = LumpedMotor(
        force_per_voltage=ratio * 7.67e-3 / 2.6,
        damping=ratio**2 * 7.67e-3**2 / 2.6,
        reflected_mass=ratio**2 * 3.9e-7,
        voltage_limit=10.0,
    )
    plant = CartPole(
        cart_mass=0.94,
        pole_mass=pole_mass,
        pole_length=centre,
        pole_inertia=inertia,
        cart_friction=5.4,
        pivot_friction=2.4e-3,
        motor=motor,
    )
    sensors = Encoders(x_step=2.275e-5, theta_step=_TURN / 4096)
    return Rig(plant, sensors=sensors, track=Track(half_length=0.40))


def _paper() -> Rig:
    return Rig(CartPole())


def _sensorsini() -> Rig:
    plant = CartPole.rod(
        mass=0.087,
        length=0.395,
        cart_mass=0.230,
        cart_friction=5.63,
        pivot_friction=5e-5,
        motor=ForceActuator(limit=3.10),
    )
    sensors = Encoders(x_step=1e-4, theta_step=_TURN / 4096, x_noise=5e-4)
    return Rig(plant, sensors=sensors, track=Track(half_length=0.198))


def _ctms() -> Rig:
    plant = CartPole(
        cart_mass=0.5,
        pole_mass=0.2,
        pole_length=0.3,
        pole_inertia=0.006,
        cart_friction=0.1,
        gravity=9.8,
        motor=ForceActuator(limit=math.inf),
    )
    return Rig(plant)


def _fileexchange() -> Rig:
    motor = Motor(
        torque_constant=0.031,
        back_emf_constant=0.031,
        resistance=12.5,
        rotor_inertia=0.0,
        viscous_friction=0.0,
        wheel_radius=6e-3,
        voltage_limit=12.0,
    )
    plant = CartPole(
        cart_mass=0.135, pole_mass=0.1, pole_length=0.2, pole_inertia=7.176e-4, cart_friction=0.63, motor=motor
    )
    return Rig(plant)


def _capsule(mass: float, radius: float, length: float) -> float:
    """Returns the inertia of a solid capsule about its centre, across its axis [kg m^2]; `length` without the caps."""
    cylinder, ball = length, 4.0 * radius / 3.0  # volumes over pi radius^2
    about = cylinder * (length**2 / 12 + radius**2 / 4) + ball * (
        2 * radius**2 / 5 + length**2 / 4 + 3 * length * radius / 8
    )
    return mass * about / (cylinder + ball)


def _dm_control() -> Rig:
    plant = CartPole(
        cart_mass=1.0,
        pole_mass=0.1,
        pole_length=0.5,
        pole_inertia=_capsule(0.1, radius=0.045, length=1.0),
        cart_friction=5e-4,
        pivot_friction=2e-6,
        motor=LumpedMotor(force_per_voltage=10.0, voltage_limit=1.0),
    )
    return Rig(plant, track=Track(half_length=1.8))


def _gymnasium() -> Rig:
    def mass(radius: float, length: float) -> float:  # of a capsule of 1000 kg/m^3
        return 1000.0 * math.pi * radius**2 * (length + 4.0 * radius / 3.0)

    length = math.hypot(0.6, 0.001)
    pole = mass(0.049, length)
    plant = CartPole(
        cart_mass=mass(0.1, 0.2),
        pole_mass=pole,
        pole_length=length / 2,
        pole_inertia=_capsule(pole, radius=0.049, length=length),
        cart_friction=1.0,
        pivot_friction=1.0,
        motor=LumpedMotor(force_per_voltage=100.0, voltage_limit=3.0),
    )
    return Rig(plant, track=Track(half_length=1.0))


def _googol() -> Rig:
    plant = CartPole(
        cart_mass=1.096,
        pole_mass=0.109,
        pole_length=0.25,
        pole_inertia=0.109 * 0.25**2 / 3.0,
        gravity=9.8,
        motor=AccelerationActuator(limit=10.0),
    )
    return Rig(plant, track=Track(half_length=0.25))


PRESETS: Mapping[str, Preset] = {
    "paper": Preset(_paper, "the student paper's appendix", 0.002, "no sensors, delay or track are stated"),
    "quanser-ip02-long": Preset(
        lambda: _quanser(0.230, 0.3302, 7.88e-3),
        "Quanser IP02 user manual and course files, long pole",
        0.002,
        "efficiencies of gear (0.9 to 1) and motor (0.69 to 1) are taken as 1; the course's watchdogs stop at 0.30 to "
        "0.35 m",
    ),
    "quanser-ip02-medium": Preset(
        lambda: _quanser(0.127, 0.1778, 1.2e-3),
        "Quanser IP02 user manual and course files, medium pole",
        0.002,
        "as quanser-ip02-long",
    ),
    "sensorsini": Preset(
        _sensorsini,
        "CartPoleSimulation (SensorsINI, MIT licence), cartpole_physical_parameters.yml",
        0.02,
        "a force of at most 3.10 N, back-EMF inside the cart's friction; its rate noise of 0.075 rad/s is left out",
    ),
    "ctms": Preset(
        _ctms,
        "Control Tutorials for MATLAB and Simulink, Inverted Pendulum",
        0.01,
        "the command is a force without a limit",
    ),
    "fileexchange-97182": Preset(_fileexchange, "MathWorks File Exchange 97182", 0.01, "no track is stated"),
    "dm-control": Preset(
        _dm_control,
        "dm_control (Apache-2.0 licence), suite/cartpole.xml",
        0.01,
        "the command is the action, -1 to 1, of 10 N each; there a positive angle leans towards positive x",
    ),
    "gymnasium": Preset(
        _gymnasium,
        "Gymnasium (MIT licence), envs/mujoco/assets/inverted_pendulum.xml",
        0.04,
        "the command is the action, -3 to 3, of 100 N each, held for two steps of 0.02 s; there a positive angle leans "
        "towards positive x, and angle 0 leans by 1.7 mrad",
    ),
    "googol": Preset(
        _googol,
        "Googol Technology's linear inverted pendulum, course files: theta'' = 29.4 theta + 3 x''",
        0.005,
        "the command is the cart's acceleration, so that its mass and friction have no effect; tracks of 0.25 to 0.5 m "
        "are stated, no control period (5 ms is taken); 29.4 and 3 follow from the inertia of a uniform "
        "rod, not from the 0.0034 kg m^2 that are stated too",
    ),
}
"""Public rigs by name."""


def rig(name: str) -> Rig:
    """Returns a public rig by name; `cpjax.rig.presets.PRESETS` has their sources and notes.

    Raises:
      InputError: another name.
    """
    if name not in PRESETS:
        raise InputError("rig", name, "one of " + ", ".join(PRESETS))
    return PRESETS[name].make()
