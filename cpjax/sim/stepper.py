"""One step of the closed loop: plant, applied voltage and integrator put together."""

from typing import TypeAlias

import jax
import jax.numpy as jnp

from cpjax.controllers.protocol import Controller
from cpjax.numeric.trigonometry import sin_cos
from cpjax.plant import CartPole
from cpjax.pytree import Scalar
from cpjax.sim.integrators import Acceleration, Integrator
from cpjax.state import State

Pair: TypeAlias = tuple[Scalar, Scalar]


def applied_voltage(plant: CartPole, controller: Controller, state: State, mode: jax.Array) -> jax.Array:
    """What the motor gets [V]: the law's demand in `mode`, in the state's dtype, clipped to the supply."""
    demand = controller.mode_voltage(state, mode)
    return plant.motor.saturate(jnp.asarray(demand, dtype=jnp.asarray(state.x).dtype))


def step_held(
    plant: CartPole, integrator: Integrator, state: State, voltage: Scalar, dt: Scalar, first: Pair | None = None
) -> State:
    """The state after `dt` [s] under a constant applied `voltage` [V] (zero-order hold).

    Args:
      first: (x'', theta'') at `state` [m/s^2, rad/s^2], if the caller has it.
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
    first: Pair | None = None,
) -> State:
    """The state after `dt` [s] with the law of `mode` evaluated, and its voltage clipped, in every stage.

    Args:
      first: (x'', theta'') at `state` [m/s^2, rad/s^2], if the caller has it.
    """

    def acceleration(q: Pair, v: Pair) -> Pair:
        sin, cos = sin_cos(q[1])
        voltage = applied_voltage(plant, controller, State(q[0], v[0], q[1], v[1]), mode)
        return plant.acceleration(sin, cos, v, plant.motor.force(voltage, v[0]))

    return _integrate(integrator, acceleration, state, dt, first)


def _integrate(
    integrator: Integrator, acceleration: Acceleration, state: State, dt: Scalar, first: Pair | None
) -> State:
    q, v = integrator(acceleration, (state.x, state.theta), (state.x_dot, state.theta_dot), dt, first)
    return State(q[0], v[0], q[1], v[1])
