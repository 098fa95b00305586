"""A cart-pole between two walls, off which the cart bounces: a plant with events of its own.

The impulse of a wall acts on the cart alone, so the pole's row of the equations of motion says how much its rate jumps:
(J + m l^2) d(theta') = m l cos(theta) d(x').
"""

import jax.numpy as jnp

import cpjax
from cpjax.backend.trigonometry import sin_cos
from cpjax.pytree import Scalar, number, part, pytree


@pytree
class Walled:
    free: cpjax.CartPole = part("a CartPole", "accelerations")
    half_length: Scalar = number("m", "the walls stand at -+ this", above=0.0)
    restitution: Scalar = number("1", "rate after a bounce to that before", at_least=0.0, at_most=1.0)

    @property
    def limits(self):
        return self.free.limits

    @property
    def input_limit(self):
        return self.free.input_limit

    def coordinates(self, state):
        return self.free.coordinates(state)

    def state(self, q, v):
        return self.free.state(q, v)

    def saturate(self, command):
        return self.free.saturate(command)

    def accelerations(self, q, v, u, mode):
        return self.free.accelerations(self.free.geometry(q), v, u)

    def outputs(self, state, acceleration, u):
        return self.free.outputs(state, acceleration, u)

    def start_mode(self, q, v):
        return ()

    def guards(self, q, v, u, mode):
        return self.half_length - q[0], self.half_length + q[0]

    def jump(self, q, v, mode, guard):
        _, cos = sin_cos(q[1])
        change = -(1.0 + self.restitution) * v[0]
        free = self.free
        turn = free.pole_mass * free.pole_length * cos * change / free.pivot_inertia
        x = jnp.where(guard == 0, self.half_length, -self.half_length)
        return (x, q[1]), (v[0] + change, v[1] + turn), mode
