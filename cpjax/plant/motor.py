"""Drives of the cart: a DC motor with gear and wheel, its lumped form, a force, and an acceleration."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from cpjax.pytree import Scalars, number, pytree


def _at_the_rotor(of_the_cart: float, plant: Any) -> Scalars:
    """Converts a mass or damping of the cart to the equivalent inertia or damping at the rotor."""
    return of_the_cart * (plant.motor.wheel_radius / plant.motor.gear_ratio) ** 2


@pytree
class Motor:
    """A DC motor, a gear and a wheel that does not slip. Defaults: the paper's appendix.

    A terminal voltage u drives the current i = (u - k_V n x' / r) / R, and the wheels exert on the cart the force
    F = n k_T i / r - n^2 B_m x' / r^2. With an `inductance` L, the current follows that value with the time constant
    L / R (on the sampled clock); the linear model and the methods here leave it out.
    """

    torque_constant: Scalars = number("N m/A", "torque per current, k_T", default=1.25, above=0.0, uncertain=True)
    back_emf_constant: Scalars = number(
        "V s/rad",
        "voltage per rotor speed, k_V",
        default=1.0,
        at_least=0.0,
        uncertain=True,
        typical=lambda plant: plant.motor.torque_constant,
        drawn=0.0,  # zero back-EMF is an idealised model, not a motor with a small, uncertain back-EMF
    )
    resistance: Scalars = number("ohm", "resistance of the winding, R", default=1.25, above=0.0, uncertain=True)
    rotor_inertia: Scalars = number(
        "kg m^2",
        "rotor inertia, J_m",
        default=7e-6,
        at_least=0.0,
        typical=lambda plant: _at_the_rotor(float(plant.cart_mass), plant),
    )
    viscous_friction: Scalars = number(
        "N m s/rad",
        "bearing friction, B_m",
        default=1e-5,
        at_least=0.0,
        typical=lambda plant: _at_the_rotor(float(plant.motor.damping), plant),
    )
    wheel_radius: Scalars = number("m", "wheel radius, r", default=1.0, above=0.0)
    gear_ratio: Scalars = number("1", "rotor turns per wheel turn, n", default=1.0, above=0.0)
    voltage_limit: Scalars = number(
        "V", "supply: |u| is clipped here", default=12.0, above=0.0, infinite=True, linear=False
    )
    inductance: Scalars | None = number(
        "H", "inductance of the winding, L", default=None, above=0.0, linear=False, optional=True
    )

    def saturate(self, voltage: Scalars) -> Float[Array, "*batch"]:
        """Clips the demanded voltage [V] to the supply; the derivative is 1 inside, 0 outside, 1/2 on the limit."""
        return jnp.maximum(-self.voltage_limit, jnp.minimum(self.voltage_limit, voltage))

    def current(self, voltage: Scalars, x_dot: Scalars) -> Scalars:
        """Returns the winding current [A] at an applied voltage [V] and cart velocity [m/s]."""
        return (voltage - self.back_emf_constant * self.gear_ratio / self.wheel_radius * x_dot) / self.resistance

    def force(self, voltage: Scalars, x_dot: Scalars) -> Scalars:
        """Returns the horizontal force of the wheels on the cart [N].

        F = (n k_T / (R r)) u - n^2 (B_m + k_T k_V / R) x' / r^2        (paper, section III; r = 1 m and n = 1 there)

        Args:
          voltage: terminal voltage [V], already clipped to the supply.
          x_dot: cart velocity [m/s].
        """
        return self.force_per_voltage * voltage - self.damping * x_dot

    def voltage_for_force(self, force: Scalars, x_dot: Scalars) -> Scalars:
        """Returns the unclipped terminal voltage [V] for a wheel force `force` [N] at cart velocity `x_dot` [m/s]."""
        return (force + self.damping * x_dot) * (1.0 / self.force_per_voltage)

    @property
    def force_per_voltage(self) -> Scalars:
        """Wheel force per terminal voltage, n k_T / (R r) [N/V]."""
        return self.gear_ratio * self.torque_constant / (self.resistance * self.wheel_radius)

    @property
    def damping(self) -> Scalars:
        """Damping of the cart by bearing friction and back-EMF together [N s/m]: n^2 (B_m + k_T k_V / R) / r^2."""
        ratio = self.gear_ratio / self.wheel_radius
        return ratio * ratio * (self.viscous_friction + self.torque_constant * self.back_emf_constant / self.resistance)

    @property
    def reflected_mass(self) -> Scalars:
        """Rotor inertia as an equivalent mass at the cart [kg]: n^2 J_m / r^2."""
        ratio = self.gear_ratio / self.wheel_radius
        return ratio * ratio * self.rotor_inertia


@pytree
class LumpedMotor:
    """A drive known by what moves the cart: force per voltage, and a damping that contains the back-EMF."""

    force_per_voltage: Scalars = number("N/V", "force on the cart per terminal voltage", above=0.0, uncertain=True)
    damping: Scalars = number("N s/m", "damping of the cart by the drive, back-EMF included", at_least=0.0, default=0.0)
    reflected_mass: Scalars = number("kg", "rotor as an equivalent mass at the cart", at_least=0.0, default=0.0)
    voltage_limit: Scalars = number(
        "V", "supply: |u| is clipped here", default=12.0, above=0.0, infinite=True, linear=False
    )

    def saturate(self, voltage: Scalars) -> Float[Array, "*batch"]:
        """Clips the demanded voltage [V] to the supply; the derivative is 1 inside, 0 outside, 1/2 on the limit."""
        return jnp.maximum(-self.voltage_limit, jnp.minimum(self.voltage_limit, voltage))

    def force(self, voltage: Scalars, x_dot: Scalars) -> Scalars:
        """Returns the force on the cart [N] at an applied voltage [V] and cart velocity [m/s]."""
        return self.force_per_voltage * voltage - self.damping * x_dot

    def voltage_for_force(self, force: Scalars, x_dot: Scalars) -> Scalars:
        """Returns the unclipped terminal voltage [V] for a force [N] at cart velocity `x_dot` [m/s]."""
        return (force + self.damping * x_dot) * (1.0 / self.force_per_voltage)


class _Direct:
    """A drive without dynamics: the plant takes the clipped command as it is."""

    limit: Scalars

    @property
    def voltage_limit(self) -> Scalars:
        """The limit of the command, in its unit."""
        return self.limit

    @property
    def reflected_mass(self) -> float:
        """Mass that the drive adds to the cart: none."""
        return 0.0

    @property
    def damping(self) -> float:
        """Damping that the drive adds to the cart: none."""
        return 0.0

    @property
    def force_per_voltage(self) -> float:
        """Force, or acceleration, per command: 1."""
        return 1.0

    def saturate(self, command: Scalars) -> Float[Array, "*batch"]:
        """Clips the command, in its unit; the derivative is 1 inside, 0 outside, 1/2 on the limit."""
        return jnp.maximum(-self.limit, jnp.minimum(self.limit, command))

    def force(self, command: Scalars, x_dot: Scalars) -> Scalars:
        """Returns the force on the cart [N], or in its place the cart's acceleration [m/s^2]: the command itself."""
        return command

    def voltage_for_force(self, force: Scalars, x_dot: Scalars) -> Scalars:
        """Returns the command for a force [N], or for an acceleration [m/s^2]: that itself."""
        return force


@pytree
class ForceActuator(_Direct):
    """A drive without dynamics: the command is the force on the cart [N], and "voltage" means that force."""

    limit: Scalars = number("N", "|force| is clipped here", default=10.0, above=0.0, infinite=True, linear=False)


@pytree
class AccelerationActuator(_Direct):
    """A drive that prescribes the cart's acceleration: the command is x'' [m/s^2], and "voltage" means it.

    Servo and stepper drives with a fast inner loop are modelled like this: the cart follows whatever the pole's force
    on it is, so that the cart's mass and friction have no effect. Where other drives have a force on the cart, this one
    has the acceleration: `CartPole.acceleration` takes it and `CartPole.force_for_acceleration` returns it.
    """

    limit: Scalars = number("m/s^2", "|x''| is clipped here", default=10.0, above=0.0, infinite=True, linear=False)
