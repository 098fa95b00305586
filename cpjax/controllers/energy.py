"""Energy-based swing-up (Astrom and Furuta, 2000), with the paper's signs corrected.

With E the pendulum's energy about its pivot, zero upright at rest, and x'' = a the pivot's acceleration,

    dE/dt = m l a theta' cos(theta) - (pivot friction)

so a = -k E theta' cos(theta) drives E to zero from either side. The law demands an acceleration; the voltage that
yields it follows from the law's plant model, which may differ from the simulated plant.
"""

import math

import jax.numpy as jnp

from cpjax.backend.trigonometry import sin_cos
from cpjax.numeric.selection import where
from cpjax.plant import CartPole
from cpjax.plant.state import State
from cpjax.pytree import Scalars, number, part, pytree


@pytree
class EnergySwingUp:
    """Corrected energy law, with optional centring of the cart and a kick that starts the motion from hanging at rest.

        a = -energy_gain E theta' cos(theta) - (1 - s) (cart_stiffness x + cart_damping x') + s kick

    Hanging at rest, the energy law alone demands zero, and only rounding noise would start the motion. The kick is an
    acceleration of `kick` [m/s^2] towards positive x, weighted by s = (1 - w)^3 for w < 1 and 0 beyond, where w is the
    pendulum's energy above hanging, in units of the energy of a swing of amplitude `kick_radius`. So s is 1 hanging at
    rest, falls to 0 (with two continuous derivatives) within a swing of `kick_radius`, and elsewhere the law is exactly
    the energy law with centring. Inside, the kick replaces the centring, which could otherwise balance it and hold the
    cart. With `kick = 0` there is no kick and s is 0 everywhere.
    """

    model: CartPole = part("plant model used by the law, a CartPole", "force_for_acceleration", "motor")
    energy_gain: Scalars = number("m/(J s)", "k, cart acceleration per E theta' cos(theta)", at_least=0.0)
    cart_stiffness: Scalars = number("1/s^2", "pull of the cart to x = 0", default=0.0, at_least=0.0)
    cart_damping: Scalars = number("1/s", "damping of the cart", default=0.0, at_least=0.0)
    kick: Scalars = number("m/s^2", "acceleration hanging at rest; 0 for none", default=0.5)
    kick_radius: Scalars = number(
        "rad", "swing amplitude beyond which the kick is gone", default=0.02, at_least=1e-3, at_most=math.pi / 2
    )

    def acceleration(self, state: State) -> Scalars:
        """Returns the pivot acceleration that the law demands [m/s^2]."""
        _, cos = sin_cos(state.theta)
        energy = self.model.pendulum_energy(state)
        pump = -self.energy_gain * energy * state.theta_dot * cos
        centring = -(self.cart_stiffness * state.x + self.cart_damping * state.x_dot)
        near = self._kick_weight(state)
        return pump + (1.0 - near) * centring + near * self.kick

    def voltage(self, state: State) -> Scalars:
        """Returns the demanded voltage [V], which yields `acceleration` on the law's model; unclipped."""
        force = self.model.force_for_acceleration(state, self.acceleration(state))
        return self.model.motor.voltage_for_force(force, state.x_dot)

    def _kick_weight(self, state: State) -> Scalars:
        _, cos = sin_cos(state.theta)
        weight = self.model.pole_mass * self.model.gravity * self.model.pole_length
        kinetic = 0.5 * self.model.pivot_inertia * state.theta_dot * state.theta_dot
        above_rest = kinetic * (1.0 / weight) + (1.0 + cos)
        half_edge, _ = sin_cos(0.5 * self.kick_radius)  # 1 - cos(edge) = 2 sin(edge / 2)^2, without cancellation
        room = 1.0 - above_rest * (0.5 / (half_edge * half_edge))
        inside = jnp.maximum(room, 0.0)  # the cube below smooths its kink
        return where(self.kick == 0.0, 0.0, inside * inside * inside)
