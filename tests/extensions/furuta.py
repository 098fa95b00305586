"""A Furuta pendulum: a pole on the end of a driven arm, with its energy law and its LQR.

phi is the arm's angle, theta the pole's from upright. With r the arm's length, J_a its inertia, and m, l, J the pole's
mass, distance of its centre of mass and inertia about that,

    T = 1/2 (J_a + m r^2 + m l^2 sin^2 theta) phi'^2 + m r l cos(theta) phi' theta' + 1/2 (J + m l^2) theta'^2
    V = m g l cos(theta)

(K. J. Astrom and K. Furuta, Swinging up a pendulum by energy control, Automatica 36, 2000).
"""

import math

import jax
import jax.numpy as jnp

import cpjax
from cpjax.backend.trigonometry import sin_cos
from cpjax.numeric.angles import wrap_angle
from cpjax.pytree import Scalar, matrix, number, part, pytree


@pytree
class FurutaState:
    phi: Scalar
    phi_dot: Scalar
    theta: Scalar
    theta_dot: Scalar


@pytree
class Furuta:
    arm_length: Scalar = number("m", "r", default=0.2, above=0.0)
    arm_inertia: Scalar = number("kg m^2", "J_a", default=2e-3, above=0.0)
    pole_mass: Scalar = number("kg", "m", default=0.1, above=0.0)
    pole_length: Scalar = number("m", "l", default=0.15, above=0.0)
    pole_inertia: Scalar = number("kg m^2", "J", default=7.5e-4, above=0.0)
    gravity: Scalar = number("m/s^2", "g", default=9.81, above=0.0)
    torque_per_voltage: Scalar = number("N m/V", "of the motor at rest", default=0.03, above=0.0)
    damping: Scalar = number("N m s/rad", "of the arm, back-EMF included", default=0.002, at_least=0.0)
    input_limit: Scalar = number("V", "of the supply", default=12.0, above=0.0)

    @property
    def limits(self):
        return FurutaState(1e5, 1e3, 1e5, 1e3)

    def coordinates(self, state):
        return (state.phi, state.theta), (state.phi_dot, state.theta_dot)

    def state(self, q, v):
        return FurutaState(q[0], v[0], q[1], v[1])

    def saturate(self, command):
        return jnp.maximum(-self.input_limit, jnp.minimum(self.input_limit, command))

    def accelerations(self, q, v, u):
        sin, cos = sin_cos(q[1])
        phi_dot, theta_dot = v
        ml2, coupling = self.pole_mass * self.pole_length**2, self.pole_mass * self.arm_length * self.pole_length
        a = self.arm_inertia + self.pole_mass * self.arm_length**2 + ml2 * sin * sin
        b, c = coupling * cos, self.pole_inertia + ml2
        torque = self.torque_per_voltage * u - self.damping * phi_dot
        f = torque - 2.0 * ml2 * sin * cos * phi_dot * theta_dot + coupling * sin * theta_dot * theta_dot
        g = ml2 * sin * cos * phi_dot * phi_dot + self.pole_mass * self.gravity * self.pole_length * sin
        inverse = 1.0 / (a * c - b * b)
        return (c * f - b * g) * inverse, (a * g - b * f) * inverse


@pytree
class FurutaEnergyLaw:
    """phi'' wanted = gain E theta' cos(theta) - damping phi', as a voltage by the arm's inertia alone."""

    plant: Furuta = part("a Furuta pendulum", "pole_length")
    gain: Scalar = number("rad/(J s)", "of the energy", at_least=0.0)
    damping: Scalar = number("1/s", "of the arm", default=0.0, at_least=0.0)

    def voltage(self, state):
        p = self.plant
        _, cos = sin_cos(state.theta)
        inertia = p.pole_inertia + p.pole_mass * p.pole_length**2
        weight = p.pole_mass * p.gravity * p.pole_length
        energy = 0.5 * inertia * state.theta_dot * state.theta_dot + weight * (cos - 1.0)
        wanted = self.gain * energy * state.theta_dot * cos - self.damping * state.phi_dot
        torque = (p.arm_inertia + p.pole_mass * p.arm_length**2) * wanted + p.damping * state.phi_dot
        return torque / p.torque_per_voltage


@pytree
class FurutaFeedback:
    K: jax.Array = matrix((1, 4), "V per unit of state", "gain")

    def voltage(self, state):
        s = (state.phi, state.phi_dot, wrap_angle(state.theta), state.theta_dot)
        return -sum(self.K[0, i] * s[i] for i in range(4))


@pytree
class FurutaTimeOutside:
    """The time that the pole spends away from upright, roughly [s]."""

    def init(self, sample):
        return jnp.zeros_like(sample.time)

    def update(self, memory, sample):
        _, cos = sin_cos(sample.state.theta)
        return memory + sample.elapsed * (1.0 - jnp.exp(-25.0 * (1.0 - cos)))

    def finalize(self, memory, last):
        return memory


def lqr_gain(plant):
    def field(s, u):
        q, v = (s[0], s[2]), (s[1], s[3])
        a = plant.accelerations(q, v, u)
        return jnp.stack([s[1], a[0], s[3], a[1]])

    A, B = jax.jacfwd(field, argnums=(0, 1))(jnp.zeros(4), jnp.zeros(()))
    return cpjax.lqr(A, B[:, None], jnp.diag(jnp.array([1.0, 0.1, 10.0, 0.1])), 0.1).K


def controller(plant, gain=500.0, damping=2.0, half_angle=0.4):
    law = FurutaEnergyLaw(plant, gain, damping)
    return cpjax.Hybrid(law, FurutaFeedback(lqr_gain(plant)), cpjax.AngleGate(half_angle))


START = FurutaState(0.0, 0.0, math.pi - 0.3, 0.0)
