"""One step of the closed loop: plant, applied voltage and integrator put together."""

from typing import TypeAlias

import jax

from cpjax.controllers.protocol import Controller
from cpjax.numeric.trigonometry import sin_cos
from cpjax.plant import CartPole
from cpjax.pytree import Scalar
from cpjax.sim.integrators import Acceleration, Integrator
from cpjax.state import State

Pair: TypeAlias = tuple[Scalar, Scalar]


def step_held(plant: CartPole, integrator: Integrator, state: State, voltage: Scalar, dt: Scalar, first: Pair) -> State:
    """The state after `dt` [s] under a constant applied `voltage` [V] (zero-order hold).

    Args:
      first: (x'', theta'') at `state` [m/s^2, rad/s^2].
    """

    def acceleration(q: Pair, v: Pair) -> Pair:
        sin, cos = sin_cos(q[1])
        return plant.acceleration(sin, cos, v, plant.motor.force(voltage, v[0]))

    return _integrate(integrator, acceleration, state, dt, first)


def step_continuous(
    plant: CartPole,
    controller: Controller,
    integrator: Integrator,
    state: State,
    mode: jax.Array,
    dt: Scalar,
    first: Pair,
) -> State:
    """The state after `dt` [s] with the law of `mode` evaluated, and its voltage clipped, in every stage.

    Args:
      first: (x'', theta'') at `state` [m/s^2, rad/s^2].
    """

    def acceleration(q: Pair, v: Pair) -> Pair:
        sin, cos = sin_cos(q[1])
        voltage = plant.motor.saturate(controller.mode_voltage(State(q[0], v[0], q[1], v[1]), mode))
        return plant.acceleration(sin, cos, v, plant.motor.force(voltage, v[0]))

    return _integrate(integrator, acceleration, state, dt, first)


def _integrate(integrator: Integrator, acceleration: Acceleration, state: State, dt: Scalar, first: Pair) -> State:
    q, v = integrator(acceleration, (state.x, state.theta), (state.x_dot, state.theta_dot), dt, first)
    return State(q[0], v[0], q[1], v[1])
