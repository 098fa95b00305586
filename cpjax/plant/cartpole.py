"""The plant: a cart with a pendulum, driven by a DC motor through its wheels.

With M = cart_mass + reflected rotor mass, m = pole_mass, l = pole_length, J = pole_inertia, c = cart_friction,
b = pivot_friction and F the horizontal force of the wheels, the Lagrangian

    L = 1/2 M x'^2 + 1/2 m ((x' - l th' cos th)^2 + (l th' sin th)^2) + 1/2 J th'^2 - m g l cos th

gives (paper, section III, with its sign error corrected; see docs/paper.md)

    (M + m) x'' - m l cos(th) th'' = F - c x' - m l sin(th) th'^2
    (J + m l^2) th'' - m l cos(th) x'' = m g l sin(th) - b th'

`CartPole.acceleration` is the only place that solves these for x'' and th''. Under an `AccelerationActuator` x'' is
given, and the second equation alone determines th''.
"""

import math
from typing import Any, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Bool

from cpjax.backend.trigonometry import LARGEST_TURN, rotate_by, sin_cos
from cpjax.checks import call, real
from cpjax.errors import InputError
from cpjax.plant.motor import AccelerationActuator, Motor
from cpjax.plant.state import ANGLE_LIMIT, NAMES, RUNAWAY_LIMIT, UNITS, State
from cpjax.pytree import Number, Scalar, Scalars, number, part, pytree

Pair: TypeAlias = tuple[Scalars, Scalars]
"""Pair: cart, pole."""

# Reference sizes of parameters whose value may be zero; the fields below declare them (`typical`, `drawn`).


def _swing(plant: "CartPole") -> float:
    """Returns the inertia of a point bob about the pivot, m l^2 [kg m^2]."""
    return float(plant.pole_mass) * float(plant.pole_length) ** 2


def _pivot_damping(plant: "CartPole") -> float:
    """Returns the pivot friction of a point bob with quality factor 1, m l^2 sqrt(g / l) [N m s/rad]."""
    return _swing(plant) * math.sqrt(float(plant.gravity) / float(plant.pole_length))


def _fifth_of_critical_damping(plant: "CartPole") -> float:
    """Returns a fifth of the pendulum's critical damping, 0.4 sqrt(m g l (J + m l^2)) [N m s/rad]."""
    weight = float(plant.pole_mass) * float(plant.gravity) * float(plant.pole_length)
    return 0.4 * math.sqrt(weight * float(plant.pivot_inertia))


