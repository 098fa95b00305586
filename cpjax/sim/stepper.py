"""One step of the closed loop: plant, applied voltage and integrator put together."""

from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from cpjax.compilation import part_of_step
from cpjax.controllers.protocol import Controller, SmoothController
from cpjax.numeric.trigonometry import LARGEST_TURN, sin_cos, turned
from cpjax.plant import CartPole
from cpjax.pytree import Scalar
from cpjax.sim.integrators import Acceleration, Integrator
from cpjax.sim.switching import Observation
from cpjax.state import State

Pair: TypeAlias = tuple[Scalar, Scalar]


def applied_voltage(plant: CartPole, controller: Controller, state: State, mode: jax.Array) -> jax.Array:
    """What the motor gets [V]: the law's demand in `mode`, in the state's dtype, clipped to the supply."""
    demand = part_of_step(_demand)(controller, state, mode)
    return plant.motor.saturate(jnp.asarray(demand, dtype=jnp.asarray(state.x).dtype))


def _demand(controller: Controller, state: State, mode: jax.Array) -> Scalar:
    return controller.mode_voltage(state, mode)


def rates(plant: CartPole, direction: Pair, v: Pair, voltage: Scalar) -> Pair:
    """(x'', theta'') [m/s^2, rad/s^2] under an applied `voltage` [V].

    Args:
      direction: sine and cosine of theta.
      v: (x', theta') [m/s, rad/s].
    """
    return plant.acceleration(*direction, v, plant.motor.force(voltage, v[0]))


def step_held(
    plant: CartPole, integrator: Integrator, state: State, voltage: Scalar, dt: Scalar, first: Pair | None = None
) -> State:
    """The state after `dt` [s] under a constant applied `voltage` [V] (zero-order hold).

    Args:
      first: (x'', theta'') at `state` [m/s^2, rad/s^2], if the caller has it.
    """

    def acceleration(q: Pair, v: Pair) -> Pair:
        return part_of_step(rates)(plant, sin_cos(q[1]), v, voltage)

    return _integrate(integrator, acceleration, state, dt, first)


def step_held_by_turns(
    plant: CartPole,
    integrator: Integrator,
    state: State,
    direction: Pair,
    voltage: Scalar,
    dt: Scalar,
    first: Pair | None = None,
) -> tuple[State, jax.Array]:
    """As `step_held`, but the sines and cosines of the later stages are those at `state`, turned; and whether that is
    right to rounding: no turn was larger than `cpjax.numeric.trigonometry.LARGEST_TURN`.

    Args:
      direction: sine and cosine of the angle at `state`.
    """
    near = jnp.asarray(True)

    def acceleration(q: Pair, v: Pair) -> Pair:
        nonlocal near
        turn = jnp.asarray(q[1] - state.theta)
        near &= jnp.abs(turn) <= LARGEST_TURN
        turned_to = turned(jnp.asarray(direction[0]), jnp.asarray(direction[1]), turn)
        return part_of_step(rates)(plant, turned_to, v, voltage)

    return _integrate(integrator, acceleration, state, dt, first), near


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
        voltage = applied_voltage(plant, controller, _state(q, v), mode)
        return part_of_step(rates)(plant, sin_cos(q[1]), v, voltage)

    return _integrate(integrator, acceleration, state, dt, first)


def _integrate(
    integrator: Integrator, acceleration: Acceleration, state: State, dt: Scalar, first: Pair | None
) -> State:
    q, v = integrator(acceleration, (state.x, state.theta), (state.x_dot, state.theta_dot), dt, first)
    return _state(q, v)


UPPER, LOWER, GATE = 0, 1, 2
"""Numbers of the closed loop's guards: the ends of the supply, and the controller's margin."""


class Mode(NamedTuple):
    """In which the closed loop is smooth."""

    law: jax.Array
    """The controller's mode, int32."""
    clip: jax.Array
    """Where the demanded voltage is: 1 above the limit, -1 below it, 0 inside, int32."""


class ClosedLoop(NamedTuple):
    """Plant and controller as a `System` of smooth modes, on the continuous clock.

    Its guards are the two ends of the supply, relative to the limit, and the controller's margin; its output is the
    applied voltage.
    """

    plant: CartPole
    controller: SmoothController

    def observe(self, q: Pair, v: Pair, mode: Mode) -> Observation:
        state = _state(q, v)
        limit = self.plant.motor.voltage_limit
        demand = self._demand(state, mode.law)
        relative = demand / limit  # 0 for an infinite supply
        guards = (
            jnp.where(mode.clip > 0, relative - 1.0, 1.0 - relative),
            jnp.where(mode.clip < 0, -1.0 - relative, 1.0 + relative),
            self._of_state(self.controller.margin(state, mode.law), state),
        )
        voltage = jnp.where(mode.clip == 0, demand, jnp.where(mode.clip > 0, limit, -limit))
        acceleration = part_of_step(rates)(self.plant, sin_cos(q[1]), v, voltage)
        return Observation(acceleration, guards, voltage)

    def jump(self, q: Pair, v: Pair, mode: Mode, guard: jax.Array) -> tuple[Pair, Pair, Mode]:
        state = _state(q, v)
        law = jnp.where(guard == GATE, self.controller.successor(mode.law), mode.law)
        now = self._clip(state, law)
        # On the limit itself rounding has the sign. A demand that has jumped past the other limit is beyond that one.
        inside = jnp.where(now == -mode.clip, now, 0)
        clip = jnp.where(mode.clip == 0, jnp.where(guard == UPPER, 1, -1), inside)
        return q, v, Mode(law, jnp.where(guard == GATE, now, clip).astype(mode.clip.dtype))

    def start_mode(self, start: State) -> Mode:
        """At the start of a rollout."""
        law = self.controller.start_mode(start)
        return Mode(law, self._clip(start, law))

    def _clip(self, state: State, law: jax.Array) -> jax.Array:
        demand, limit = self._demand(state, law), self.plant.motor.voltage_limit
        return (demand > limit).astype(jnp.int32) - (demand < -limit).astype(jnp.int32)

    def _demand(self, state: State, law: jax.Array) -> jax.Array:
        return self._of_state(self.controller.mode_voltage(state, law), state)

    def _of_state(self, value: Scalar, state: State) -> jax.Array:
        return jnp.asarray(value, dtype=jnp.asarray(state.x).dtype)


def _state(q: Pair, v: Pair) -> State:
    return State(q[0], v[0], q[1], v[1])