@pytree
class CartPole:
    """Cart, pole and motor. Defaults: the paper's appendix (a point bob on a massless pole, no friction)."""

    cart_mass: Scalars = number("kg", "mass of the cart, m_1", default=1.0, above=0.0, uncertain=True)
    pole_mass: Scalars = number("kg", "mass of the pole, m_2", default=0.5, above=0.0, uncertain=True)
    pole_length: Scalars = number("m", "pivot to the pole's centre of mass, l", default=0.7, above=0.0, uncertain=True)
    gravity: Scalars = number("m/s^2", "gravity, g", default=9.81, above=0.0)
    pole_inertia: Scalars = number(
        "kg m^2", "pole inertia about its centre of mass, J", default=0.0, at_least=0.0, typical=_swing
    )
    cart_friction: Scalars = number(
        "N s/m",
        "viscous friction of the cart, c",
        default=0.0,
        at_least=0.0,
        uncertain=True,
        typical=lambda plant: plant.motor.damping,
        change=0.1,
    )
    pivot_friction: Scalars = number(
        "N m s/rad",
        "viscous friction of the pivot, b",
        default=0.0,
        at_least=0.0,
        uncertain=True,
        typical=_pivot_damping,
        drawn=_fifth_of_critical_damping,
        change=0.01,
    )
    coulomb_friction: Scalars | None = number(
        "N", "dry friction of the cart, F_c", default=None, at_least=0.0, linear=False, optional=True, change=0.1
    )
    pivot_coulomb_friction: Scalars | None = number(
        "N m", "dry friction of the pivot", default=None, at_least=0.0, linear=False, optional=True, change=0.001
    )
    static_friction_ratio: Scalars = number(
        "1", "static per sliding dry friction", default=1.0, at_least=1.0, linear=False, neutral=1.0
    )
    motor: Any = part(
        "a cpjax.Motor, LumpedMotor, ForceActuator or AccelerationActuator",
        "saturate",
        "force",
        "reflected_mass",
        default_factory=Motor,
    )

    def __post_init__(self) -> None:
        for name in ("coulomb_friction", "pivot_coulomb_friction"):
            value = getattr(self, name)
            if isinstance(value, float) and value == 0.0:  # no dry friction, which costs nothing
                object.__setattr__(self, name, None)
        if isinstance(self.motor, AccelerationActuator) and self.coulomb_friction is not None:
            allowed = "None with an AccelerationActuator, whose cart follows its command"
            raise InputError("CartPole.coulomb_friction", self.coulomb_friction, allowed)

    @classmethod
    def rod(cls, *, mass: Scalars, length: Scalars, **others: Any) -> "CartPole":
        """Builds a cart-pole whose pole is a uniform rod on the pivot: l = length / 2, J = mass length^2 / 12.

        Args:
          mass: of the rod [kg].
          length: of the whole rod [m].
          others: the remaining fields of `CartPole`.

        Raises:
          InputError: a value outside its range.
        """
        mass = Number("kg", "mass of the rod", above=0.0).normalise("CartPole.rod: mass", mass)
        length = Number("m", "length of the rod", above=0.0).normalise("CartPole.rod: length", length)
        return cls(pole_mass=mass, pole_length=length / 2, pole_inertia=mass * length * length / 12, **others)

    @property
    def limits(self) -> State:
        """Largest allowed magnitude of each component of the state; a rollout that exceeds one is stopped."""
        return State(RUNAWAY_LIMIT, RUNAWAY_LIMIT, ANGLE_LIMIT, RUNAWAY_LIMIT)

    @property
    def units(self) -> dict[str, str]:
        """Units of the state's components by name, for error messages."""
        return dict(zip(NAMES, UNITS, strict=True))

    @property
    def input_limit(self) -> Scalars:
        """Voltage at which the drive clips [V]."""
        return self.motor.voltage_limit

    def coordinates(self, state: State) -> tuple[Pair, Pair]:
        """Returns positions (x, theta) and velocities (x', theta')."""
        return (state.x, state.theta), (state.x_dot, state.theta_dot)

    def state(self, q: Pair, v: Pair) -> State:
        """Returns the state of positions (x, theta) and velocities (x', theta')."""
        return State(q[0], v[0], q[1], v[1])

    def saturate(self, command: Scalar) -> Scalar:
        """Returns the terminal voltage [V] that the drive applies for a commanded voltage [V]: see `Motor.saturate`."""
        return real("plant.motor.saturate", call("plant.motor", self.motor, "saturate", command))

    def geometry(self, q: Pair) -> Pair:
        """Returns sine and cosine of theta, the only functions of the positions in the accelerations."""
        return sin_cos(q[1])

    def geometry_near(self, geometry: Pair, change: Pair) -> tuple[Pair, Bool[Array, "*batch"]]:
        """Returns sine and cosine of theta after a `change` of the positions, and whether they are rounding-accurate.

        Args:
          geometry: sine and cosine before the change.
          change: of (x, theta) [m, rad].
        """
        turn = jnp.asarray(change[1])
        accurate = jnp.abs(turn) <= LARGEST_TURN
        return rotate_by(jnp.asarray(geometry[0]), jnp.asarray(geometry[1]), turn), accurate

    def accelerations(self, geometry: Pair, v: Pair, u: Scalars) -> Pair:
        """Returns (x'', theta'') [m/s^2, rad/s^2] under the applied voltage `u` [V].

        Args:
          geometry: sine and cosine of theta.
          v: (x', theta') [m/s, rad/s].
        """
        return self.solved(*geometry, *self.loads(geometry, v, u))

    def loads(self, geometry: Pair, v: Pair, u: Scalars) -> Pair:
        """Returns the right-hand sides of the equations of motion, as `solved` takes them [N, N m].

        Args:
          geometry: sine and cosine of theta.
          v: (x', theta') [m/s, rad/s].
          u: the applied voltage [V].
        """
        force = real("plant.motor.force", call("plant.motor", self.motor, "force", u, v[0]))
        return self._loads(geometry[0], v, force)

    def outputs(self, state: State, acceleration: Pair, u: Scalars) -> dict[str, Scalars]:
        """Returns what a trajectory saves beside state and voltage: x'' as `cart_acceleration` [m/s^2]."""
        return {"cart_acceleration": acceleration[0]}

    @property
    def moving_mass(self) -> Scalars:
        """Mass of the cart plus the reflected mass of the rotor, M [kg]."""
        return self.cart_mass + self.motor.reflected_mass

    @property
    def pivot_inertia(self) -> Scalars:
        """Inertia of the pole about its pivot, J + m l^2 [kg m^2]."""
        return self.pole_inertia + self.pole_mass * self.pole_length * self.pole_length

    @property
    def natural_frequency(self) -> Scalars:
        """Frequency of small swings of the hanging pole, cart held, sqrt(m g l / (J + m l^2)) [rad/s]."""
        return jnp.sqrt(self.pole_mass * self.gravity * self.pole_length / self.pivot_inertia)

    def acceleration(
        self, sin: Scalars, cos: Scalars, rates: tuple[Scalars, Scalars], force: Scalars
    ) -> tuple[Scalars, Scalars]:
        """Solves the equations of motion in the module's docstring for `(x'', theta'')` [m/s^2, rad/s^2].

        Args:
          sin: sine of theta.
          cos: cosine of theta.
          rates: `(x_dot, theta_dot)` [m/s, rad/s].
          force: horizontal force of the wheels on the cart [N]; of an `AccelerationActuator` the acceleration [m/s^2].
        """
        return self.solved(sin, cos, *self._loads(sin, rates, force))

    def _loads(self, sin: Scalars, rates: Pair, force: Scalars) -> Pair:
        """Returns the right-hand sides of the equations of motion under a force of the wheels [N, N m]."""
        x_dot, theta_dot = rates
        ml = self.pole_mass * self.pole_length
        push = force - self.cart_friction * x_dot - ml * theta_dot * theta_dot * sin
        torque = ml * self.gravity * sin - self.pivot_friction * theta_dot
        if isinstance(self.motor, AccelerationActuator):  # decided while JAX traces
            push = force
        return push, torque

    def solved(self, sin: Scalars, cos: Scalars, push: Scalars, torque: Scalars) -> tuple[Scalars, Scalars]:
        """Solves the equations of motion for `(x'', theta'')` [m/s^2, rad/s^2].

        Args:
          sin: sine of theta.
          cos: cosine of theta.
          push: right-hand side of the cart's equation, but for the pole's acceleration [N];
            of an `AccelerationActuator` its acceleration [m/s^2].
          torque: right-hand side of the pole's, but for the cart's acceleration [N m].
        """
        m, inertia = self.pole_mass, self.pivot_inertia
        ml = m * self.pole_length
        if isinstance(self.motor, AccelerationActuator):
            return push, (ml * cos * push + torque) * (1.0 / inertia)
        # (M + m)(J + m l^2) - (m l cos)^2, written as a sum of positive terms so that nothing cancels
        determinant = (self.moving_mass + m) * self.pole_inertia + ml * self.pole_length * (
            self.moving_mass + m * sin * sin
        )
        inverse = 1.0 / determinant  # a division takes as long as six multiplications
        x_ddot = (inertia * push + ml * cos * torque) * inverse
        theta_ddot = ((self.moving_mass + m) * torque + ml * cos * push) * inverse
        return x_ddot, theta_ddot

    def vector_field(self, state: State, voltage: Scalars) -> State:
        """Returns the time derivative of `state` under the applied (already clipped) terminal `voltage` [V]."""
        sin, cos = sin_cos(state.theta)
        force = self.motor.force(voltage, state.x_dot)
        x_ddot, theta_ddot = self.acceleration(sin, cos, (state.x_dot, state.theta_dot), force)
        return State(state.x_dot, x_ddot, state.theta_dot, theta_ddot)

    def force_for_acceleration(self, state: State, x_ddot: Scalars) -> Scalars:
        """Returns the wheel force [N] under which the cart accelerates with `x_ddot` [m/s^2] (inverse dynamics).

        Of an `AccelerationActuator`, whose `force` is the acceleration, it is `x_ddot` itself.
        """
        if isinstance(self.motor, AccelerationActuator):
            return x_ddot
        sin, cos = sin_cos(state.theta)
        ml = self.pole_mass * self.pole_length
        torque = ml * self.gravity * sin - self.pivot_friction * state.theta_dot
        theta_ddot = (ml * cos * x_ddot + torque) * (1.0 / self.pivot_inertia)
        return (
            (self.moving_mass + self.pole_mass) * x_ddot
            - ml * cos * theta_ddot
            + ml * sin * state.theta_dot * state.theta_dot
            + self.cart_friction * state.x_dot
        )

    def kinetic_energy(self, state: State) -> Scalars:
        """Returns the kinetic energy of cart, rotor and pole [J]."""
        _, cos = sin_cos(state.theta)
        coupling = self.pole_mass * self.pole_length * cos * state.x_dot * state.theta_dot
        cart = 0.5 * (self.moving_mass + self.pole_mass) * state.x_dot * state.x_dot
        return cart - coupling + 0.5 * self.pivot_inertia * state.theta_dot * state.theta_dot

    def potential_energy(self, state: State) -> Scalars:
        """Returns the potential energy m g l cos(theta) [J], zero at the pivot's height."""
        _, cos = sin_cos(state.theta)
        return self.pole_mass * self.gravity * self.pole_length * cos

    def total_energy(self, state: State) -> Scalars:
        """Returns the sum of kinetic and potential energy [J]."""
        return self.kinetic_energy(state) + self.potential_energy(state)

    def pendulum_energy(self, state: State) -> Scalars:
        """Returns the energy of the pole about a pivot at rest [J]; zero upright at rest, -2 m g l hanging at rest.

        E = 1/2 (J + m l^2) theta'^2 + m g l (cos(theta) - 1)        (paper, section IV-C)
        """
        _, cos = sin_cos(state.theta)
        weight = self.pole_mass * self.gravity * self.pole_length
        return 0.5 * self.pivot_inertia * state.theta_dot * state.theta_dot + weight * (cos - 1.0)

    def dissipated_power(self, state: State) -> Scalars:
        """Returns the power lost in cart and pivot friction [W]; the motor's losses are part of the wheel force."""
        cart = self.cart_friction * state.x_dot * state.x_dot
        return cart + self.pivot_friction * state.theta_dot * state.theta_dot
